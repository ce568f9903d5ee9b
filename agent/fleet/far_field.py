"""The drones beyond the joint state, each as it reports itself: kept with their age, and passed on hop by hop.

In a fleet larger than `fleet.joint_bodies` every drone reports its own state once a second, and everybody passes each
report on once. What is kept of a far drone is its last report; what is told of it is that report moved on at its
velocity, less sure the older it is.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable

import numpy as np

from agent.config.tables import FleetConfig
from agent.fleet.neighbourhood import is_limited
from agent.fleet.tracking import ABSENT_VARIANCE
from estimators.estimator import Estimate
from estimators.model.layout import STATES_PER_AGENT, states_of
from estimators.model.measurements import Matrix, Vector
from estimators.model.unknown_motion import drift_variances
from transport.messages.estimate_body import MAX_AGE_TICKS
from transport.messages.far_body import MAX_REPORTS, FarReport, FarReports
from transport.messages.measurement_body import MAX_POSITION_M, MAX_SPEED_MPS

REPORT_EVERY_S = 1.0
NEVER = -(2**40)
"""Tick of a report that there is none of."""
AHEAD_TICKS = 2
"""Reports of a drone whose clock is ahead by more are refused."""


class FarField:
    """What one drone knows and passes on of the others' reports; ``counters`` is where refused ones are counted."""

    def __init__(self, config: FleetConfig, agent_id: int, counters: Counter[str]) -> None:
        self.is_on = is_limited(config)
        """Off while the joint state has room for everybody: nothing is sent or kept then."""
        self._agent_id = agent_id
        self._counters = counters
        self._period_s = config.fleet.period_s
        self._accel_variance = config.estimator.other_accel_variance
        self._every_ticks = max(round(REPORT_EVERY_S / self._period_s), 1)
        self._keep_ticks = min(math.ceil(config.fleet.absent_after_s / self._period_s), MAX_AGE_TICKS - 1)
        self._slots = {agent: slot for slot, agent in enumerate(config.ids)}
        self._tick = np.full(len(config.ids), NEVER)
        """Of the newest report by slot, as are the moments of its state."""
        self._mean, self._variance = np.zeros((2, len(config.ids), STATES_PER_AGENT))
        self._newest: dict[int, FarReport] = {}
        self._waiting: dict[int, None] = {}
        """Whose newest report has not been passed on, who has waited longest first."""

    def note_own(self, estimate: Estimate, own: slice) -> None:
        """The own estimate of a tick, ``own`` the block of this drone: reported once a second."""
        if not self.is_on or (estimate.tick + self._agent_id) % self._every_ticks:
            return
        mean = estimate.mean[own]
        sigma = np.sqrt(estimate.covariance.diagonal()[own])
        if np.abs(mean[:3]).max() > MAX_POSITION_M or np.abs(mean[3:]).max() > MAX_SPEED_MPS:
            return
        if sigma.max() >= math.sqrt(ABSENT_VARIANCE) or sigma.min() <= 0.0:
            return  # it knows nothing of itself
        north, east, down, *velocity = mean.tolist()
        s_north, s_east, s_down, *speed_sigma = sigma.tolist()
        self._take(
            FarReport(
                self._agent_id,
                estimate.tick,
                int(estimate.status),
                (north, east, down),
                (velocity[0], velocity[1], velocity[2]),
                (s_north, s_east, s_down),
                (speed_sigma[0], speed_sigma[1], speed_sigma[2]),
            )
        )

    def hear(self, reports: Iterable[FarReport], tick: int) -> None:
        """A neighbour's packet, while ``tick`` is the current one."""
        for report in reports:
            known = self._newest.get(report.agent)
            if report.agent == self._agent_id or (known is not None and report.tick <= known.tick):
                continue  # our own word, or known by another way
            if report.tick > tick + AHEAD_TICKS:
                self._counters["far report: of the future"] += 1
            elif tick - report.tick > self._keep_ticks:
                self._counters["far report: too old"] += 1
            elif known is not None and report.tick - known.tick < self._every_ticks:
                self._counters["far report: too soon"] += 1
            else:
                self._take(report)

    def packet(self, tick: int) -> FarReports | None:
        """What is passed on at the end of a tick: who has waited longest first, as many as a packet holds."""
        sent: list[FarReport] = []
        for agent in list(self._waiting):
            if len(sent) == MAX_REPORTS:
                break
            report = self._newest[agent]
            if report.tick > tick:
                continue  # its clock is ahead of ours: when we are there
            del self._waiting[agent]
            if tick - report.tick <= self._keep_ticks:
                sent.append(report)
        return FarReports(tick, tuple(sent)) if sent else None

    def added_to(self, estimate: Estimate, members: Collection[int]) -> Estimate:
        """An estimate in the whole fleet's layout with those who are not its ``members`` as they reported themselves.

        Their ages are those of their reports, their errors independent of all others'. Changes the estimate's arrays.
        """
        age_ticks = np.maximum(estimate.tick - self._tick, 0)
        is_told = age_ticks <= self._keep_ticks
        is_told[[self._slots[agent] for agent in members]] = False
        slots = np.flatnonzero(is_told)
        if len(slots):
            at = states_of(slots.tolist())
            age_s = age_ticks[slots] * self._period_s
            mean, variance = moved_on(self._mean[slots], self._variance[slots], age_s, self._accel_variance)
            estimate.mean[at] = mean.ravel()
            estimate.covariance[at, at] = variance.ravel()
            estimate.age_ticks[slots] = np.minimum(age_ticks[slots], MAX_AGE_TICKS - 1)
        return estimate

    def _take(self, report: FarReport) -> None:
        self._newest[report.agent] = report
        self._waiting.setdefault(report.agent)
        if report.agent != self._agent_id:
            slot = self._slots[report.agent]
            self._tick[slot] = report.tick
            self._mean[slot], self._variance[slot] = moments(report)


def moments(report: FarReport) -> tuple[Vector, Vector]:
    """Mean and variances ``(6,)`` of a report."""
    mean = np.array((*report.position_m, *report.velocity_mps))
    return mean, np.square((*report.position_sigma_m, *report.velocity_sigma_mps))


def moved_on(mean: Matrix, variance: Matrix, age_s: Vector, accel_variance: float) -> tuple[Matrix, Matrix]:
    """Means and variances ``(F, 6)`` of drones a time ``(F,)`` after their reports, had they flown straight on.

    ``accel_variance``, (m/s2)2 per axis, is of an acceleration that is not known and lasts.
    """
    position, speed = slice(0, STATES_PER_AGENT // 2), slice(STATES_PER_AGENT // 2, STATES_PER_AGENT)
    age_s = age_s[:, None]
    drifted_m2, drifted_m2ps2 = drift_variances(age_s, accel_variance)
    mean, variance = mean.copy(), variance.copy()
    mean[:, position] += age_s * mean[:, speed]
    variance[:, position] += age_s**2 * variance[:, speed] + drifted_m2
    variance[:, speed] += drifted_m2ps2
    return mean, variance
