"""Recorded flights through the agents' own cores, in the time of the logs."""
