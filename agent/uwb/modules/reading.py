"""What a module's parser makes of bytes, and how it counts them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class ModuleRange:
    """A range to another module: its id as modules count them, m, dBm, probability 0..1 of no line of sight."""

    module: int
    range_m: float
    rx_dbm: float | None = None
    first_path_dbm: float | None = None
    nlos: float | None = None


@dataclass(frozen=True, slots=True)
class Reading:
    """What a module said at one instant.

    ``own`` is its own id where it tells that. ``clock_s`` is its own clock at the measurement, from an unknown
    start, ``wrap_s`` after how long that begins anew; absent where it has none that can be used.
    """

    ranges: tuple[ModuleRange, ...]
    own: int | None = None
    clock_s: float | None = None
    wrap_s: float | None = None


class ByteCounts:
    """What became of a parser's bytes: ``fed`` is ``used`` plus ``refused`` plus what waits for its rest."""

    def __init__(self) -> None:
        self.fed = 0
        self.used = 0
        """Of messages that were understood, with ranges or without."""
        self.refused: Counter[str] = Counter()
        """Bytes by reason."""
        self.readings = 0
        self.left_out: Counter[str] = Counter()
        """Measurements of good messages that hold no range, by reason."""


class ModuleParser(Protocol):
    """Bytes of one port in, as they come, split anywhere; readings out."""

    counts: ByteCounts

    def feed(self, data: bytes) -> list[Reading]:
        """Take in bytes; what they completed."""

    def pause(self) -> list[Reading]:
        """The line was silent: what is unfinished stays so, and what lies behind its begin is looked at."""
