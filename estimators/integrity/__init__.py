"""Whether an estimate can be trusted: observability, ambiguity, mirror images, consistency."""
