"""How late the machine itself is: what a process that only sleeps and wakes experiences beside a run.

Real-time tests run beside whatever else the machine does. Where being on time is the point, they ask it of the
ticks in which the machine was on time itself; on an idle machine these are all.
"""

from __future__ import annotations

import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetloc.report.fleet_results import FleetResults

ROOT = Path(__file__).parents[2]
WAKE_PERIOD_S = 0.005
MAX_LATE_SHARE = 0.5
"""A tick in which the machine alone took so much of a period says nothing of what ran on it."""
MIN_SOUND_SHARE = 0.1
"""With fewer ticks in which the machine was on time, a run proves nothing."""


class Witness:
    """What one wrote down: UTC seconds at which it had to wake, and how late it did."""

    def __init__(self, path: Path) -> None:
        self.due_s, self.late_s = np.fromfile(path).reshape(-1, 2).T

    def sound(self, begin_s: NDArray[np.float64], period_s: float) -> NDArray[np.bool_]:
        """Whether the machine was on time in the periods that begin at these UTC seconds."""
        so_far_s = np.concatenate(([0.0], np.cumsum(self.late_s)))
        first, last = (np.searchsorted(self.due_s, begin_s + after_s) for after_s in (-WAKE_PERIOD_S, period_s))
        return np.asarray(so_far_s[last] - so_far_s[first] < MAX_LATE_SHARE * period_s)

    def lost_s(self, begin_s: float, end_s: float, beyond_s: float = 0.0) -> float:
        """What the machine was late by in sum between two UTC seconds: so much more a promise may take.

        With ``beyond_s``, of the times only at which it was late by more.
        """
        inside = (self.due_s >= begin_s) & (self.due_s < end_s) & (self.late_s > beyond_s)
        return float(self.late_s[inside].sum())


@contextmanager
def witnessed(folder: Path) -> Iterator[Path]:
    """Run a witness meanwhile; gives the file for `Witness` afterwards."""
    path = folder / "witness"
    command = [sys.executable, "-m", "tests.support.machine", str(path)]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE)
    try:
        yield path
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait()


def check_on_time(results: FleetResults, witness: Witness, least: float = 0.95) -> None:
    """Nearly all estimates are out in time, of those ticks for whose answer the machine was in time itself."""
    for track in results.tracks:
        tick_end_s = results.start_unix_s + track.time_s + results.period_s
        sound = witness.sound(tick_end_s, results.period_s)
        assert sound.mean() >= MIN_SOUND_SHARE, f"the machine was late in {np.mean(~sound):.0%} of all ticks"
        assert len(track.time_s) >= track.ticks_expected - 1, f"agent {track.agent_id}: ticks without an estimate"
        assert track.on_time[sound].mean() >= least, f"agent {track.agent_id}"


def _keep_time(path: str) -> None:
    """Until stdin ends, write pairs of float64: a UTC second at which to wake, and how late that was."""
    with open(path, "wb", buffering=0) as file:
        due_s = time.time()
        while not select.select([sys.stdin], [], [], max(due_s - time.time(), 0.0))[0]:
            now_s = time.time()
            if now_s >= due_s:
                file.write(np.array((due_s, now_s - due_s)).tobytes())
                due_s = max(due_s + WAKE_PERIOD_S, now_s)


if __name__ == "__main__":
    _keep_time(sys.argv[1])
