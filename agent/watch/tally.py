"""What a drone's health said over a flight, counted: alarms, doubts, what was not used. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from agent.watch.health import Health
from estimators.integrity.finding import What

DOUBTS = frozenset({
    What.UNKNOWN, What.UNCERTAIN, What.AMBIGUOUS, What.TOO_FEW_RANGED, What.ONE_PLANE, What.MIRRORED,
    What.NOT_OBSERVABLE, What.UNDERSTATED, What.ELSEWHERE, What.REVERSED, What.CONTRADICTORY, What.FIXES_CONTRADICT,
    What.SOMEBODY_OFF, What.DIVERGED, What.BOUNDS_BROKEN, What.LATENCY,
})  # fmt: skip
"""Whether the position is what it is said to be."""
REFUSALS = frozenset({
    What.DISAGREES, What.OTHER_VERSION, What.FIXES_IGNORED, What.RECEIVER_FROZEN, What.RECEIVER_OFF, What.RANGES_OFF,
    What.IMPOSSIBLE, What.FIX_REFUSED,
})  # fmt: skip
"""Something came and was not used, or not believed."""


@dataclass(slots=True)
class Said:
    """In how many ticks something was said, and when first and last."""

    ticks: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    about: set[int] = field(default_factory=set)

    def add(self, t_s: float, about: int | None = None) -> None:
        """It was said once more."""
        self.first_s = t_s if self.ticks == 0 else self.first_s
        self.ticks, self.last_s = self.ticks + 1, t_s
        if about is not None:
            self.about.add(about)

    def figures(self, zero_s: float) -> dict[str, Any]:
        """For ``report.json``, times from ``zero_s`` on (``None``: never); ``about`` are ids of other drones."""
        first_s, last_s = (self.first_s - zero_s, self.last_s - zero_s) if self.ticks else (None, None)
        return {"ticks": self.ticks, "first_s": first_s, "last_s": last_s, "about": sorted(self.about)}


class HealthTally:
    """Counts what a drone's health says, tick by tick; times are fleet time."""

    def __init__(self) -> None:
        self._alarm = Said()
        self._said: dict[What, Said] = {}

    def add(self, health: Health, t_s: float) -> None:
        """The health with the estimate of a tick."""
        if health.alarm:
            self._alarm.add(t_s)
        told: dict[What, int | None] = {}
        for finding in health.findings:
            told.setdefault(finding.what, finding.about)
            if finding.about is not None and finding.what in self._said:
                self._said[finding.what].about.add(finding.about)
        for what, about in told.items():
            self._said.setdefault(what, Said()).add(t_s, about)

    def figures(self, zero_s: float) -> dict[str, Any]:
        """``alarm``, ``doubts``, ``refusals`` and ``other``: what was said, by its name."""
        groups = {"doubts": DOUBTS, "refusals": REFUSALS}
        sorted_said = sorted(self._said.items(), key=lambda each: each[0].value)
        found: dict[str, Any] = {
            group: {what.name.lower(): spell.figures(zero_s) for what, spell in sorted_said if what in kinds}
            for group, kinds in groups.items()
        }
        found["other"] = {
            what.name.lower(): spell.figures(zero_s)
            for what, spell in sorted_said
            if what not in DOUBTS | REFUSALS
        }
        return {"alarm": self._alarm.figures(zero_s)} | found
