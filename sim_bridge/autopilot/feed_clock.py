"""For when an autopilot takes what it is given: the rules by which each firmware reads ``time_usec``."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from sim_bridge.world.noise import FlavourName

CONVERGED_ANSWERS = 500
"""PX4 believes its TIMESYNC filter after so many answers, 50 s; before, a message is of its arrival."""
LAG_MESSAGES = 100
"""ArduPilot takes the smallest lag of so many messages for none."""


class FeedClock:
    """One autopilot's; all times on the clock of ``now``, stamps as they were sent."""

    def __init__(self, flavour: FlavourName, parameter: Callable[[str], float]) -> None:
        self._flavour = flavour
        delay = parameter("VISO_DELAY_MS") if flavour == "ardupilot" else parameter("EKF2_EV_DELAY")
        self._delay_s = delay * 1e-3
        """Read at boot: a later change has no effect."""
        self._answers = 0
        self._offset_s = 0.0
        self._lags_s: deque[float] = deque(maxlen=LAG_MESSAGES)

    def on_timesync(self, theirs_s: float, now: float) -> None:
        """An answer to one of PX4's own requests: the clock of who answers."""
        self._answers += 1
        self._offset_s = now - theirs_s

    def taken_s(self, time_usec: int, now: float) -> float:
        """The instant for which a message that arrives now is taken."""
        stamp_s = time_usec * 1e-6
        if self._flavour == "px4":
            synchronised = self._answers >= CONVERGED_ANSWERS
            return min(stamp_s + self._offset_s if synchronised else now, now) - self._delay_s
        self._lags_s.append(now - stamp_s)
        return now - (now - stamp_s - min(self._lags_s)) - self._delay_s
