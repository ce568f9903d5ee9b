"""The parts of the public Python API that are not simply names of another room; use them as ``fleetloc.NAME``."""
