"""What injected faults make of what sensors say, in the simulated world and in replays alike. Sans-I/O.

Times are seconds since the start of the flight. Random draws happen inside a fault only and come from a generator of
its own, so that a flight with faults is the same flight, noise and all, up to their beginning and beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sim_bridge.faults.fault_tables import (
    AccelWrong,
    FaultTable,
    GpsDrift,
    GpsOff,
    GpsStuck,
    GpsWrong,
    SensorFault,
    UwbStuck,
    UwbSwapped,
    UwbWrong,
)

Array = NDArray[np.float64]
Fix = TypeVar("Fix")

FAULT_STREAM = 11
"""Keeps the draws of faults apart from those of the flight."""


@dataclass(frozen=True, slots=True)
class RangeError:
    """How much a range is too long, and whether for want of a line of sight."""

    extra_m: float = 0.0
    blocked: bool = False


NO_ERROR = RangeError()


class SensorFaults:
    """The faults of a flight that are of sensors; the others among ``faults`` are left to whom they concern."""

    def __init__(self, faults: Sequence[FaultTable], seed: int) -> None:
        self._sensor = [fault for fault in faults if isinstance(fault, SensorFault)]
        self._uwb = [
            (fault, np.random.default_rng([seed, FAULT_STREAM, index]))
            for index, fault in enumerate(faults)
            if isinstance(fault, UwbWrong)
        ]
        self._held: dict[tuple[int, int], Any] = {}
        """The fix that is repeated, by fault and agent."""
        self._held_m: dict[tuple[int, int, int], float] = {}
        """The range that is repeated, by fault, who measures, and whom."""

    def gps_off(self, agent: int, time_s: float) -> bool:
        """Whether a receiver has no fix."""
        return any(_hits(fault, agent, time_s) for fault in self._sensor if isinstance(fault, GpsOff))

    def gps_error(self, agent: int, time_s: float) -> tuple[Array, Array]:
        """How far a receiver's position ``(3,)`` in m and velocity ``(3,)`` in m/s are off, NED."""
        position, velocity = np.zeros(3), np.zeros(3)
        for fault in self._sensor:
            if isinstance(fault, GpsWrong) and _hits(fault, agent, time_s):
                position += fault.offset_m
            elif isinstance(fault, GpsDrift) and _hits(fault, agent, time_s):
                position += (time_s - fault.from_s) * np.array(fault.rate_mps)
                velocity += fault.rate_mps
        return position, velocity

    def repeated(self, agent: int, time_s: float, fix: Fix) -> Fix:
        """What a stuck receiver says instead of a fix: the first one since it stuck; else the fix itself."""
        for number, fault in enumerate(self._sensor):
            if isinstance(fault, GpsStuck) and _hits(fault, agent, time_s):
                held: Fix = self._held.setdefault((number, agent), fix)
                return held
        return fix

    def force(self, agent: int, time_s: float, force_mps2: Array) -> Array:
        """Specific force ``(3,)`` in the body as the accelerometers have it."""
        for fault in self._sensor:
            if isinstance(fault, AccelWrong) and _hits(fault, agent, time_s):
                force_mps2 = force_mps2 + fault.bias_mps2
                if fault.limit_mps2 is not None:
                    force_mps2 = np.clip(force_mps2, -fault.limit_mps2, fault.limit_mps2)
        return force_mps2

    def range_error(self, observer: int, target: int, time_s: float) -> RangeError:
        """What comes on top of a range."""
        error = NO_ERROR
        for fault, rng in self._uwb:
            if fault.holds(time_s) and fault.hits(observer, target):
                blocked = float(rng.random()) < fault.nlos_share
                detour_m = float(rng.exponential(fault.nlos_mean_m))
                extra_m = fault.bias_m + (detour_m if blocked else 0.0)
                error = RangeError(error.extra_m + extra_m, error.blocked or blocked)
        return error

    def said_m(self, observer: int, target: int, time_s: float, range_m: float) -> float:
        """What a stuck module says in place of a range: the first one since it stuck; else the range itself."""
        for number, fault in enumerate(self._sensor):
            if isinstance(fault, UwbStuck) and fault.holds(time_s) and fault.hits(observer, target):
                return self._held_m.setdefault((number, observer, target), range_m)
        return range_m

    def said_of(self, observer: int, target: int, time_s: float) -> int:
        """Of whom a module says what it measured of an agent."""
        for fault in self._sensor:
            if isinstance(fault, UwbSwapped) and target in fault.between and _hits(fault, observer, time_s):
                return fault.between[fault.between[0] == target]
        return target


def _hits(fault: SensorFault, agent: int, time_s: float) -> bool:
    return agent in fault.agents and fault.holds(time_s)
