"""What the data alone say of the fleet."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.estimator import Estimate, Status
from estimators.factory import make_estimator
from estimators.integrity.data_observability import ObservabilityMonitor, mark_observable
from estimators.integrity.finding import Gravity, What
from estimators.integrity.thresholds import OBSERVABLE_SIGMA_M
from estimators.integrity.window_evidence import WindowEvidence
from estimators.model.layout import Layout
from estimators.model.measurements import RowTable, empty_inputs, empty_rows, input_rows, position_rows, range_row
from estimators.model.members import MemberChange
from estimators.settings import EstimatorSettings

SHARED = EstimatorSettings(
    kind="dmhe_shared", window=6, rounds=2, share_inputs="fleet", relay_hops=2, unknown_inputs="hold"
)
PLACES = np.array([[0.0, 0.0, -5.0], [9.0, 1.0, 0.0], [-6.0, 7.0, 0.0], [-5.0, -8.0, 1.0], [1.0, 0.0, -14.0]])
DT = 0.1


def hover(
    fixed: set[int], ranged: set[int], ticks: int = 15, sure: float = 0.1, until: int = 10**6
) -> list[Estimate]:
    """Five drones that hover; agent 0 ranges to ``ranged``, and its prior is right and narrow (``sure``, variance).

    ``fixed`` have fixes (agent 0 only before tick ``until``).
    """
    rng = np.random.default_rng(0)
    mean = np.concatenate([PLACES, np.zeros((5, 3))], axis=1).ravel()
    estimator = make_estimator(SHARED, Layout((1, 2, 3, 4, 5)), 0, mean, sure * np.eye(30), DT)
    estimates = []
    for tick in range(ticks):
        rows: list[RowTable] = [empty_rows()]
        for slot in fixed:
            if slot or tick < until:
                rows.append(position_rows(tick, slot, PLACES[slot] + rng.normal(size=3) * 0.1, np.full(3, 0.01)))
        for slot in ranged:
            distance = float(np.linalg.norm(PLACES[slot] - PLACES[0]))
            rows.append(range_row(tick, 0, slot, distance + rng.normal() * 0.05, 0.0025))
        inputs = [input_rows(tick - 1, slot, np.zeros(3), 1e-4) for slot in range(5)] if tick else [empty_inputs()]
        estimator.begin(tick, np.concatenate(rows), np.concatenate(inputs))
        estimates.append(estimator.solve())
    return estimates


def test_fixes_observe_and_a_good_prior_does_not() -> None:
    # GIVEN fixes of agents 1 and 2 only, and a prior that is as good as fixes
    last = hover({0, 1}, set())[-1]
    # THEN only what was measured counts, for the flags; the status is the own one's
    assert last.observable.tolist() == [True, True, False, False, False]
    assert last.status is Status.OK
    blind = hover({1, 2, 3}, set())[-1]
    assert not blind.observable[0]
    assert blind.status is Status.NOT_OBSERVABLE


@pytest.mark.parametrize(("ranged", "observable"), [({1}, False), ({1, 2}, False), ({1, 2, 3, 4}, True)])
def test_a_hovering_drone_without_fixes_needs_three_ranges_that_are_not_in_a_plane(
    ranged: set[int], observable: bool
) -> None:
    last = hover({1, 2, 3, 4}, ranged)[-1]
    assert bool(last.observable[0]) is observable
    assert last.status is (Status.OK if observable else Status.NOT_OBSERVABLE)
    assert last.observable[1:].all()


def test_what_fixes_told_is_known_for_a_while_after_they_end() -> None:
    estimates = hover({0, 1, 2, 3}, set(), ticks=60, until=20)
    assert all(estimate.status is not Status.NOT_OBSERVABLE for estimate in estimates[2:30])
    assert estimates[-1].covariance[0, 0] > estimates[25].covariance[0, 0]


def test_the_worst_direction_decides_whatever_its_name() -> None:
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    covariance = np.eye(12)
    covariance[:3, :3] = turn @ np.diag([0.1, 0.1, (1.1 * OBSERVABLE_SIGMA_M) ** 2]) @ turn.T
    observable = np.zeros(2, np.bool_)
    mark_observable(covariance, observable)
    assert observable.tolist() == [False, True]


def unobserved(monitor: ObservabilityMonitor, fixed: set[int], *, slide: bool = True) -> list[int]:
    """Whom a window of one tick over two drones at rest does not observe; ``fixed`` have fixes in its first tick."""
    agents = 2
    rows = [position_rows(0, slot, PLACES[slot], np.full(3, 0.01)) for slot in sorted(fixed)]
    state = np.concatenate([PLACES, np.zeros((5, 3))], axis=1)[:agents].ravel()
    m = 3 * len(rows)
    found = monitor.observe(
        WindowEvidence(
            rows=np.concatenate([empty_rows(), *rows]),
            start=np.array([0, m, m]),
            accel_variance=np.full((1, 3 * agents), 1e-4),
            path=np.array([state, state]),
            arrival_mean=state,
            arrival_information=1e6 * np.eye(6 * agents),
            slide=slide,
            vehicles=np.ones(agents, np.bool_),
            period_s=DT,
            norm_smoothing=1e-3,
        )
    )
    assert {(finding.what, finding.gravity) for finding in found} <= {(What.NOT_OBSERVABLE, Gravity.ALARM)}
    return [finding.about for finding in found if finding.about is not None]


def test_each_slot_that_nothing_was_measured_of_is_found() -> None:
    monitor = ObservabilityMonitor(2)
    assert unobserved(monitor, set()) == [0, 1]
    assert unobserved(monitor, {0}) == [1]
    # what has left the window is remembered
    assert unobserved(monitor, {1}) == []


def test_a_window_that_does_not_slide_keeps_its_rows_for_the_next_look() -> None:
    monitor = ObservabilityMonitor(2)
    assert unobserved(monitor, {0}, slide=False) == [1]
    assert unobserved(monitor, {1}, slide=False) == [0]


def test_of_a_fresh_agent_the_data_say_what_its_prior_says_and_the_others_stay() -> None:
    for sigma_m, expected in ((0.5 * OBSERVABLE_SIGMA_M, []), (2.0 * OBSERVABLE_SIGMA_M, [1])):
        monitor = ObservabilityMonitor(2)
        unobserved(monitor, {0, 1})
        fresh = np.zeros(6), np.diag([sigma_m**2] * 3 + [0.01] * 3)
        monitor.change_members(MemberChange.between(Layout((1, 2)), (1, 5), 1, {5: fresh}))
        assert unobserved(monitor, set()) == expected
