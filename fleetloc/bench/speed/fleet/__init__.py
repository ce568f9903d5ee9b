"""The whole step of one drone over recorded ticks of a fleet, ours beside smoothers that hold the whole fleet."""
