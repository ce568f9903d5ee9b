"""A camera that looks down from a vehicle and detects targets: what its process tells the daemon (sans-I/O).

Frames of ``target-detection/1`` in the body's axes. Whether it tells distances, how far and how wide it sees, and how
well, its table says; what it says of its errors is true.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from agent.config.fields import AgentId, Positive, Table
from sim_bridge.world import quaternions
from sim_bridge.world.quaternions import Array
from transport.messages.detection_body import MAX_SIGMA_RAD, Detection, DetectionFrame, encode_detections

GRID_TOLERANCE = 1e-6


class CameraTable(Table, frozen=True):
    """``[[sim.cameras]]``: a camera that looks down from a drone and detects targets."""

    agent: AgentId
    """Whose."""
    rate_hz: Annotated[float, msgspec.Meta(gt=0, le=100)] = 5.0
    """So often it looks."""
    reach_m: Positive = 100.0
    """What is farther away it does not see."""
    view_rad: Annotated[float, msgspec.Meta(gt=0, le=2.0 * math.pi)] = 1.6
    """Opening angle of the cone that it sees, about the drone's own down axis."""
    sigma_rad: Annotated[float, msgspec.Meta(gt=0, le=MAX_SIGMA_RAD)] = 0.01
    """1-sigma of a direction, about each axis across it."""
    distance_sigma_m: Positive | None = None
    """1-sigma of a distance; absent = it tells none."""


@dataclass(frozen=True, slots=True)
class SensedDetections:
    """What the camera of one observer saw at ``time_s`` since the start."""

    observer: int
    time_s: float
    detections: tuple[Detection, ...]


class TargetCamera:
    """The camera of one vehicle."""

    def __init__(self, table: CameraTable, rng: np.random.Generator) -> None:
        self.agent = table.agent
        self._table, self._rng = table, rng
        self._taken = 0

    def look(
        self, time_s: float, position: Array, attitude: Array, targets: list[tuple[int, Array]]
    ) -> SensedDetections | None:
        """What it sees at a time since the start, if a picture is due and there is something in it.

        ``position`` ``(3,)`` NED, ``attitude`` w x y z into NED; ``targets`` ids and places ``(3,)`` NED.
        """
        count = int(time_s * self._table.rate_hz + GRID_TOLERANCE)
        if count <= self._taken:
            return None
        self._taken = count
        back = quaternions.conjugate(attitude[None])
        away = [(target, quaternions.rotate(back, (place - position)[None])[0]) for target, place in targets]
        found = tuple(each for target, there in away if (each := self._detected(target, there)) is not None)
        return SensedDetections(self.agent, time_s, found) if found else None

    def _detected(self, target: int, away: Array) -> Detection | None:
        """A body that is ``away`` ``(3,)`` FRD, if it is in the picture."""
        table, distance_m = self._table, float(np.linalg.norm(away))
        if not 0.0 < distance_m <= table.reach_m:
            return None
        direction = away / distance_m
        if direction[2] < math.cos(0.5 * table.view_rad):
            return None
        noise = table.sigma_rad * self._rng.standard_normal(3)
        forward, right, down = (direction + noise - (noise @ direction) * direction).tolist()
        if table.distance_sigma_m is None:
            return Detection(target, (forward, right, down), table.sigma_rad)
        seen_m = max(distance_m + table.distance_sigma_m * float(self._rng.standard_normal()), 0.01)
        return Detection(target, (forward, right, down), table.sigma_rad, seen_m, table.distance_sigma_m)


class CameraDrivers:
    """Makes all cameras' frames, numbered per observer."""

    def __init__(self) -> None:
        self._sequence: dict[int, int] = {}

    def payload(self, taken_s: float, seen: SensedDetections) -> bytes:
        """One frame as it travels, stamped ``taken_s`` as CLOCK_MONOTONIC of this host."""
        sequence = self._sequence.get(seen.observer, 0)
        self._sequence[seen.observer] = sequence + 1
        frame = DetectionFrame(sequence, "mono", round(1e9 * taken_s), seen.detections, seen.observer)
        return encode_detections(frame)
