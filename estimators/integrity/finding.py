"""What a monitor finds, and the one shape that all monitors have.

A monitor looks at the evidence of a tick, plain values, and returns what it finds: of what kind, about whom, how
grave, and the figure that it follows from. No finding means that nothing is wrong. Whoever shows findings to people
makes the words.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import Protocol, TypeVar


class What(Enum):
    """What may be wrong with a position, in the order in which it is told."""

    CLOCK = auto()
    """The clock is outside the fleet's time: nothing can be sent."""
    DISAGREES = auto()
    """A drone was given something else of what the fleet has to share: its packets are refused."""
    DOUBLED = auto()
    """Another daemon runs with the own id."""
    HEARD_TWICE = auto()
    """Two daemons send as one drone; one of them is refused."""
    OTHER_VERSION = auto()
    """A drone's packets are of another version: they cannot be read."""
    NOT_FUSED = auto()
    """The autopilot does not use the estimate that it is given, or would not."""
    NOT_FED = auto()
    """The autopilot has no GPS, and the estimate is withheld from it."""
    NOT_READY = auto()
    """The estimate could not be given to the autopilot if its GPS were lost."""
    GPS_BACK_WRONG = auto()
    """The autopilot's GPS is back, somewhere else."""
    NO_ESTIMATE = auto()
    NOT_ALIGNED = auto()
    """The estimate has never been sure enough since its start."""
    FELL_BACK = auto()
    """The solver failed; the value is a prediction."""
    NO_DATA = auto()
    """Nothing was measured or received; the value is a prediction."""
    UNKNOWN = auto()
    """The covariance says that the position is of no use."""
    UNCERTAIN = auto()
    """The covariance says that the position is poor."""
    AMBIGUOUS = auto()
    """The ranges leave more than one place."""
    TOO_FEW_RANGED = auto()
    """Ranges to too few located drones."""
    ONE_PLANE = auto()
    """The located drones that are ranged to lie in one plane with the drone: its mirror image fits as well."""
    MIRRORED = auto()
    """The whole fleet may be its own mirror image."""
    NOT_OBSERVABLE = auto()
    """What was measured does not say where the drone is."""
    UNDERSTATED = auto()
    """The position may be further off than its covariance says."""
    ELSEWHERE = auto()
    """The data hold to another place than the estimate."""
    REVERSED = auto()
    """The fleet turned out to be the mirror image of the estimate."""
    CONTRADICTORY = auto()
    """No place explains the measurements."""
    FIXES_CONTRADICT = auto()
    """A drone's fixes and the rest of what was measured do not fit together."""
    FIXES_IGNORED = auto()
    """A drone's fixes do not fit the rest, and the position has been held without them for a while."""
    RECEIVER_FROZEN = auto()
    """A drone's receiver repeats one fix although the drone moves."""
    RECEIVER_OFF = auto()
    """A drone's fixes are shifted: they do not fit the ranges to the others, whose fixes do."""
    RANGES_OFF = auto()
    """The ranges of a pair, or all of a drone, do not fit the fixes and the other ranges."""
    SOMEBODY_OFF = auto()
    """Somebody's fixes are shifted, and it cannot be told whose."""
    DIVERGED = auto()
    """The estimate of a neighbour's relative position is outside the set that certainly holds it."""
    BOUNDS_BROKEN = auto()
    """Bounds that sensors are said to keep contradict each other: what is certain of a neighbour is not."""
    IMPOSSIBLE = auto()
    """A drone measured what cannot be: it is out of all reach of the estimate."""
    BEGUN_ANEW = auto()
    """The estimate was given up, after faults or against its own fixes, and begun from nothing."""
    AUTOPILOT = auto()
    """The link to the autopilot is not there."""
    SLOW_STREAM = auto()
    """The autopilot sends what every tick needs less often than it was asked to."""
    IMU_GAP = auto()
    """The IMU was silent for a part of the tick."""
    UNAIDED = auto()
    """The autopilot's attitude is that of an estimator without positions: it tilts."""
    NO_FIX = auto()
    """No position fix of late."""
    NOT_RECORDED = auto()
    """The flight is not taken down as it should be: the disk refuses."""
    SILENT = auto()
    """A drone that should be heard is not."""
    LATENCY = auto()
    """When the fixes were taken is known less well than where: their error is that of the latency."""
    FIX_REFUSED = auto()
    """A fix is where the drone cannot have been."""


class Gravity(IntEnum):
    """What follows from a finding for the use of the own position."""

    NOTED = 0
    """Nothing; it is kept for whoever looks for causes."""
    DEGRADED = 1
    """Usable; something that should be there is not."""
    ALARM = 2
    """The position may be wrong without its covariance saying so."""
    NOT_YET = 3
    """Not sure enough yet to be used."""
    UNUSABLE = 4
    ABSENT = 5
    """There is no position."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that a monitor found; monitors that can say more about what follows return a subclass."""

    what: What
    gravity: Gravity
    about: int | None = None
    """Whose position or data: a slot inside an estimator, an id elsewhere; ``None``: the own one."""
    value: float | None = None
    """The figure that it follows from, in the unit of its limit; ``None`` where there is none."""
    limit: float | None = None
    """What the figure was held against (`estimators.integrity.thresholds`)."""
    detail: str = ""
    """In a word or two what no figure says, as the state of a link."""


EvidenceT_contra = TypeVar("EvidenceT_contra", contravariant=True)


class Monitor(Protocol[EvidenceT_contra]):
    """Looks at the evidence of a tick; what it remembers from tick to tick is its own."""

    def observe(self, evidence: EvidenceT_contra) -> tuple[Finding, ...]:
        """What is wrong; empty if nothing is."""
        ...


def has(findings: Iterable[Finding], what: What) -> bool:
    """Whether something was found."""
    return any(finding.what is what for finding in findings)
