"""``mavlink``: the generated codec of the one dialect that is spoken, ardupilotmega of MAVLink 2.

A wheel holds a copy of it (``setup.py``), so that a drone need not carry all dialects; a checkout takes pymavlink's.
"""

from __future__ import annotations

try:
    from agent.mavlink import ardupilotmega as mavlink  # type: ignore[attr-defined]
except ImportError:
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = ["mavlink"]
