"""The fleet clock of one process: UTC since the epoch, carried by the monotonic clock. Sans-I/O."""

from __future__ import annotations

MAX_SLEW = 0.005
"""Small differences to UTC are made up this fast, s per s: deadlines and sample times stay smooth."""
STEP_S = 0.5
"""A larger difference is a step of the system's clock: fleet time follows at once."""


class FleetClock:
    """Fleet time is host (monotonic) time plus ``offset_s``.

    ``steps`` counts jumps of UTC that were followed; what spans a jump has to start anew.
    """

    def __init__(self, epoch_unix_s: float, *, unix_s: float, host_s: float) -> None:
        self._epoch_unix_s = epoch_unix_s
        self.offset_s = unix_s - epoch_unix_s - host_s
        self._synced_s = host_s
        self.steps = 0

    def fleet_s(self, host_s: float) -> float:
        """Fleet time of a host time."""
        return host_s + self.offset_s

    def sync(self, *, unix_s: float, host_s: float) -> bool:
        """Compare with UTC, about once a second; true if fleet time stepped."""
        difference_s = unix_s - self._epoch_unix_s - host_s - self.offset_s
        elapsed_s, self._synced_s = max(host_s - self._synced_s, 0.0), host_s
        if abs(difference_s) > STEP_S:
            self.offset_s += difference_s
            self.steps += 1
            return True
        limit_s = MAX_SLEW * elapsed_s
        self.offset_s += min(max(difference_s, -limit_s), limit_s)
        return False
