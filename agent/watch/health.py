"""How an agent is: one state, the reasons for it, and when it changed. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from estimators.estimator import Status

GPS_LOST_S = 1.5
MIN_IMU_COVERAGE = 0.9
DEGRADED_SIGMA_M = 5.0
FAULT_SIGMA_M = 50.0
ALIGNED_SIGMA_M = 2.0
DIRECTIONS = 3
"""Neighbours, and directions to them, that hold a drone without GPS."""
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


@dataclass(frozen=True, slots=True)
class Facts:
    """What the state follows from; ``None`` where there is nothing to be said yet."""

    status: Status | None
    """Of the latest estimate; ``None`` before the start."""
    own_sigma_m: float
    """Largest 1-sigma of the own position's axes."""
    gps_age_s: float | None
    """Since the last own fix."""
    imu_coverage: float
    """Share of the latest tick that the IMU vouches for."""
    silent_neighbours: tuple[int, ...]
    """Configured neighbours not heard of lately."""
    autopilot: str
    """State of the autopilot's link."""
    waiting_for: str = ""
    """What the start waits for."""
    located_neighbours: int = 0
    """Neighbours whose place is known and which are ranged; of interest, and counted, without GPS only."""
    directions: int = 0
    """Directions of space (0..3) that the ranges to them hold: less than 3 where all lie in one plane with us."""
    ambiguous: bool = False
    """Whether the ranges leave more than one place."""


@dataclass(frozen=True, slots=True)
class Health:
    """A state with its reasons, the gravest first."""

    state: State
    reasons: tuple[str, ...]
    alarm: bool = False
    """Whether the own position may be wrong without the covariance saying so: without GPS, and not held by ranges."""

    def __str__(self) -> str:
        state = f"ALARM, {self.state}" if self.alarm else str(self.state)
        return f"{state}: {'; '.join(self.reasons)}" if self.reasons else state


def assess(facts: Facts, was: State) -> Health:
    """The health that follows from facts; ``was`` the state before, since alignment is done once."""
    unheld = _unheld(facts)
    health = _assess(facts, was, (*unheld, *_missing(facts)))
    return replace(health, alarm=True) if unheld else health


def _unheld(facts: Facts) -> tuple[str, ...]:
    """Why the own position cannot be observed; empty if it can, or nothing is estimated yet."""
    if facts.status is None or not gps_lost(facts.gps_age_s):
        return ("not observable",) if facts.status is Status.NOT_OBSERVABLE else ()
    if facts.ambiguous:
        return ("not observable: the ranges leave more than one place",)
    if facts.located_neighbours < DIRECTIONS:
        return (f"not observable: ranges to {facts.located_neighbours} of {DIRECTIONS} located neighbours",)
    if facts.directions < DIRECTIONS:
        return ("not observable: all located neighbours in one plane",)
    return ("not observable",) if facts.status is Status.NOT_OBSERVABLE else ()


def _assess(facts: Facts, was: State, missing: tuple[str, ...]) -> Health:
    if facts.status is None:
        return Health(State.INIT, (facts.waiting_for, *missing) if facts.waiting_for else missing)
    if facts.own_sigma_m > FAULT_SIGMA_M and was not in (State.INIT, State.ALIGNING):
        return Health(State.FAULT, ("position unknown", *missing))
    if was in (State.INIT, State.ALIGNING) and facts.own_sigma_m > ALIGNED_SIGMA_M:
        return Health(State.ALIGNING, missing)
    reasons = list(missing)
    if facts.own_sigma_m > DEGRADED_SIGMA_M:
        reasons.insert(0, "position uncertain")
    if facts.status in (Status.FELL_BACK, Status.NO_DATA):
        reasons.insert(0, f"estimate {facts.status.name.lower().replace('_', ' ')}")
    return Health(State.DEGRADED if reasons else State.OK, tuple(reasons))


def _missing(facts: Facts) -> tuple[str, ...]:
    reasons = []
    if facts.autopilot != "connected":
        reasons.append(f"autopilot {facts.autopilot}")
    if facts.imu_coverage < MIN_IMU_COVERAGE:
        reasons.append("IMU incomplete")
    if gps_lost(facts.gps_age_s):
        reasons.append("no GPS")
    if facts.silent_neighbours:
        reasons.append(f"not heard: {_listed(facts.silent_neighbours)}")
    return tuple(reasons)


def _listed(agents: tuple[int, ...]) -> str:
    """Ids, of many the first ones: a reason has to fit into a packet."""
    named = ", ".join(map(str, agents[:MAX_NAMED]))
    return named if len(agents) <= MAX_NAMED else f"{named}, ... and {len(agents) - MAX_NAMED} more"


def gps_lost(gps_age_s: float | None) -> bool:
    """Whether a drone has to do without GPS, by the time since its last fix (``None``: there was none)."""
    return gps_age_s is None or gps_age_s > GPS_LOST_S


def _with_standing(health: Health, standing: tuple[str, ...]) -> Health:
    if not standing:
        return health
    state = State.DEGRADED if health.state is State.OK else health.state
    return replace(health, state=state, reasons=(*standing, *health.reasons))


class HealthMonitor:
    """Keeps the health and tells when it changed, rate-limited; ``changes`` counts all of them."""

    def __init__(self) -> None:
        self.health = Health(State.INIT, ())
        self.changes = 0
        self.standing: tuple[str, ...] = ()
        """Reasons that do not follow from the facts; set by the owner."""
        self._reported = self.health
        self._next_report_s = float("-inf")

    def update(self, facts: Facts, now_s: float) -> Health | None:
        """Take in facts; the health if there is a change to be reported now."""
        health = _with_standing(assess(facts, self.health.state), self.standing)
        self.changes += health != self.health
        self.health = health
        if health == self._reported or now_s < self._next_report_s:
            return None
        self._reported = health
        self._next_report_s = now_s + REPORT_PERIOD_S
        return health
