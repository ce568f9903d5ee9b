"""What `fleetloc monitor` shows: the picture of a fleet, in a terminal and in a browser; it only listens."""
