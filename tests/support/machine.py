"""How late the machine itself is: what a process that computes as much as a daemon experiences beside a run.

Real-time tests run beside whatever else the machine does. Where being on time is the point, they ask it of the
ticks in which the machine was on time itself; on an idle machine these are all. A process that only slept and woke
would know nothing of a machine on which everybody gets too small a share: there it wakes in time, and who has work to
do falls behind.
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
JOB_PERIOD_S, JOB_S = 0.02, 0.0032
"""A sixth of a core, as a daemon of line3 needs (`cpu_fraction` of the demo: 0.13 to 0.16), in pieces as long as
those of its work."""
BEGUN = b"begun\n"
FORGOTTEN_S = 1.0
"""Jobs further behind are left out, as a daemon leaves out ticks."""
MAX_LATE_SHARE = 0.5
"""A tick in which the machine alone took so much of a period says nothing of what ran on it."""
MIN_SOUND = 10
"""With fewer ticks in which the machine was on time, a run proves nothing."""


class Witness:
    """What one wrote down: UTC seconds at which jobs were due, and how much later than alone they were done."""

    def __init__(self, path: Path) -> None:
        self.due_s, self.late_s = np.fromfile(path).reshape(-1, 2).T

    def sound(self, begin_s: NDArray[np.float64], period_s: float) -> NDArray[np.bool_]:
        """Whether the machine was on time in the periods that begin at these UTC seconds."""
        first, last = (np.searchsorted(self.due_s, begin_s + after_s) for after_s in (-JOB_PERIOD_S, period_s))
        worst_s = [self.late_s[i:j].max(initial=0.0) for i, j in zip(first, last, strict=True)]
        return np.asarray(np.array(worst_s) < MAX_LATE_SHARE * period_s)

    def lost_s(self, begin_s: float, end_s: float, beyond_s: float = 0.0) -> float:
        """What the machine was behind by at a UTC second and fell behind by until another: so much more may it take.

        With ``beyond_s``, by more than that at once only.
        """
        first, last = np.searchsorted(self.due_s, (begin_s, end_s))
        more_s = np.diff(self.late_s[max(first - 1, 0) : last], prepend=0.0)
        return float(more_s[more_s > beyond_s].sum())


@contextmanager
def witnessed(folder: Path) -> Iterator[Path]:
    """Run a witness meanwhile, from its first job on; gives the file for `Witness` afterwards."""
    path = folder / "witness"
    command = [sys.executable, "-m", "tests.support.machine", str(path)]
    # a session of its own, as daemons have: where sessions share a machine it gets what a daemon gets
    process = subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == BEGUN, "the witness of the machine's lateness does not begin"
        yield path
    finally:
        process.stdin.close()
        process.stdout.close()
        process.wait()


def check_on_time(results: FleetResults, witness: Witness, least: float = 0.95) -> None:
    """Nearly all estimates are out in time, of those ticks for whose answer the machine was in time itself."""
    for track in results.tracks:
        tick_end_s = results.start_unix_s + track.time_s + results.period_s
        sound = witness.sound(tick_end_s, results.period_s)
        assert np.count_nonzero(sound) >= MIN_SOUND, f"the machine was late in {np.mean(~sound):.0%} of all ticks"
        assert len(track.time_s) >= track.ticks_expected - 1, f"agent {track.agent_id}: ticks without an estimate"
        assert track.on_time[sound].mean() >= least, f"agent {track.agent_id}"


def _keep_time(path: str) -> None:
    """Until stdin ends, write pairs of float64: a UTC second at which a job was due, and how late it was done."""
    sys.stdout.buffer.write(BEGUN)
    sys.stdout.buffer.flush()
    with open(path, "wb", buffering=0) as file:
        due_s = time.time()
        while not select.select([sys.stdin], [], [], max(due_s - time.time(), 0.0))[0]:
            if time.time() < due_s:
                continue
            done_s = time.process_time() + JOB_S
            while time.process_time() < done_s:
                pass
            late_s = time.time() - due_s - JOB_S
            file.write(np.array((due_s, late_s)).tobytes())
            due_s += JOB_PERIOD_S
            if late_s > FORGOTTEN_S:
                due_s = time.time()


if __name__ == "__main__":
    _keep_time(sys.argv[1])
