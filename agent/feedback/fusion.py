"""Does the autopilot use what it is given, and if not, why? Out of what it says and of what was sent. Sans-I/O.

An autopilot drops what it cannot use without a word. What can be known before is said before: parameters and rate;
the rest within two seconds of the feed's begin: its estimator's flags, its innovations, its texts, its position.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from agent.feedback.autopilot_watch import AutopilotWatch
from agent.feedback.gatekeeper import FeedPhase
from agent.feedback.requirements import Requirement, unmet
from estimators.model.measurements import Vector

FEWEST_HZ = {"px4": 5.0, "ardupilot": 4.0}
"""PX4 starts with gaps below 0.2 s only; ArduPilot asks for 4 Hz at least."""
PATIENCE_S = 1.0
"""An autopilot has so long to take up what it is given."""
SILENT_S = 2.0
APART_M = 3.0
"""Its own position is no further from what it is given, if it uses it."""
REFUSED_RATIO = 1.0
"""Innovations above are refused."""
OLD_S = {"px4": ("EKF2_DELAY_MAX", 1e-3)}
"""The parameter that says how old an estimate may be, and its unit in s."""
TEXTS_ABOUT_US = ("odometry", "visodom", "vision", "frame", "ext nav", "externalnav")
MOST_SENT = 20


class FusionWatch:
    """Follows one feed."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, float, Vector]] = deque(maxlen=MOST_SENT)
        """Fleet time of what was sent, its age then, and its position in the fleet frame."""
        self._began_s: float | None = None
        self._refused_since_s: float | None = None
        self._apart_since_s: float | None = None

    def on_sent(self, t_s: float, now_s: float, position_m: Vector) -> None:
        """An estimate of ``t_s`` went out at ``now_s``, both fleet time."""
        self._sent.append((now_s, now_s - t_s, position_m))

    def observe(
        self,
        phase: FeedPhase,
        flavour: str,
        wanted: tuple[Requirement, ...],
        values: Mapping[str, float],
        watch: AutopilotWatch,
        now_s: float,
        host_s: float,
    ) -> str:
        """Why the autopilot does not use the estimate, or would not; empty if nothing is known against it.

        ``values`` are the parameters that were read; ``now_s`` is fleet time, ``host_s`` that of the messages.
        """
        if phase is not FeedPhase.FEEDING:
            self._began_s = self._refused_since_s = self._apart_since_s = None
        elif self._began_s is None:
            self._began_s = now_s
        needed = [(each, value) for each, value in unmet(wanted, values) if each.needed]
        if needed:
            each, value = needed[0]
            return f"parameter {each.name} is {value:g}, not {each.wanted}"
        if self._began_s is None or not self._is_unused(watch, now_s, host_s):
            return ""
        return self._why(flavour, wanted, values, watch, now_s, host_s)

    def _is_unused(self, watch: AutopilotWatch, now_s: float, host_s: float) -> bool:
        """Whether flags, innovations or position say so, after it had time to begin."""
        assert self._began_s is not None
        word = watch.word
        known = word is not None and host_s - word.host_s <= SILENT_S
        unaided = known and word is not None and not word.aided
        refused = known and word is not None and word.position_ratio > REFUSED_RATIO
        self._refused_since_s = _since(self._refused_since_s, refused or unaided, now_s)
        self._apart_since_s = _since(self._apart_since_s, self._apart_m(watch) > APART_M, now_s)
        if now_s - self._began_s < PATIENCE_S:
            return False
        return any(
            since_s is not None and now_s - since_s >= PATIENCE_S / 2
            for since_s in (self._refused_since_s, self._apart_since_s)
        )

    def _apart_m(self, watch: AutopilotWatch) -> float:
        """How far its own position is from what it was given last, horizontally; 0 if not known."""
        if not self._sent:
            return 0.0
        now_s, age_s, position_m = self._sent[-1]
        own_m = watch.own_at(now_s - age_s)
        return 0.0 if own_m is None else float(np.hypot(*(own_m - position_m)[:2]))

    def _why(
        self,
        flavour: str,
        wanted: tuple[Requirement, ...],
        values: Mapping[str, float],
        watch: AutopilotWatch,
        now_s: float,
        host_s: float,
    ) -> str:
        """The likeliest cause, the surest first."""
        fewest_hz, rate_hz = FEWEST_HZ.get(flavour, 0.0), self.rate_hz(now_s)
        if rate_hz < fewest_hz:
            return f"rate {rate_hz:.1f} Hz, {fewest_hz:g} needed"
        age_s = max((age for _, age, _ in self._sent), default=0.0)
        name, unit_s = OLD_S.get(flavour, ("", 0.0))
        if name in values and age_s > values[name] * unit_s:
            return f"delay: estimates are {age_s:.2f} s old, {name} is {values[name]:g}"
        if watch.origin_is_wrong(host_s):
            return f"origin: its global and local positions are {watch.apart_m:.0f} m apart by the one we know"
        for _, text in reversed(watch.texts):
            if any(word in text.lower() for word in TEXTS_ABOUT_US):
                return f'frame: it says "{text}"'
        if watch.word is not None and watch.word.position_ratio > REFUSED_RATIO:
            return f"variance: innovations are {watch.word.position_ratio:.1f} times what it takes"
        worse = unmet(wanted, values)
        if worse:
            each, value = worse[0]
            return f"parameter {each.name} is {value:g}, not {each.wanted}"
        return "frame: messages come in time and are dropped without a word"

    def rate_hz(self, now_s: float) -> float:
        """Of what was sent of late."""
        sent = [each for each in self._sent if now_s - each[0] <= SILENT_S]
        if len(sent) < 2:
            return 0.0
        return (len(sent) - 1) / (max(now_s, sent[-1][0]) - sent[0][0])


def _since(since_s: float | None, is_so: bool, now_s: float) -> float | None:
    """Since when something is so."""
    if not is_so:
        return None
    return now_s if since_s is None else since_s
