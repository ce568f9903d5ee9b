"""One TOML file for the whole fleet: its tables, reading and checking it."""
