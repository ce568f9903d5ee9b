"""How an agent is, in words: one state, the reasons for it, and when it changed. Sans-I/O.

Nothing is judged here: state and reasons follow from what the monitors found (`agent.watch.position_watch`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum

from estimators.integrity.finding import Finding, Gravity, What

MAX_NAMED = 8
"""Silent neighbours named in a reason; of more, their number."""
REPORT_PERIOD_S = 1.0
"""A state that flaps is reported no more often than this; what is reported is the latest."""


class State(StrEnum):
    """What an estimate may be used for."""

    INIT = "init"
    """No estimate yet."""
    ALIGNING = "aligning"
    """Started, not yet sure enough."""
    OK = "ok"
    DEGRADED = "degraded"
    """Usable; something that should be there is not."""
    FAULT = "fault"
    """Not to be used."""


_STATES = {
    Gravity.NOTED: State.OK,
    Gravity.DEGRADED: State.DEGRADED,
    Gravity.ALARM: State.DEGRADED,
    Gravity.NOT_YET: State.ALIGNING,
    Gravity.UNUSABLE: State.FAULT,
    Gravity.ABSENT: State.INIT,
}
_UNOBSERVABLE = (What.AMBIGUOUS, What.TOO_FEW_RANGED, What.ONE_PLANE, What.MIRRORED, What.NOT_OBSERVABLE)
"""Of these the first that was found is told: the later ones follow from it, or say the same less exactly."""
_TEXTS = {
    What.CLOCK: "{0.detail}",
    What.DISAGREES: "{0.about} refused, differs in {0.detail}",
    What.DOUBLED: "another daemon runs with our id, says {0.detail}",
    What.HEARD_TWICE: "two daemons run as {0.about}",
    What.OTHER_VERSION: "{0.about} refused, talks version {0.value:.0f} of the packets, not {0.limit:.0f}",
    What.NOT_FUSED: "autopilot does not fuse: {0.detail}",
    What.NOT_FED: "autopilot not fed: {0.detail}",
    What.NOT_READY: "autopilot could not be fed: {0.detail}",
    What.GPS_BACK_WRONG: "autopilot's GPS is back {0.value:.0f} m off",
    What.NO_ESTIMATE: "{0.detail}",
    What.NOT_ALIGNED: "",
    What.FELL_BACK: "estimate fell back",
    What.NO_DATA: "estimate no data",
    What.UNKNOWN: "position unknown",
    What.UNCERTAIN: "position uncertain",
    What.AMBIGUOUS: "not observable: the ranges leave more than one place",
    What.TOO_FEW_RANGED: "not observable: ranges to {0.value:.0f} located neighbours, {0.limit:.0f} needed",
    What.ONE_PLANE: "not observable: all located neighbours in one plane",
    What.MIRRORED: "not observable",
    What.NOT_OBSERVABLE: "not observable",
    What.UNDERSTATED: "position less sure than said",
    What.ELSEWHERE: "position moved to another place",
    What.REVERSED: "fleet turned to its mirror image",
    What.CONTRADICTORY: "no place explains the measurements",
    What.FIXES_CONTRADICT: "{0.detail} contradict the rest",
    What.FIXES_IGNORED: "{0.detail} contradict the rest, not used",
    What.RECEIVER_FROZEN: "{0.detail} frozen: they repeat, and the drone moves",
    What.RECEIVER_OFF: "{0.detail} off by {0.value:.0f} m, as ranges say",
    What.RANGES_OFF: "{0.detail} off by {0.value:.0f} m",
    What.SOMEBODY_OFF: "fixes of somebody off, not told whose",
    What.DIVERGED: "estimate of {0.about} outside its guaranteed set",
    What.BOUNDS_BROKEN: "stated bounds broken: {0.detail}",
    What.IMPOSSIBLE: "{0.detail} impossible, off by {0.value:.0f}, not used",
    What.BEGUN_ANEW: "estimate given up and begun anew, {0.detail}",
    What.AUTOPILOT: "autopilot {0.detail}",
    What.SLOW_STREAM: "autopilot sends {0.detail}",
    What.IMU_GAP: "IMU incomplete",
    What.UNAIDED: "attitude without aiding",
    What.NO_FIX: "no GPS",
    What.NOT_RECORDED: "not recorded: {0.detail}",
    What.SILENT: "not heard: {0}",
    What.LATENCY: "latency of GPS not known",
    What.FIX_REFUSED: "fix refused",
}
"""Fields are those of the finding; of the silent neighbours, their ids."""


@dataclass(frozen=True, slots=True)
class Health:
    """A state with its reasons, the gravest first."""

    state: State
    reasons: tuple[str, ...]
    alarm: bool = False
    """Whether the own position may be wrong without the covariance saying so: without GPS, and not held by ranges."""
    findings: tuple[Finding, ...] = field(default=(), compare=False, repr=False)
    """What it follows from."""

    def __str__(self) -> str:
        state = f"ALARM, {self.state}" if self.alarm else str(self.state)
        return f"{state}: {'; '.join(self.reasons)}" if self.reasons else state


def assess(findings: Iterable[Finding]) -> Health:
    """The health that follows from findings; its reasons in their order."""
    findings = _with_causes(list(findings))
    told = [finding for finding in findings if finding.gravity > Gravity.NOTED]
    gravest = max((finding.gravity for finding in told), default=Gravity.NOTED)
    alarm = any(finding.gravity is Gravity.ALARM for finding in told)
    return Health(_STATES[gravest], _reasons(told), alarm, tuple(told))


def _with_causes(findings: list[Finding]) -> list[Finding]:
    """The same with slow streams in place of the IMU that is incomplete because of them."""
    slow = any(finding.what is What.SLOW_STREAM for finding in findings)
    if not slow or not any(finding.what is What.IMU_GAP for finding in findings):
        return findings
    return [
        replace(finding, gravity=max(finding.gravity, Gravity.DEGRADED))
        if finding.what is What.SLOW_STREAM
        else finding
        for finding in findings
        if finding.what is not What.IMU_GAP
    ]


def reason_of(finding: Finding) -> str:
    """One finding in words."""
    return _TEXTS[finding.what].format(finding.about if finding.what is What.SILENT else finding)


def _reasons(findings: list[Finding]) -> tuple[str, ...]:
    """In words, the silent neighbours together in one reason."""
    unobservable = [what for what in _UNOBSERVABLE if any(finding.what is what for finding in findings)]
    silent = [finding.about for finding in findings if finding.what is What.SILENT and finding.about is not None]
    reasons = [
        _TEXTS[finding.what].format(finding)
        for finding in findings
        if finding.what is not What.SILENT and finding.what not in unobservable[1:]
    ]
    if silent:
        reasons.append(_TEXTS[What.SILENT].format(_listed(silent)))
    return tuple(reason for reason in reasons if reason)


def _listed(agents: list[int]) -> str:
    """Ids, of many the first ones: a reason has to fit into a packet."""
    named = ", ".join(map(str, agents[:MAX_NAMED]))
    return named if len(agents) <= MAX_NAMED else f"{named}, ... and {len(agents) - MAX_NAMED} more"


class HealthMonitor:
    """Keeps the health and tells when it changed, rate-limited; ``changes`` counts all of them."""

    def __init__(self) -> None:
        self.health = Health(State.INIT, ())
        self.changes = 0
        self._held: tuple[Finding, ...] = ()
        self._reported = self.health
        self._next_report_s = float("-inf")

    def hold(self, findings: tuple[Finding, ...]) -> None:
        """Findings that no tick brings, of clock and agreement: they come first, until others are held."""
        self._held = findings

    def update(self, findings: tuple[Finding, ...], now_s: float) -> Health | None:
        """Take in what a tick brought; the health if there is a change to be reported now."""
        health = assess((*self._held, *findings))
        self.changes += health != self.health
        self.health = health
        if health == self._reported or now_s < self._next_report_s:
            return None
        self._reported = health
        self._next_report_s = now_s + REPORT_PERIOD_S
        return health
