"""Float16 numbers of bodies, rounded so that no receiver trusts a sensor or an estimate more than its owner does."""

from __future__ import annotations

import math
import struct

LARGEST_HALF = 65504.0
_HALF = struct.Struct("<e")
_HALF_BITS = struct.Struct("<H")


def half_up(value: float) -> float:
    """The smallest float16 not below ``value`` >= 0; inf beyond its range."""
    if value > LARGEST_HALF:
        return math.inf
    packed = _HALF.pack(value)
    rounded: float = _HALF.unpack(packed)[0]
    if rounded < value:
        rounded = _HALF.unpack(_HALF_BITS.pack(_HALF_BITS.unpack(packed)[0] + 1))[0]
    return rounded
