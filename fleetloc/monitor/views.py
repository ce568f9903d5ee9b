"""What is shown of a fleet at one moment, as it goes to the terminal and, as JSON, to the browser.

NED metres, seconds, radians; 3-sigma figures are three times the square root of a variance.
"""

from __future__ import annotations

from typing import Literal

import msgspec

Level = Literal["ok", "info", "warning", "bad"]
Triple = tuple[float, float, float]


class View(msgspec.Struct, frozen=True, kw_only=True):
    """A part of the picture."""


class Ellipse(View, frozen=True):
    """Horizontal 3-sigma ellipse and vertical 3-sigma half height of a position."""

    major_m: float
    minor_m: float
    angle_rad: float
    """Of the major axis, from north towards east."""
    up_m: float


class SeenBy(View, frozen=True):
    """Where another drone, itself heard, has a drone: by its own estimate, or as a report that it passed on says."""

    agent_id: int
    position_m: Triple
    sigma_m: float
    """Root of the sum of the variances of its axes."""
    age_s: float
    """Since anything of the drone entered that neighbour's estimate, or since the tick of the report."""


class Drone(View, frozen=True):
    """One drone; ``None`` is what is not known."""

    agent_id: int
    name: str
    status: str
    """``unseen``, ``lost``, ``stale``, or what the drone says of itself: ``init``, ``aligning``, ``ok``, ..."""
    level: Level
    position_m: Triple | None = None
    """The last it said, however old."""
    velocity_mps: Triple | None = None
    ellipse: Ellipse | None = None
    estimate_age_s: float | None = None
    heard_age_s: float | None = None
    """Since anything of it reached this monitor."""
    gps: str = ""
    gps_age_s: float | None = None
    tick_p99_s: float | None = None
    seen_by: SeenBy | None = None
    integrity: str = ""
    """State and reason of what is promised of the position (docs/integrity.md)."""
    protection_m: tuple[float, float] | None = None
    """Protection levels, horizontal and vertical."""


class Target(View, frozen=True):
    """A body of ``[[targets]]`` as the heard drone has it that knows it best; ``None`` where no drone has it."""

    target_id: int
    name: str
    seen_by: SeenBy | None = None
    velocity_mps: Triple | None = None
    ellipse: Ellipse | None = None
    """Its axes are north and east: what drones tell of other bodies has no covariances between axes."""
    state: str = ""
    """What that drone states of it (docs/integrity.md)."""


class Link(View, frozen=True):
    """What ``receiver`` says of the packets of ``sender``."""

    sender: int
    receiver: int
    level: Level
    age_s: float | None
    """Since the last packet; ``None`` if there was none, or the receiver itself is not heard."""
    loss: float | None = None
    """Share lost of the packets of the last `picture.LOSS_WINDOW_S`."""
    rejected: int = 0
    round_trip_s: float | None = None
    clock_offset_s: float | None = None


class Alarm(View, frozen=True):
    """Something to know; of a drone, or (``agent_id`` 0) of the fleet or the monitor itself."""

    agent_id: int
    level: Level
    text: str
    since_unix_s: float


class Picture(View, frozen=True):
    """A fleet at ``unix_s``; alarms the gravest first."""

    fleet: str
    unix_s: float
    drones: tuple[Drone, ...]
    links: tuple[Link, ...]
    alarms: tuple[Alarm, ...]
    refused: dict[str, int]
    """Packets that the monitor refused since its start, by reason."""
    anchors: dict[int, Triple] = {}
    """Where the anchors of the configuration are, by id."""
    targets: tuple[Target, ...] = ()


class Tracks(View, frozen=True):
    """Where each drone was, oldest first, every ``spacing_s`` over the last ``track_s``."""

    track_s: float
    spacing_s: float
    points: dict[int, list[Triple]]
