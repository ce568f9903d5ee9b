"""What all tests share."""

from __future__ import annotations

from hypothesis import settings

# No deadline: the machines that run this are shared, and a slow example is not a wrong one. A failing example
# prints the line that repeats it anywhere.
settings.register_profile("fleetloc", deadline=None, print_blob=True)
settings.load_profile("fleetloc")
