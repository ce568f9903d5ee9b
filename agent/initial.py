"""Where an agent believes the fleet to be before its estimator starts: a wide prior about first fixes."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from agent.config_tables import FleetConfig
from agent.samples import Triple
from estimators.layout import Layout, block, position, velocity
from estimators.measurements import Matrix, Vector
from transport.measurement_body import PositionRecord, RangeRecord, Record, VelocityRecord

FRESH_TICKS = 30
"""Fixes older than this say nothing about where a drone is now."""
TRACK_FIXES = 10
MIN_SLOPE_FIXES, MIN_SLOPE_S = 3, 0.2
"""Fewer or closer fixes show more of their noise than of a velocity."""
UNKNOWN_DISTANCE_M = 10.0
NO_DATA_VARIANCE = 1e8
"""Of the estimate that is given while there is none."""


class Initialiser:
    """Collects first fixes and ranges, tells when they suffice, and makes the prior of them."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._settings = config.initial
        self._agent_id = agent_id
        self._layout = Layout(config.ids)
        self._neighbours = config.neighbours(agent_id)
        self._period_s = config.fleet.period_s
        self._fixes: dict[int, PositionRecord] = {}
        self._tracks: dict[int, deque[PositionRecord]] = {}
        self._velocities: dict[int, VelocityRecord] = {}
        self._ranges: dict[int, float] = {}
        self._own_fixes = 0
        self._since_s: float | None = None

    def note(self, record: Record) -> None:
        """Take in a record, own or heard."""
        if isinstance(record, PositionRecord):
            self._own_fixes += record.observer == self._agent_id
            self._tracks.setdefault(record.observer, deque(maxlen=TRACK_FIXES)).append(record)
            known = self._fixes.get(record.observer)
            if known is None or record.tick >= known.tick:
                self._fixes[record.observer] = record
        elif isinstance(record, VelocityRecord):
            self._velocities[record.observer] = record
        elif isinstance(record, RangeRecord) and record.observer == self._agent_id:
            self._ranges[record.other] = record.range_m

    def ready(self, tick: int, now_s: float) -> bool:
        """Whether the estimator can start at this tick."""
        if self._since_s is None:
            self._since_s = now_s
        if self._settings.position_m is not None:
            return True
        waited_s = now_s - self._since_s
        if self._own_fixes >= self._settings.fixes and self._fresh(self._agent_id, tick):
            others = all(self._fresh(other, tick) for other in self._neighbours)
            return others or waited_s >= self._settings.settle_s
        anybody = any(self._fresh(other, tick) for other in self._neighbours)
        return anybody and waited_s >= self._settings.max_wait_s

    def prior(self, tick: int) -> tuple[Vector, Matrix]:
        """Mean ``(6n,)`` and covariance ``(6n, 6n)``: wide about fixes, wider where there are none."""
        own = self._settings.position_m or self._position(self._agent_id, tick) or self._centre(tick)
        mean = np.zeros(self._layout.dimension)
        variance = np.zeros(self._layout.dimension)
        for slot, agent_id in enumerate(self._layout.agents):
            known = self._settings.position_m or self._position(agent_id, tick)
            factor = 1.0 if known is not None else 4.0
            place = own if agent_id == self._agent_id else known or self._beside(own, slot, agent_id)
            mean[position(slot)] = place
            mean[velocity(slot)] = self._velocity(agent_id, tick)
            variance[position(slot)] = factor * self._settings.position_sigma_m**2
            variance[velocity(slot)] = self._settings.speed_sigma_mps**2
        return mean, np.diag(variance)

    def no_data(self) -> tuple[Vector, Matrix]:
        """What is given before the start: nothing known, and saying so."""
        dimension = self._layout.dimension
        return np.zeros(dimension), NO_DATA_VARIANCE * np.eye(dimension)

    def own_block(self) -> slice:
        """The six states of this agent."""
        return block(self._layout.slot(self._agent_id))

    def _fresh(self, agent_id: int, tick: int) -> bool:
        fix = self._fixes.get(agent_id)
        return fix is not None and tick - fix.tick <= FRESH_TICKS

    def _position(self, agent_id: int, tick: int) -> Triple | None:
        return self._fixes[agent_id].position_m if self._fresh(agent_id, tick) else None

    def _velocity(self, agent_id: int, tick: int) -> Vector:
        """The velocity ``(3,)`` as measured, else the slope of the fixes, else zero: NED m/s."""
        measured = self._velocities.get(agent_id)
        if measured is not None and tick - measured.tick <= FRESH_TICKS:
            return np.array(measured.velocity_mps)
        fixes = [fix for fix in self._tracks.get(agent_id, ()) if tick - fix.tick <= FRESH_TICKS]
        times = np.array([fix.tick * self._period_s + fix.offset_s for fix in fixes])
        if len(fixes) < MIN_SLOPE_FIXES or np.ptp(times) < MIN_SLOPE_S:
            return np.zeros(3)
        centred = times - times.mean()
        return np.asarray(centred @ np.array([fix.position_m for fix in fixes]) / (centred @ centred))

    def _centre(self, tick: int) -> Triple:
        """The middle of the neighbours' fixes, where an agent without its own must be."""
        places = [self._position(other, tick) for other in self._neighbours]
        known = np.array([place for place in places if place is not None])
        north, east, down = known.mean(axis=0)
        return float(north), float(east), float(down)

    def _beside(self, own: Triple, slot: int, agent_id: int) -> Triple:
        """Somewhere at the measured distance: between two agents at one point there is no direction."""
        angle = 2 * math.pi * slot / self._layout.size
        distance_m = self._ranges.get(agent_id, UNKNOWN_DISTANCE_M)
        return own[0] + distance_m * math.cos(angle), own[1] + distance_m * math.sin(angle), own[2]
