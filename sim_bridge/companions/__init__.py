"""Companion computers on the links of simulated autopilots, and what their sensors say."""
