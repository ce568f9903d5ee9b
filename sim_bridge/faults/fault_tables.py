"""What may go wrong on request, as tables: whose, from when to when, how much.

A ``kind`` is a unit and, after MAVLink's FAILURE_TYPE, how it fails: off, stuck, wrong, drift. The same tables are
flown by the simulator (``[[sim.faults]]``) and laid over recorded flights (`sim_bridge.replay.what_if`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Annotated, Literal

import msgspec

from agent.config.checks import unknown_ids
from agent.config.faults import Fault
from agent.config.fields import AgentId, Fraction, NotNegative, Point, Positive, Table
from agent.config.tables import FleetConfig


class Spell(Table, frozen=True, kw_only=True):
    """A while."""

    from_s: NotNegative = 0.0
    """Since the start of the flight."""
    to_s: Positive | None = None
    """Likewise, later than ``from_s``; absent = to the end."""

    @property
    def end_s(self) -> float:
        """When it is over; infinite for one that lasts."""
        return math.inf if self.to_s is None else self.to_s

    def holds(self, time_s: float) -> bool:
        """Whether a time since the start lies inside, the end excluded."""
        return self.from_s <= time_s < self.end_s


class _OfAgents(Spell, frozen=True, kw_only=True):
    agents: Annotated[tuple[AgentId, ...], msgspec.Meta(min_length=1)]
    """Whose."""


class GpsOff(_OfAgents, frozen=True, kw_only=True, tag_field="kind", tag="gps_off"):
    """No fixes."""


class GpsStuck(_OfAgents, frozen=True, kw_only=True, tag_field="kind", tag="gps_stuck"):
    """The receiver repeats one fix with rising stamps and full confidence."""


class GpsWrong(_OfAgents, frozen=True, kw_only=True, tag_field="kind", tag="gps_wrong"):
    """Positions are off by a constant, as after a jump; velocities are right."""

    offset_m: Point
    """NED."""


class GpsDrift(_OfAgents, frozen=True, kw_only=True, tag_field="kind", tag="gps_drift"):
    """Fixes are dragged away evenly, position and velocity alike, as by a spoofer."""

    rate_mps: Point
    """NED."""


class AccelWrong(_OfAgents, frozen=True, kw_only=True, tag_field="kind", tag="accel_wrong"):
    """Accelerometers with a bias, or that clip: what they say is cut per axis, the bias included."""

    bias_mps2: Point = (0.0, 0.0, 0.0)
    """Body FRD."""
    limit_mps2: Positive | None = None
    """The largest value that an axis can say; below 1 g it is less than gravity. Absent = no limit."""


class OfRanges(Spell, frozen=True, kw_only=True):
    """Of ranges from and to ``agents`` and those of ``pairs``, both ways; of all where neither is given."""

    agents: tuple[AgentId, ...] = ()
    """Whose, both ways."""
    pairs: tuple[tuple[AgentId, AgentId], ...] = ()
    """Between whom, both ways."""

    def hits(self, observer: int, target: int) -> bool:
        """Whether the ranges from one agent to another are among them."""
        if not self.agents and not self.pairs:
            return True
        either = observer in self.agents or target in self.agents
        return either or (observer, target) in self.pairs or (target, observer) in self.pairs


class UwbWrong(OfRanges, frozen=True, kw_only=True, tag_field="kind", tag="uwb_wrong"):
    """Ranges that are too long: by a bias, and some of them as without line of sight.

    It hits the ranges from and to ``agents`` and those of ``pairs``, both ways; all ranges where neither is given.
    """

    bias_m: float = 0.0
    """Of every range."""
    nlos_share: Fraction = 0.0
    """Of the ranges, drawn one by one, that are too long by an exponential besides."""
    nlos_mean_m: Positive = 1.0
    """Its mean."""


class UwbStuck(OfRanges, frozen=True, kw_only=True, tag_field="kind", tag="uwb_stuck"):
    """Modules repeat the first range that they measured of each other since, with fresh stamps.

    It hits the ranges from and to ``agents`` and those of ``pairs``, both ways; all ranges where neither is given.
    """


class UwbSwapped(_OfAgents, frozen=True, kw_only=True, tag_field="kind", tag="uwb_swapped"):
    """The modules of ``agents`` mix up two others: what they measure of one they say of the other."""

    between: tuple[AgentId, AgentId]
    """The two."""


class MemberStuck(_OfAgents, frozen=True, kw_only=True, tag_field="kind", tag="member_stuck"):
    """A zombie: its packets repeat what the last ones before said, with fresh stamps and good signatures."""


class MemberWrong(_OfAgents, frozen=True, kw_only=True, tag_field="kind", tag="member_wrong"):
    """A liar with a good key: its fixes, estimates and information pairs are off as it sends them, and too sure.

    Its own estimate knows nothing of it.
    """

    offset_m: Point
    """NED, of its own fixes and of positions in what it believes."""
    lies_about: Literal["fleet", "itself"] = "fleet"
    """Which positions: those of all drones, or its own."""
    variance_divisor: Positive = 100.0
    """Covariances that it sends are its own over this."""


RangeFault = UwbWrong | UwbStuck | UwbSwapped
SensorFault = GpsOff | GpsStuck | GpsWrong | GpsDrift | AccelWrong | RangeFault
MemberFault = MemberStuck | MemberWrong
FaultTable = SensorFault | MemberFault


def about(fault: FaultTable) -> frozenset[int]:
    """Agents that a fault names; none for one that hits everybody."""
    pairs = fault.pairs if isinstance(fault, OfRanges) else ()
    return frozenset(fault.agents).union(*pairs)


def wrong_settings(faults: Iterable[FaultTable], config: FleetConfig, key: str) -> Iterator[Fault]:
    """What does not go together in them, or with the fleet; ``key`` is that of their array."""
    for index, fault in enumerate(faults):
        yield from _wrong(fault, config, f"{key}[{index}]")


def _wrong(fault: FaultTable, config: FleetConfig, key: str) -> Iterator[Fault]:
    yield from unknown_ids(config, f"{key}.agents", fault.agents)
    if fault.end_s <= fault.from_s:
        yield Fault(f"{key}.to_s", f"later than from_s = {fault.from_s:g}", f"{fault.to_s:g}")
    pairs = {f"{key}.pairs[{number}]": pair for number, pair in enumerate(getattr(fault, "pairs", ()))}
    if isinstance(fault, UwbSwapped):
        pairs[f"{key}.between"] = fault.between
    for where, pair in pairs.items():
        yield from unknown_ids(config, where, pair)
        if pair[0] == pair[1]:
            yield Fault(where, "two different agents", f"{list(pair)}")
    match fault:
        case UwbWrong() if fault.bias_m == 0.0 and fault.nlos_share == 0.0:
            yield Fault(f"{key}.bias_m", "a bias_m or a nlos_share other than 0", "neither")
        case AccelWrong() if not any(fault.bias_mps2) and fault.limit_mps2 is None:
            yield Fault(f"{key}.bias_mps2", "a bias_mps2 other than 0 or a limit_mps2", "neither")
