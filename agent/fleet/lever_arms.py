"""Where the UWB antennas of the drones are beside their bodies when a range is taken.

A range between antennas at ``l_i`` and ``l_j`` in body axes is ``|p_i + R_i l_i - p_j - R_j l_j|``: of the state and
of how both drones lie. The second is data. Every drone with antennas off its IMU says once a tick how it lies and
turns (`OrientationMeasurement`); the arms are in the configuration, which all share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from agent.config.tables import AgentTable, FleetConfig
from agent.sensing.frames import rotated
from agent.sensing.samples import Quaternion, Triple
from agent.sensing.timeline import Orientation
from transport.messages.measurement_body import OrientationMeasurement, RangeMeasurement, TagRangeMeasurement

AT_BODY: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Shift:
    """Arm of a range's observer less that of its other end, NED m; variance of what is not known of it, m2."""

    arm_m: Triple = AT_BODY
    variance_m2: float = 0.0


class LeverArms:
    """The antennas of all drones, and how the drones lay at the ticks of late."""

    def __init__(self, config: FleetConfig) -> None:
        self._tags = {agent.id: agent.uwb_tags_m for agent in config.agents if has_arms(agent)}
        self._orientations: dict[int, dict[int, OrientationMeasurement]] = {}
        """By tick and agent."""

    def note(self, record: OrientationMeasurement) -> None:
        """Take in how a drone lies, own or heard."""
        self._orientations.setdefault(record.tick, {})[record.observer] = record

    def forget(self, before_tick: int) -> None:
        """Let go what is older."""
        for tick in [t for t in self._orientations if t < before_tick]:
            del self._orientations[tick]

    def knows(self, record: RangeMeasurement) -> bool:
        """Whether it is known how both ends lay, as far as that matters."""
        return not self._tags or not self._unknown(record)

    def shift(self, record: RangeMeasurement) -> Shift:
        """What the antennas make of a range. An arm whose direction is not known points anywhere."""
        if not self._tags:
            return Shift()
        unknown = self._unknown(record)
        tag, other_tag = tags_of(record)
        total, variance_m2 = AT_BODY, 0.0
        for agent, index, sign in ((record.observer, tag, 1.0), (record.other, other_tag, -1.0)):
            arm = self._arm(agent, index)
            if agent in unknown:
                variance_m2 += math.hypot(*arm) ** 2 / 3.0
            elif any(arm):
                turned = turned_arm(self._orientations[record.tick][agent], arm, record.offset_s)
                total = (total[0] + sign * turned[0], total[1] + sign * turned[1], total[2] + sign * turned[2])
        return Shift(total, variance_m2)

    def _unknown(self, record: RangeMeasurement) -> set[int]:
        """Ends with an arm of which it is not known how they lay."""
        tag, other_tag = tags_of(record)
        known = self._orientations.get(record.tick, {})
        ends = (record.observer, tag), (record.other, other_tag)
        return {agent for agent, index in ends if agent not in known and any(self._arm(agent, index))}

    def _arm(self, agent: int, tag: int) -> Triple:
        arms = self._tags.get(agent, ())
        return arms[tag] if tag < len(arms) else AT_BODY


def has_arms(agent: AgentTable) -> bool:
    """Whether a UWB antenna of a drone is off its IMU, so that others have to know how it lies."""
    return any(any(arm) for arm in agent.uwb_tags_m)


def own_arm(agent: AgentTable, tag: int, orientation: Orientation | None) -> Shift:
    """A drone's own arm where it lies as given, for ranges that need no other drone's; unknown without that."""
    arm = agent.uwb_tags_m[tag] if tag < len(agent.uwb_tags_m) else AT_BODY
    if orientation is None:
        return Shift(variance_m2=math.hypot(*arm) ** 2 / 3.0)
    return Shift(rotated(orientation.quaternion, arm))


def tags_of(record: RangeMeasurement) -> tuple[int, int]:
    """The antennas of a range: the observer's, the other's."""
    return (record.tag, record.other_tag) if isinstance(record, TagRangeMeasurement) else (0, 0)


def orientation_measurement(observer: int, tick: int, orientation: Orientation) -> OrientationMeasurement:
    """The record of how a drone lies at the start of a tick."""
    rate = rotated(orientation.quaternion, orientation.rate_radps)
    return OrientationMeasurement(observer, tick, _rotation_vector(orientation.quaternion), rate)


def turned_arm(record: OrientationMeasurement, arm_m: Triple, offset_s: float) -> Triple:
    """An arm in NED so much after the start of the record's tick."""
    still = rotated(_quaternion(record.rotation_rad), arm_m)
    rate = record.rate_radps
    return rotated(_quaternion((rate[0] * offset_s, rate[1] * offset_s, rate[2] * offset_s)), still)


def _rotation_vector(quaternion: Quaternion) -> Triple:
    """Of a unit quaternion, at most pi long."""
    w, *vector = quaternion
    sine = math.hypot(*vector)
    if sine == 0.0:
        return AT_BODY
    angle = 2.0 * math.atan2(sine, abs(w))
    scale = math.copysign(angle / sine, w)
    return vector[0] * scale, vector[1] * scale, vector[2] * scale


def _quaternion(rotation_rad: Triple) -> Quaternion:
    """The unit quaternion of a rotation vector."""
    angle = math.hypot(*rotation_rad)
    scale = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
    return math.cos(0.5 * angle), rotation_rad[0] * scale, rotation_rad[1] * scale, rotation_rad[2] * scale
