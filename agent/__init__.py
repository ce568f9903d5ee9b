"""The daemon beside one autopilot: MAVLink and UWB in, ticks, the agent core, estimates out."""
