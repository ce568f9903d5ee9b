"""Where a drone is that has no fixes: its ranges to drones and anchors whose places are known, over the last seconds.

The places are the agent's own estimates of those drones at the ticks of the ranges, the drone's motion is integrated
from its accelerations. The place that results is the prior of the drone's block; the ranges that the window still
holds are not in it.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agent.config.tables import FleetConfig
from agent.fleet.fix_tracks import VELOCITY_SIGMA_MPS
from agent.fleet.lever_arms import LeverArms, Shift
from agent.fleet.motions import MEMORY_TICKS, Motions
from agent.sensing.samples import Triple
from estimators.integrity.finding import Finding
from estimators.integrity.range_location import RangeLocation, RangeLocationMonitor
from estimators.integrity.thresholds import RANGE_MEMORY_TICKS
from estimators.model.gaussian import Prior
from estimators.model.joint_ranges import SharedErrors, locate_jointly
from estimators.model.layout import BodyKind
from estimators.model.limits import target_limits
from estimators.model.measurements import Matrix, Vector
from estimators.model.multilateration import Place, RangeSet, multilaterate
from transport.messages.measurement_body import (
    AnchorRangeMeasurement,
    Measurement,
    OrientationMeasurement,
    RangeMeasurement,
    SightingMeasurement,
)

MAX_RANGES = 48
"""More are thinned out: an attempt must fit into a tick."""
MAX_TARGET_RANGES = 192
"""The same of a target: far ahead of a fleet most is told by how ranges change over a minute."""
MIN_RANGES = 4
MOST_KEPT = 4096
"""Ranges kept of one body; the oldest go first."""
CORRELATED = 4.0
"""On the covariance: the ranges share errors of the other drones' places, and the fit takes them for independent."""

TARGET_SIGMA_M, BENT_M = 15.0, 1.0
"""A target less well known is not one of the state yet; but one that is far away, if the sphere about a drone that a
range leaves it bends by no more than `BENT_M` over its sigma."""
WIDENED = 9.0
"""On the covariance of a target's place by ranges that the window holds as well."""
STANDING_MPS = 3e-4
"""1-sigma per axis of the velocity of a target that is said to be fixed: once nobody sees it any more, it is moved on
by 2 cm a minute at most."""
TARGET_BIAS_M = 0.5
"""1-sigma of the bias of ranges to it, which all share."""

_Place = tuple[Vector, Matrix]
"""Mean ``(6,)`` and position covariance ``(3, 3)``."""
_Known = dict[int, _Place]
"""By agent."""
_Usable = tuple[RangeMeasurement | AnchorRangeMeasurement, int | Triple, _Place]
"""A range, the agent or anchor at its other end, and where that was."""


class RangeLocator:
    """Keeps ranges and known places of the last `MEMORY_TICKS`; ``motions`` is fed by its owner."""

    def __init__(self, config: FleetConfig, motions: Motions) -> None:
        self._period_s = config.fleet.period_s
        self._ranges: defaultdict[int, deque[RangeMeasurement | AnchorRangeMeasurement]] = defaultdict(
            lambda: deque(maxlen=MOST_KEPT)
        )
        """By the body at either end."""
        self._motions = motions
        self._arms = LeverArms(config)
        self._known: dict[int, _Known] = {}
        self._monitor = RangeLocationMonitor()
        self._kinds = config.kinds
        self._target_limits = target_limits(config.estimator)
        self.findings: dict[int, tuple[Finding, ...]] = {}
        """Why a drone's ranges did not locate it, as of the last attempt."""

    def note(self, record: Measurement) -> None:
        """Take in a record, own or heard."""
        if isinstance(record, RangeMeasurement | AnchorRangeMeasurement):
            self._ranges[record.observer].append(record)
            if isinstance(record, RangeMeasurement):
                self._ranges[record.other].append(record)
        elif isinstance(record, OrientationMeasurement):
            self._arms.note(record)

    def note_places(self, tick: int, known: _Known) -> None:
        """Take in where the located drones are at a tick, and forget what is old."""
        self._known[tick] = known
        oldest = tick - MEMORY_TICKS
        for old in [each for each in self._known if each < oldest]:
            del self._known[old]
        self._arms.forget(oldest)
        for ranges in self._ranges.values():
            while ranges and ranges[0].tick < oldest:
                ranges.popleft()

    def place(self, agent_id: int, at_tick: int) -> Prior | None:
        """The prior of a drone at a tick from its ranges before that tick; ``None`` if they leave it open."""
        return self._taken(agent_id, self._fit(agent_id, at_tick, at_tick), self._monitor, CORRELATED)

    def place_target(self, target_id: int, at_tick: int, until_tick: int) -> Prior | None:
        """The prior of a target at a tick from its ranges before a later one; ``None`` if they leave it open.

        The window holds the ranges after ``at_tick`` too. So the prior is so wide that they hardly count twice: it
        says where to begin, and the window says the rest.
        """
        seen = self._seen(target_id, at_tick, until_tick)
        if seen is not None:
            self.findings[target_id] = ()
            return seen
        found = self._fit(target_id, at_tick, until_tick)
        return self._taken(target_id, found, self._target_monitor(found), WIDENED)

    def _target_monitor(self, place: Place | None) -> RangeLocationMonitor:
        """It has to be known so well that its ranges can be linearised about where it is found."""
        if place is None or not self._known:
            return RangeLocationMonitor(TARGET_SIGMA_M)
        latest = self._known[max(self._known)].values()
        away_m = min((float(np.linalg.norm(place.mean[:3] - mean[:3])) for mean, _ in latest), default=0.0)
        return RangeLocationMonitor(max(TARGET_SIGMA_M, float(np.sqrt(2.0 * away_m * BENT_M))))

    def _seen(self, target_id: int, at_tick: int, until_tick: int) -> Prior | None:
        """The prior of a target seen with its distance in one of the last ticks, from the latest of these."""
        sightings = [
            (record, place)
            for record in self._ranges[target_id]
            if isinstance(record, SightingMeasurement) and record.other == target_id and not record.is_bearing
            and until_tick - RANGE_MEMORY_TICKS <= record.tick < until_tick
            and (place := self._known.get(record.tick, {}).get(record.observer)) is not None
        ]  # fmt: skip
        latest = max((record.tick for record, _ in sightings), default=None)
        information, vector = np.zeros((3, 3)), np.zeros(3)
        for record, (mean, covariance) in sightings:
            if record.tick != latest:
                continue
            sight = np.array(record.direction)
            along = np.outer(sight, sight)
            noise = record.variance_m2 * along + record.variance_across_m2 * (np.eye(3) - along)
            weight = np.linalg.inv(covariance + noise + TARGET_BIAS_M**2 * np.eye(3))
            information += weight
            vector += weight @ (mean[:3] + record.offset_s * mean[3:] + record.range_m * sight)
        if latest is None:
            return None
        standing = self._kinds.get(target_id) is BodyKind.ANCHOR
        speed_mps = STANDING_MPS if standing else VELOCITY_SIGMA_MPS
        found = np.linalg.inv(information)
        if np.linalg.eigvalsh(found)[-1] > TARGET_SIGMA_M**2:
            return None
        spread, passed_s = np.zeros((6, 6)), abs(latest - at_tick) * self._period_s
        spread[:3, :3], spread[3:, 3:] = WIDENED * found, speed_mps**2 * np.eye(3)
        spread[:3, :3] += (passed_s * speed_mps) ** 2 * np.eye(3)
        return np.concatenate((found @ vector, np.zeros(3))), spread

    def _taken(
        self, agent_id: int, found: Place | None, monitor: RangeLocationMonitor, inflation: float
    ) -> Prior | None:
        self.findings[agent_id] = ()
        if found is None:
            return None
        self.findings[agent_id] = monitor.observe(RangeLocation(found.fits, len(found.rivals), found.sigma_m))
        return None if self.findings[agent_id] else (found.mean, inflation * found.covariance)

    def _fit(self, agent_id: int, at_tick: int, until_tick: int) -> Place | None:
        """At ``at_tick``, by the ranges before ``until_tick``."""
        usable = self._usable(agent_id, until_tick)
        if len(usable) < MIN_RANGES or until_tick - usable[-1][0].tick > RANGE_MEMORY_TICKS:
            return None
        ranges = self._range_set(agent_id, at_tick, usable)
        ends = [other for _, other, _ in usable]
        along_m2 = np.array([np.linalg.eigvalsh(covariance)[-1] for _, _, (_, covariance) in usable])
        kind = self._kinds.get(agent_id)
        if kind is None:
            # an error that all ranges to a drone share does not average out over their number
            count = Counter(ends)
            shared_m2 = along_m2 * [count[other] for other in ends]
            return multilaterate(replace(ranges, variance_m2=ranges.variance_m2 + shared_m2), VELOCITY_SIGMA_MPS)
        known = {other: covariance for _, other, (_, covariance) in usable}
        at = {other: place for place, other in enumerate(known)}
        shared = SharedErrors(np.array([at[each] for each in ends]), np.array(list(known.values())), TARGET_BIAS_M**2)
        # a drone's place is off by an error that lasts, and by one that does not
        ranges = replace(ranges, variance_m2=ranges.variance_m2 + along_m2)
        speed_mps = STANDING_MPS if kind is BodyKind.ANCHOR else VELOCITY_SIGMA_MPS
        return locate_jointly(ranges, shared, speed_mps, self._target_limits)

    def _usable(self, agent_id: int, until_tick: int) -> list[_Usable]:
        """Its ranges before a tick whose other ends are known, the oldest first, thinned out."""
        usable = [
            (record, other, place)
            for record in self._ranges[agent_id]
            if record.tick < until_tick
            and not isinstance(record, SightingMeasurement)
            and (place := self._place_of(record, other := _other_end(record, agent_id))) is not None
        ]
        usable.sort(key=lambda each: each[0].tick)
        if agent_id not in self._kinds:
            return usable[::-1][:: -(-len(usable) // MAX_RANGES) or 1][::-1]
        if len(usable) <= MAX_TARGET_RANGES:
            return usable
        evenly = np.linspace(0.0, len(usable) - 1.0, MAX_TARGET_RANGES)
        return [usable[each] for each in evenly.round().astype(int).tolist()]

    def _range_set(self, agent_id: int, at_tick: int, usable: Sequence[_Usable]) -> RangeSet:
        """Ranges of a drone or target relative to a tick; the variances are without those of their other ends."""
        moved, wandered = self._motions.before(agent_id, at_tick)
        anchors, leads, shifts, values, variances = [], [], [], [], []
        for record, other, (mean, _) in usable:
            back = at_tick - record.tick
            shift = self._arms.shift(record) if isinstance(record, RangeMeasurement) else Shift()
            side = 1.0 if record.observer == other else -1.0
            anchors.append(mean[:3] + record.offset_s * mean[3:] + side * np.array(shift.arm_m))
            leads.append(record.offset_s - back * self._period_s)
            shifts.append(moved[abs(back)])  # of a target, which alone has ranges after the tick, nothing is told
            values.append(record.range_m)
            variances.append(record.variance_m2 + shift.variance_m2 + wandered[abs(back)])
        return RangeSet(*(np.array(column) for column in (anchors, leads, shifts, values, variances)))

    def _place_of(self, record: RangeMeasurement | AnchorRangeMeasurement, other: int | Triple) -> _Place | None:
        """The other end of a range at its tick, if that is known."""
        if isinstance(record, AnchorRangeMeasurement):
            return np.array((*record.anchor_m, 0.0, 0.0, 0.0)), np.zeros((3, 3))
        return self._known.get(record.tick, {}).get(record.other if other == record.other else record.observer)


def _other_end(record: RangeMeasurement | AnchorRangeMeasurement, agent_id: int) -> int | Triple:
    """The agent, or the place of the anchor, at the other end of a range of an agent."""
    if isinstance(record, AnchorRangeMeasurement):
        return record.anchor_m
    return record.other if record.observer == agent_id else record.observer
