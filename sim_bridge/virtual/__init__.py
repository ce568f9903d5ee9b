"""Fleets of the agents' own cores in virtual time."""
