"""The fleet clock of one process: UTC since the epoch, carried by the monotonic clock. Sans-I/O."""

from __future__ import annotations

from datetime import UTC, datetime

from agent.config.faults import Fault
from agent.config.tables import FleetConfig, FleetTable
from transport.messages.header import MAX_TICK

SET_UNIX_S = 1_767_225_600.0
"""Start of 2026: a host whose clock is before it was never told the time."""
BEHIND_S = 366 * 86_400.0
"""A clock that is behind the epoch by less may be one that went on from the last shutdown."""
MAX_SLEW = 0.005
"""Small differences to UTC are made up this fast, s per s: deadlines and sample times stay smooth."""
STEP_S = 0.5
"""A larger difference is a step of the system's clock: fleet time follows at once."""


MAX_BACK_S = 60.0
"""A step back is followed up to here: until it is made up for nothing is estimated, for no tick may come twice. One
that goes farther back is not followed; a restart does."""


class FleetClock:
    """Fleet time is host (monotonic) time plus ``offset_s``.

    ``steps`` counts jumps of UTC that were followed; what spans a jump has to start anew.
    """

    def __init__(self, epoch_unix_s: float, *, unix_s: float, host_s: float) -> None:
        self._epoch_unix_s = epoch_unix_s
        self.offset_s = unix_s - epoch_unix_s - host_s
        self._synced_s = host_s
        self.steps = 0
        self.ahead_s = 0.0
        """By how much fleet time is ahead of UTC after a step back that was not followed."""

    def fleet_s(self, host_s: float) -> float:
        """Fleet time of a host time."""
        return host_s + self.offset_s

    def sync(self, *, unix_s: float, host_s: float) -> bool:
        """Compare with UTC, about once a second; true if fleet time stepped.

        A step back by more than `MAX_BACK_S` leaves it as it is; ``ahead_s`` says by how much that is wrong.
        """
        difference_s = unix_s - self._epoch_unix_s - host_s - self.offset_s
        elapsed_s, self._synced_s = max(host_s - self._synced_s, 0.0), host_s
        self.ahead_s = -difference_s if difference_s < -MAX_BACK_S else 0.0
        if self.ahead_s:
            return False
        if abs(difference_s) > STEP_S:
            self.offset_s += difference_s
            self.steps += 1
            return True
        limit_s = MAX_SLEW * elapsed_s
        self.offset_s += min(max(difference_s, -limit_s), limit_s)
        return False


def clock_fault(fleet: FleetTable, unix_s: float) -> str | None:
    """Why nothing can be sent at a UTC instant, its tick being none that fits a packet; ``None`` where it does."""
    first_s, last_s = fleet.epoch_unix_s, fleet.epoch_unix_s + MAX_TICK * fleet.period_s
    if first_s <= unix_s <= last_s:
        return None
    return f"clock at {_date(unix_s)}, outside the fleet's time"


def step_fault(clock: FleetClock) -> str | None:
    """Why neighbours do not understand us after a step of the system's clock; ``None`` where they do."""
    if not clock.ahead_s:
        return None
    return f"clock stepped back by {clock.ahead_s:.0f} s, not followed: start the daemon anew"


def require_epoch(config: FleetConfig, *, unix_s: float) -> str | None:
    """Check that the fleet's ticks fit packets at a UTC instant.

    Raises `ConfigError` for an epoch that the instant is too far from. Where it may be that the host was not told the
    time yet (a companion computer before its first fix), what is wrong comes back as a line: it will be set.
    """
    fleet = config.fleet
    fault = clock_fault(fleet, unix_s)
    if fault is None or unix_s < SET_UNIX_S or 0.0 < fleet.epoch_unix_s - unix_s < BEHIND_S:
        return fault
    span_s = MAX_TICK * fleet.period_s
    earliest, latest = max(unix_s - span_s, 0.0), unix_s
    expected = f"{earliest:.0f}..{latest:.0f}, so that the ticks of now ({_date(unix_s)}) are 0..{MAX_TICK}"
    raise config.others.document.error(Fault("fleet.epoch_unix_s", expected, f"{fleet.epoch_unix_s:.0f}"))


def _date(unix_s: float) -> str:
    try:
        return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%d")
    except (OverflowError, ValueError, OSError):
        return f"{unix_s:.0f} s since 1970"
