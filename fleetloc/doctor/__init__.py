"""`fleetloc doctor`: listening to a drone's autopilot as its daemon would, and what is to be said of the set-up."""
