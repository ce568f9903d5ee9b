"""What the bridge tells the process that started it, as lines of JSON on a pipe beside the truth's lines."""

from __future__ import annotations

import sys
import time

import msgspec
import numpy as np

from fleetloc.run.live_truth import PERIOD_S, TruePlaces
from sim_bridge.sitl.bridge import BridgeProgress
from sim_bridge.sitl.world import SitlWorld


class ProgressLine(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`BridgeProgress` on the pipe; a truth has other keys."""

    missing: tuple[str, ...] = ()
    ready: bool = False
    begun_unix_s: float | None = None


class LineWriter:
    """Writes the bridge's progress and, ten times a second, the truth of the moment."""

    def __init__(self) -> None:
        self._next_s = 0.0

    def progress(self, progress: BridgeProgress) -> None:
        """For ``bridge(on_progress=...)``."""
        _write(msgspec.json.encode(ProgressLine(progress.missing, progress.ready, progress.begun_unix_s)))

    def step(self, world: SitlWorld, now_s: float) -> None:
        """For ``bridge(on_step=...)``; nothing is written while a truth is missing."""
        if now_s < self._next_s:
            return
        positions_m = world.positions_at(now_s)
        if not np.isfinite(positions_m).all():
            return
        self._next_s = now_s + PERIOD_S
        positions = tuple((float(n), float(e), float(d)) for n, e, d in positions_m)
        _write(msgspec.json.encode(TruePlaces(now_s + world.unix_offset_s, positions)))


def read_progress(line: bytes) -> ProgressLine | None:
    """The progress in a line; ``None`` for any other line."""
    try:
        return msgspec.json.decode(line, type=ProgressLine)
    except msgspec.DecodeError:
        return None


class MissionPrinter:
    """Says what a mission does, on stdout, one line at a time, with the time since its begin."""

    def __init__(self) -> None:
        self._begun_s = time.monotonic()

    def __call__(self, sentence: str) -> None:
        """Say it."""
        _write(f"{time.monotonic() - self._begun_s:6.1f} s  {sentence}".encode())


def _write(line: bytes) -> None:
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.buffer.flush()
