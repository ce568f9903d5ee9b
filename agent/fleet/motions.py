"""How the drones moved in the last seconds, by their accelerations: dead reckoning back from a tick."""

from __future__ import annotations

import numpy as np

from agent.config.tables import FleetConfig
from estimators.model.measurements import Matrix, Vector
from estimators.model.unknown_motion import TARGET_ACCEL_VARIANCE, unseen_variance
from transport.messages.measurement_body import AccelerationMeasurement, Measurement

MEMORY_TICKS = 60


class Motions:
    """Keeps every drone's accelerations of the last `MEMORY_TICKS`, as far as they are told."""

    def __init__(self, config: FleetConfig) -> None:
        self._period_s = config.fleet.period_s
        self._unknown_variance = config.estimator.other_accel_variance
        self._kinds = config.kinds
        self._known: dict[int, dict[int, AccelerationMeasurement]] = {}

    def note(self, record: Measurement) -> None:
        """Take in a record, own or heard."""
        if isinstance(record, AccelerationMeasurement):
            known = self._known.setdefault(record.observer, {})
            known[record.tick] = record
            if len(known) > 2 * MEMORY_TICKS:
                newest = max(known)
                self._known[record.observer] = {t: r for t, r in known.items() if t >= newest - MEMORY_TICKS}

    def before(self, agent_id: int, tick: int) -> tuple[Matrix, Vector]:
        """Where a drone was k ticks before a tick, relative to its position then and had its velocity been zero then.

        Displacements ``(MEMORY_TICKS + 1, 3)`` in m by k, and their variances in m2. An acceleration that was not
        told is zero with a variance that grows with the time for which none was told.
        """
        moved, wandered = np.zeros((MEMORY_TICKS + 1, 3)), np.zeros(MEMORY_TICKS + 1)
        period_s = self._period_s
        velocity: Vector = np.zeros(3)
        cross, speed_variance = 0.0, 0.0
        known, unseen = self._known.get(agent_id, {}), 0
        for back in range(1, MEMORY_TICKS + 1):
            record = known.get(tick - back)
            accel = np.zeros(3) if record is None else np.array(record.accel_mps2)
            unseen = unseen + 1 if record is None else 0
            if record is not None:
                variance = max(record.variance_m2ps4)
            elif agent_id in self._kinds:  # it never tells, and moves as it is said to
                variance = TARGET_ACCEL_VARIANCE
            else:
                variance = unseen_variance(unseen, self._unknown_variance, period_s)
            earlier = velocity - accel * period_s
            moved[back] = moved[back - 1] - 0.5 * (velocity + earlier) * period_s
            velocity = earlier
            wandered[back] = wandered[back - 1] + 2 * cross * period_s + speed_variance * period_s**2
            wandered[back] += variance * period_s**4 / 4
            cross += speed_variance * period_s + variance * period_s**3 / 2
            speed_variance += variance * period_s**2
        return moved, wandered
