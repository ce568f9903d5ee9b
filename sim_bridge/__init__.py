"""What stands in for the world: fleet simulator with fake autopilots, SITL bridge, log replay, truth."""
