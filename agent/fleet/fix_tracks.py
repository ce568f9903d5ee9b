"""Where a drone is by its fixes, before its block is part of the estimate."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

from agent.config.tables import FleetConfig
from agent.fleet.motions import Motions
from agent.sensing.samples import Triple
from estimators.integrity.thresholds import FAR_M, FIX_MEMORY_TICKS
from estimators.model.gaussian import Prior
from estimators.model.measurements import Matrix, Vector
from transport.messages.measurement_body import Measurement, PositionMeasurement, VelocityMeasurement

TRACK_FIXES = 20
ENOUGH_FIXES = 10
POSITION_SIGMA_M = 50.0
"""Of a drone that nothing was heard of yet; own fixes narrow it by themselves."""
VELOCITY_SIGMA_MPS = 3.0
"""Per axis about the velocity that the first fixes show, or about zero."""
SPEED_SIGMA_MPS = 0.15
"""A velocity surer than this needs no more fixes, up to `ENOUGH_FIXES`: a speed is linearised about its direction.
Nor does one that is measured itself: it is linear."""
VELOCITY_SPREAD = 2.0
"""On the variance of a velocity that is the slope of fixes: their errors are not quite independent."""


class FixTracks:
    """The last fixes of every drone, own and heard; ``motions`` is fed by its owner."""

    def __init__(self, config: FleetConfig, motions: Motions) -> None:
        self._enough = config.initial.fixes
        self._period_s = config.fleet.period_s
        self._motions = motions
        self._fixes: dict[int, deque[PositionMeasurement]] = {}
        self._count: Counter[int] = Counter()
        self._velocities: dict[int, VelocityMeasurement] = {}

    def note(self, record: Measurement) -> None:
        """Take in a record."""
        if isinstance(record, PositionMeasurement):
            self._count[record.observer] += 1
            self._fixes.setdefault(record.observer, deque(maxlen=TRACK_FIXES)).append(record)
        elif isinstance(record, VelocityMeasurement):
            known = self._velocities.get(record.observer)
            if known is None or record.tick >= known.tick:
                self._velocities[record.observer] = record

    def place(self, agent_id: int, at_tick: int) -> Prior | None:
        """The prior at a tick from the fixes before it; ``None`` if they do not suffice.

        A wide prior about the place, which is left to the fixes to come to say. The velocity is what these fixes tell
        of it by their slope, so that a speed or range is not linearised about a direction that nothing is known of.
        """
        fixes = [fix for fix in self._fixes.get(agent_id, ()) if at_tick - FIX_MEMORY_TICKS <= fix.tick < at_tick]
        if fixes:  # one that is far from all others would draw the line to itself
            middle = np.median([fix.position_m for fix in fixes], axis=0)
            fixes = [fix for fix in fixes if np.linalg.norm(fix.position_m - middle) <= FAR_M]
        if self._count[agent_id] < self._enough or len(fixes) < 2:
            return None
        moved, wandered = self._motions.before(agent_id, at_tick)
        lead_s = np.array([(fix.tick - at_tick) * self._period_s + fix.offset_s for fix in fixes])
        places = np.array([fix.position_m for fix in fixes]) - moved[[at_tick - fix.tick for fix in fixes]]
        variance = np.array([fix.variance_m2 for fix in fixes])
        variance += wandered[[at_tick - fix.tick for fix in fixes]][:, None]
        position, velocity, speed_variance = self._line(lead_s, places, variance)
        measured = self._velocities.get(agent_id)
        if measured is not None and abs(at_tick - measured.tick) > FIX_MEMORY_TICKS:
            measured = None
        few = self._count[agent_id] < ENOUGH_FIXES
        if few and measured is None and speed_variance.max() > SPEED_SIGMA_MPS**2:
            return None
        mean, covariance = self.prior(position, velocity)
        covariance[3:, 3:] = np.diag(speed_variance)
        if measured is not None:
            known = np.asarray(measured.variance_m2ps2) < speed_variance
            mean[3:][known] = np.asarray(measured.velocity_mps)[known]
            covariance[3:, 3:][np.diag(known)] = VELOCITY_SIGMA_MPS**2  # measured again in the window
        return mean, covariance

    def prior(self, position_m: Vector | Triple, velocity_mps: Vector) -> Prior:
        """A wide prior about a place, NED m and m/s: what is known is left to the measurements to say."""
        sigma = [POSITION_SIGMA_M] * 3 + [VELOCITY_SIGMA_MPS] * 3
        return np.concatenate((position_m, velocity_mps)), np.diag(np.square(sigma))

    def _line(self, lead_s: Vector, places: Matrix, variance: Matrix) -> tuple[Vector, Vector, Vector]:
        """Position and velocity ``(3,)`` at the reference of the lines that fit best, and the velocity's variance.

        The velocity has a wide prior about zero.
        """
        weights = 1.0 / variance
        total = weights.sum(axis=0)
        middle_s, middle = (weights * lead_s[:, None]).sum(axis=0) / total, (weights * places).sum(axis=0) / total
        apart = lead_s[:, None] - middle_s
        information = (weights * apart**2).sum(axis=0) / VELOCITY_SPREAD + VELOCITY_SIGMA_MPS**-2.0
        slope = (weights * apart * (places - middle)).sum(axis=0) / VELOCITY_SPREAD / information
        return middle - middle_s * slope, slope, 1.0 / information
