"""What the tables of a configuration are made of: frozen structs that refuse unknown keys, and kinds of values."""

from __future__ import annotations

from typing import Annotated

import msgspec

AgentId = Annotated[int, msgspec.Meta(ge=1, le=999)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Port = Annotated[int, msgspec.Meta(ge=1, le=65_535)]
Seed = Annotated[int, msgspec.Meta(ge=0)]
NAME_RULE = "1 to 32 of the characters a-z, 0-9, - and _"
Name = Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9_-]{1,32}$", description=NAME_RULE)]
Point = tuple[float, float, float]
"""NED metres in the fleet frame."""
LeverArm = tuple[float, float, float]
"""Metres from the IMU, in body axes: front, right, down."""


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the configuration: frozen, unknown keys refused."""
