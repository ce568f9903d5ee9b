"""Faults on request: of sensors in the simulated world and in replays, and of members that lie to the others."""
