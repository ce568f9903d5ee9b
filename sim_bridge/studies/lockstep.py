"""A fleet of estimators over a recording, tick by tick, with a model of the exchange (`sim_bridge.studies.relay`).

For study inputs that say which packets arrive, and for the paper's estimators as the paper runs them; published
figures come from the agents that fly (`sim_bridge.studies.flown`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.estimator import Estimate, Payload
from estimators.factory import make_estimator
from estimators.integrity.consistency import nees
from estimators.model.layout import STATES_PER_AGENT, Layout, block
from estimators.model.measurements import (
    InputTable,
    RowTable,
    empty_inputs,
    empty_rows,
    input_rows,
    position_rows,
    range_row,
    speed_row,
)
from estimators.settings import EstimatorSettings
from sim_bridge.studies.relay import Arrival, MeasurementRelay, adjacency
from sim_bridge.studies.study_input import StudyInput

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LockstepResult:
    """Estimates of every agent at every tick.

    ``mean`` and ``cov_diag`` ``(T+1, n, 6n)``, ``status`` ``(T+1, n)`` int8, ``iterations`` ``(T+1, n)``;
    where the recording holds the truth, ``nees_full`` ``(T+1, n)`` over the fleet state and ``nees_own`` over the
    agent's own block, both divided by their dimension.
    """

    mean: Floats
    cov_diag: Floats
    status: NDArray[np.int8]
    iterations: NDArray[np.int64]
    dropped: NDArray[np.int64]
    nees_full: Floats | None
    nees_own: Floats | None


def own_rows(recording: StudyInput, tick: int, slot: int) -> RowTable:
    """What one agent's sensors said at a tick; bounds are those of the recording's uniform noises."""
    tables = []
    gps, half = recording.gps[tick, slot], recording.gps_half_width
    if np.isfinite(gps[:3]).all():
        tables.append(position_rows(tick, slot, gps[:3], half[:3] ** 2 / 3, half_width_m=half[:3]))
    if np.isfinite(gps[3]):
        tables.append(speed_row(tick, slot, gps[3], half[3] ** 2 / 3, half_width_mps=half[3]))
    bound = recording.range_half_width
    for other in np.flatnonzero(np.isfinite(recording.ranges[tick, slot])):
        measured = recording.ranges[tick, slot, other]
        tables.append(range_row(tick, slot, int(other), measured, bound**2 / 3, half_width_m=bound))
    if recording.rows is not None:
        tables.append(recording.rows.of(tick, slot))
    return np.concatenate(tables) if tables else empty_rows()


def own_input(recording: StudyInput, tick: int, slot: int) -> InputTable:
    """The acceleration of one agent over the tick that ends at ``tick``; none at the first."""
    if tick == 0:
        return empty_inputs()
    return input_rows(tick - 1, slot, recording.accel[tick - 1, slot], recording.accel_half_width**2 / 3)


def neighbours(recording: StudyInput) -> list[list[int]]:
    """Neighbours of every agent, sorted."""
    found: list[set[int]] = [set() for _ in recording.agents]
    for a, b in recording.edges.tolist():
        found[a].add(b)
        found[b].add(a)
    return [sorted(each) for each in found]


class Links:
    """Which packets of a recording reach whom within the tick that they are sent in."""

    def __init__(self, recording: StudyInput) -> None:
        self._on_time = recording.received & adjacency(recording) & (recording.delay_ticks == 0)

    def heard(self, tick: int, receiver: int) -> list[int]:
        """Neighbours whose packets of this tick arrive within it: they take part in its consensus rounds."""
        return [int(sender) for sender in np.flatnonzero(self._on_time[tick, receiver])]


def run_lockstep(
    recording: StudyInput, settings: EstimatorSettings, progress: Callable[[int], None] | None = None
) -> LockstepResult:
    """Run one estimator per agent (or one for all, if centralised) over a recording.

    ``progress`` is called with every finished tick. Results repeat bit by bit.
    """
    centralised = settings.kind == "centralized_ekf"
    layout = Layout(tuple(int(a) for a in recording.agents))
    slots = range(1 if centralised else layout.size)
    fleet = [
        make_estimator(settings, layout, slot, recording.x0[slot], recording.P0, recording.period_s) for slot in slots
    ]
    links = Links(recording)
    relay = MeasurementRelay(recording, settings)
    record = StudyEstimates(recording, centralised)
    for tick in range(recording.ticks + 1):
        arrivals = relay.exchange(tick)
        for slot, estimator in enumerate(fleet):
            if centralised:
                estimator.begin(tick, *records_of(recording, [(tick, each) for each in range(layout.size)]))
            else:
                estimator.begin(tick, *_received(recording, settings, arrivals[slot]))
        for round_ in range(fleet[0].rounds):
            sent = [estimator.outgoing(round_) for estimator in fleet]
            for slot, estimator in enumerate(fleet):
                received: dict[int, Payload] = {sender: sent[sender] for sender in links.heard(tick, slot)}
                estimator.mix(round_, received)
        for slot, estimator in enumerate(fleet):
            record.add(tick, slot, estimator.solve())
        if progress is not None:
            progress(tick)
    return record.result([estimator.dropped for estimator in fleet])


def records_of(recording: StudyInput, pairs: Iterable[tuple[int, int]]) -> tuple[RowTable, InputTable]:
    """Rows and inputs of some (tick, slot)."""
    found = list(pairs)
    rows = [own_rows(recording, tick, slot) for tick, slot in found]
    inputs = [own_input(recording, tick, slot) for tick, slot in found]
    return np.concatenate([empty_rows(), *rows]), np.concatenate([empty_inputs(), *inputs])


def _received(
    recording: StudyInput, settings: EstimatorSettings, arrivals: list[Arrival]
) -> tuple[RowTable, InputTable]:
    """Rows and inputs of what arrived; an input travels as far as the settings share it."""
    reach = {"none": 0, "neighbours": 1, "fleet": len(recording.agents)}[settings.share_inputs]
    rows = [own_rows(recording, arrival.tick, arrival.slot) for arrival in arrivals]
    inputs = [own_input(recording, each.tick, each.slot) for each in arrivals if each.hops <= reach]
    return np.concatenate(rows), np.concatenate(inputs)


class StudyEstimates:
    """Collects the estimates of a run."""

    def __init__(self, recording: StudyInput, centralised: bool) -> None:
        self._truth = None if recording.truth is None else recording.truth.reshape(recording.ticks + 1, -1)
        self._centralised = centralised
        ticks, n = recording.ticks + 1, len(recording.agents)
        self._mean = np.empty((ticks, n, 6 * n))
        self._cov_diag = np.empty((ticks, n, 6 * n))
        self._status = np.zeros((ticks, n), np.int8)
        self._iterations = np.zeros((ticks, n), np.int64)
        self._nees = np.full((2, ticks, n), np.nan)

    def add(self, tick: int, slot: int, estimate: Estimate) -> None:
        """Put down an agent's estimate of a tick."""
        # a centralised estimate is everybody's
        where = slice(None) if self._centralised else slice(slot, slot + 1)
        self._mean[tick, where] = estimate.mean
        self._cov_diag[tick, where] = np.diag(estimate.covariance)
        self._status[tick, where] = estimate.status
        self._iterations[tick, where] = estimate.report.iterations
        if self._truth is None:
            return
        error = estimate.mean - self._truth[tick]
        self._nees[0, tick, where] = nees(error, estimate.covariance) / len(error)
        for owner in range(self._mean.shape[1]) if self._centralised else (slot,):
            own = block(owner)
            self._nees[1, tick, owner] = nees(error[own], estimate.covariance[own, own]) / STATES_PER_AGENT

    def result(self, dropped: list[int]) -> LockstepResult:
        """All that was put down; ``dropped`` rows and inputs per agent."""
        known = self._truth is not None
        return LockstepResult(
            self._mean,
            self._cov_diag,
            self._status,
            self._iterations,
            np.array(dropped),
            self._nees[0] if known else None,
            self._nees[1] if known else None,
        )
