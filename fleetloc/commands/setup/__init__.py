"""Commands for setting a drone up."""
