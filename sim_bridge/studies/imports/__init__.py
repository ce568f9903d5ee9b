"""Study inputs made of recordings in other formats: CSV of rows, and the factor graphs of the robotics community."""
