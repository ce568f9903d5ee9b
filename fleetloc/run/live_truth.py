"""The simulator's truth while it flies, as lines on a pipe to the process that started it.

No agent can see the pipe; the live picture compares estimates with it. One line of JSON per sample:
``{"time_unix_s": ..., "position_m": [[n, e, d], ...]}`` in the order of the fleet's agents, then
its targets.
"""

from __future__ import annotations

import math
import sys
from collections import deque

import msgspec

from sim_bridge.world.simulation import Simulation

PERIOD_S = 0.1
KEPT = 300


class TruePlaces(msgspec.Struct, frozen=True):
    """Where every body truly was, NED metres."""

    time_unix_s: float
    position_m: tuple[tuple[float, float, float], ...]


class TruthWriter:
    """Writes a line to stdout whenever `PERIOD_S` of simulated time have passed; for ``simulate(on_advance=...)``."""

    def __init__(self) -> None:
        self._next_s = 0.0

    def __call__(self, simulation: Simulation) -> None:
        """Write a line if it is time for one."""
        if simulation.now < self._next_s:
            return
        self._next_s = simulation.now + PERIOD_S
        positions = tuple((float(n), float(e), float(d)) for n, e, d in simulation.bodies()[0])
        sample = TruePlaces(simulation.now + simulation.unix_offset_s, positions)
        sys.stdout.buffer.write(msgspec.json.encode(sample) + b"\n")
        sys.stdout.buffer.flush()


class LiveTruth:
    """The samples of the last half minute."""

    def __init__(self) -> None:
        self._samples: deque[TruePlaces] = deque(maxlen=KEPT)

    def on_line(self, line: bytes) -> bool:
        """Take in a line; false if it is none of ours."""
        try:
            self._samples.append(msgspec.json.decode(line, type=TruePlaces))
        except msgspec.DecodeError:
            return False
        return True

    def error_m(self, slot: int, time_unix_s: float, position_m: tuple[float, float, float]) -> float | None:
        """Distance of a position from the truth at that time; ``None`` if the time is not covered."""
        for later, earlier in zip(reversed(self._samples), list(reversed(self._samples))[1:], strict=False):
            if earlier.time_unix_s <= time_unix_s <= later.time_unix_s:
                span = later.time_unix_s - earlier.time_unix_s
                share = (time_unix_s - earlier.time_unix_s) / span
                ends = zip(earlier.position_m[slot], later.position_m[slot], strict=True)
                return math.dist(position_m, [a + share * (b - a) for a, b in ends])
        return None
