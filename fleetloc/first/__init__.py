"""`fleetloc init`: what a new fleet is, in a few words, as a first configuration."""
