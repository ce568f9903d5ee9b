"""Nothing that a window may hold makes a NaN or an indefinite covariance; what cannot be used is counted.

Random windows far from any flight: coincident agents, no speed at all, ticks without rows, agents without rows,
variances and priors over many orders of magnitude, values that no sensor could give.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.estimator import Estimate, Payload, Status
from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import INPUT, ROW, InputTable, Kind, RowTable, empty_inputs, empty_rows
from estimators.settings import EstimatorSettings
from estimators.settings import Kind as EstimatorKind
from estimators.window.history import MeasurementWindow
from estimators.window.problem import WindowProblem
from estimators.window.solving import pre_estimation, solve_window
from tests.support import builders

Array = NDArray[np.float64]
ESTIMATORS: tuple[EstimatorKind, ...] = ("dmhe_pre_ekf", "dmhe", "dmhe_shared", "dekf_ci", "centralized_ekf")
STATUSES = {Status.OK, Status.NOT_CONVERGED, Status.FELL_BACK, Status.NOT_OBSERVABLE, Status.NO_DATA}


def is_covariance(matrix: Array) -> bool:
    """Finite, symmetric up to rounding, positive definite."""
    if not np.isfinite(matrix).all() or np.abs(matrix - matrix.T).max() > 1e-14 * np.abs(matrix).max():
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def degenerate_state(rng: np.random.Generator, agents: int) -> Array:
    """A fleet state in one of the situations where norms have no direction, or anywhere."""
    x = np.concatenate([rng.uniform(-20, 20, (agents, 3)), rng.uniform(-3, 3, (agents, 3))], axis=1)
    situation = rng.integers(5)
    if situation == 1:
        x[:, :3] = x[0, :3]
    elif situation == 2:
        x[:, 3:] = 0.0
    elif situation == 3:
        x[:] = 0.0
    elif situation == 4:
        x[:, 2] = 0.0  # in one plane
    return x.ravel()


def log_uniform(rng: np.random.Generator, between: tuple[float, float], shape: int | tuple[int, int]) -> Array:
    """Draws that are uniform in the logarithm."""
    return np.exp(rng.uniform(np.log(between[0]), np.log(between[1]), shape))


def random_rows(rng: np.random.Generator, agents: int, ticks: int, variances: tuple[float, float]) -> RowTable:
    """Any rows on any agents, often none on many of them; values up to a hundred metres."""
    count = int(rng.integers(0, 5 * agents))
    rows = np.zeros(count, ROW)
    rows["tick"] = rng.integers(0, ticks + 1, count)
    rows["kind"] = rng.integers(0, len(Kind), count)
    rows["agent"] = rng.integers(0, agents, count)
    paired = np.isin(rows["kind"], (Kind.RANGE, Kind.RELATIVE))
    rows["other"] = np.where(paired, (rows["agent"] + 1) % agents, -1)
    rows["observer"] = rows["agent"]
    rows["offset_s"] = rng.uniform(-0.05, 0.05, count) * rng.integers(0, 2, count)
    rows["value"] = rng.choice([0.0, 1.0, -3.0, 17.0, 100.0], count)
    rows["variance"] = log_uniform(rng, variances, count)
    rows["half_width"] = np.inf
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    for i, name in enumerate("xyz"):
        rows[name] = direction[:, i]
    return rows[rows["agent"] != rows["other"]]  # a single agent has nobody to range or see


def random_problem(
    rng: np.random.Generator, variances: tuple[float, float], prior: tuple[float, float]
) -> WindowProblem:
    """A window with input noise and prior eigenvalues drawn over the given orders of magnitude."""
    agents, ticks = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    window = MeasurementWindow(Layout(tuple(range(1, agents + 1))), ticks, other_accel_variance=1.0)
    window.advance(ticks)
    window.insert(random_rows(rng, agents, ticks, variances), empty_inputs())
    rows, start = window.rows()
    order = 6 * agents
    axes = np.linalg.qr(rng.normal(size=(order, order)))[0]
    information = (axes / log_uniform(rng, prior, order)) @ axes.T
    information = np.ascontiguousarray(0.5 * (information + information.T))
    return WindowProblem(
        rows=rows,
        start=start,
        accel=rng.uniform(-2, 2, (ticks, 3 * agents)) * rng.integers(0, 2),
        accel_variance=log_uniform(rng, variances, (ticks, 3 * agents)),
        information=information,
        vector=information @ degenerate_state(rng, agents),
        keep=np.array([0], np.int64),
        period_s=0.1,
        with_gains=bool(rng.integers(2)),
    )


def check_window(problem: WindowProblem, settings: EstimatorSettings) -> Status:
    """Solve, and hold the result to what must never happen."""
    solution = solve_window(problem, settings)
    assert solution.status in STATUSES
    assert np.isfinite(solution.path).all()
    assert np.isfinite(solution.report.cost)
    assert is_covariance(solution.next_information)
    mean, covariance = pre_estimation(problem, settings.norm_smoothing_m)
    assert np.isfinite(mean).all()
    assert is_covariance(covariance)
    return solution.status


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "variances", "prior", "converging"),
    [(1, (1e-4, 1e1), (1e-3, 1e1), 0.97), (2, (1e-6, 1e4), (1e-4, 1e4), 0.75)],
    ids=["plausible", "extreme"],
)
def test_ten_thousand_windows(
    seed: int, variances: tuple[float, float], prior: tuple[float, float], converging: float
) -> None:
    # GIVEN windows of every degenerate kind
    rng = np.random.default_rng(seed)
    settings = EstimatorSettings()
    # WHEN they are solved, THEN nothing is NaN and everything that must be is positive definite
    statuses = Counter(check_window(random_problem(rng, variances, prior), settings) for _ in range(5000))
    # and most of them converge, though the values are nonsense; what does not is finite too
    assert statuses[Status.OK] > converging * 5000, statuses
    assert set(statuses) <= {Status.OK, Status.NOT_CONVERGED}, statuses


def check_estimate(estimate: Estimate, tick: int) -> None:
    assert estimate.tick == tick
    assert estimate.status in STATUSES
    assert np.isfinite(estimate.mean).all()
    assert is_covariance(estimate.covariance)
    assert (estimate.age_ticks >= 0).all()


def random_inputs(rng: np.random.Generator, agents: int, tick: int) -> InputTable:
    """Inputs of some of the agents over the tick before."""
    chosen = np.flatnonzero(rng.random(agents) < 0.6)
    inputs = np.zeros(len(chosen), INPUT)
    inputs["tick"], inputs["agent"] = tick - 1, chosen
    inputs["accel"], inputs["variance"] = rng.uniform(-2, 2, (len(chosen), 3)), 0.01
    return inputs


@pytest.mark.parametrize("weights", ["observability_rank", "metropolis", "uniform"])
@pytest.mark.parametrize("kind", ESTIMATORS)
def test_fleets_that_measure_nonsense(kind: EstimatorKind, weights: str) -> None:
    # GIVEN fleets whose members hear each other now and then, and whose rows fit no motion at all
    rng = np.random.default_rng(7)
    settings = EstimatorSettings(kind=kind, weights=weights, rounds=2)  # type: ignore[arg-type]
    for _ in range(4):
        layout = Layout((1, 2, 3))
        covariance = builders.random_covariance(rng, 18, 5.0)
        fleet = [
            make_estimator(settings, layout, slot, degenerate_state(rng, 3), covariance, 0.1) for slot in range(3)
        ]
        for tick in range(12):
            for estimator in fleet:
                rows = random_rows(rng, 3, 3, (1e-4, 1e2))
                rows["tick"] += tick - 3
                estimator.begin(tick, rows, random_inputs(rng, 3, tick))
            for round_ in range(fleet[0].rounds):
                sent = [estimator.outgoing(round_) for estimator in fleet]
                for slot, estimator in enumerate(fleet):
                    heard = [other for other in range(3) if other != slot and rng.random() < 0.6]
                    estimator.mix(round_, {other: sent[other] for other in heard})
            # THEN every estimate can be used
            for estimator in fleet:
                check_estimate(estimator.solve(), tick)


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_without_any_data_the_prediction_goes_on(kind: EstimatorKind) -> None:
    # GIVEN an estimator that never gets a row
    mean = np.array([1.0, 2.0, 3.0, 0.5, 0.0, -0.5])
    estimator = make_estimator(EstimatorSettings(kind=kind), Layout((1,)), 0, mean, np.eye(6), 0.1)
    estimates = builders.run_alone(estimator, lambda _: empty_rows(), lambda _: empty_inputs(), 6)
    # THEN it says so, moves with the velocity and gets less sure
    assert [estimate.status for estimate in estimates] == [Status.NO_DATA] * 7
    np.testing.assert_allclose(estimates[-1].mean[:3], mean[:3] + 0.6 * mean[3:], atol=1e-12)
    assert (np.diag(estimates[-1].covariance) > 1.0).all()
    assert [int(estimate.age_ticks[0]) for estimate in estimates] == list(range(1, 8))


# --- what cannot be used --------------------------------------------------------------------------------------


BAD_ROWS: dict[str, Callable[[RowTable], None]] = {
    "value NaN": lambda row: row.__setitem__("value", np.nan),
    "value inf": lambda row: row.__setitem__("value", np.inf),
    "variance NaN": lambda row: row.__setitem__("variance", np.nan),
    "variance 0": lambda row: row.__setitem__("variance", 0.0),
    "variance negative": lambda row: row.__setitem__("variance", -1.0),
    "variance inf": lambda row: row.__setitem__("variance", np.inf),
    "offset NaN": lambda row: row.__setitem__("offset_s", np.nan),
    "bound NaN": lambda row: row.__setitem__("half_width", np.nan),
    "bound 0": lambda row: row.__setitem__("half_width", 0.0),
    "direction NaN": lambda row: row.__setitem__("y", np.nan),
    "unknown agent": lambda row: row.__setitem__("agent", 3),
    "negative agent": lambda row: row.__setitem__("agent", -1),
    "unknown observer": lambda row: row.__setitem__("observer", 7),
    "unknown other": lambda row: row.__setitem__("other", 3),
    "range to itself": lambda row: row.__setitem__("other", row["agent"]),
    "range to nobody": lambda row: row.__setitem__("other", -1),
    "unknown kind": lambda row: row.__setitem__("kind", 17),
    "speed of two": lambda row: row.__setitem__("kind", Kind.SPEED),
}


@pytest.mark.parametrize("spoil", BAD_ROWS)
def test_bad_row_is_refused_and_counted(spoil: str) -> None:
    # GIVEN a window, a good row and one that is spoiled
    window = MeasurementWindow(Layout((1, 2, 3)), 2, other_accel_variance=1.0)
    window.advance(2)
    rng = np.random.default_rng(0)
    good, bad = (builders.row_of(Kind.RANGE, rng, tick, 0, 3) for tick in (1, 2))
    BAD_ROWS[spoil](bad)
    # WHEN both come in one packet
    window.insert(np.concatenate([bad, good]), empty_inputs())
    # THEN one is kept and one counted
    assert window.refused == 1
    assert window.dropped == 0
    np.testing.assert_array_equal(window.rows()[0], good)


@pytest.mark.parametrize(
    ("name", "value"),
    [("accel", [0.0, np.nan, 0.0]), ("variance", [1.0, 0.0, 1.0]), ("variance", np.inf), ("agent", 3), ("agent", -1)],
)
def test_bad_input_is_refused_and_counted(name: str, value: object) -> None:
    window = MeasurementWindow(Layout((1, 2, 3)), 2, other_accel_variance=1.0)
    window.advance(2)
    inputs = np.zeros(1, INPUT)
    inputs["variance"] = 1.0
    inputs[name] = value
    window.insert(empty_rows(), inputs)
    assert window.refused == 1
    accel, variance = window.inputs()
    assert not accel.any()
    assert (variance == 1.0).all()


BAD_PAIRS: dict[str, tuple[Array, Array, int]] = {
    "matrix NaN": (np.full((12, 12), np.nan), np.zeros(12), 6),
    "vector NaN": (np.eye(12), np.full(12, np.nan), 6),
    "negative": (-5.0 * np.eye(12), np.zeros(12), 6),
    "singular": (np.diag([1.0] * 11 + [0.0]), np.zeros(12), 6),
    "smaller fleet": (np.eye(6), np.zeros(6), 6),
    "torn": (np.eye(6), np.zeros(12), 6),
    "negative rank": (np.eye(12), np.zeros(12), -6),
}


@pytest.mark.parametrize("spoil", BAD_PAIRS)
@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dmhe", "dmhe_shared", "dekf_ci"])
def test_bad_pair_of_a_neighbour_is_left_out_and_counted(kind: EstimatorKind, spoil: str) -> None:
    # GIVEN an agent whose neighbour sends nonsense, and one that hears nobody
    information, vector, rank = BAD_PAIRS[spoil]
    layout, settings = Layout((1, 2)), EstimatorSettings(kind=kind)
    poisoned, alone = (make_estimator(settings, layout, 0, np.zeros(12), np.eye(12), 0.1) for _ in range(2))
    rng = np.random.default_rng(3)
    for tick in range(4):
        rows = builders.row_of(Kind.POSITION, rng, tick, 0, 2)
        for estimator in (poisoned, alone):
            estimator.begin(tick, rows, empty_inputs())
        poisoned.mix(0, {1: Payload(poisoned.outgoing(0).tick, information, vector, rank)})
        alone.mix(0, {})
        # THEN both estimate the same, and the nonsense is counted
        found, expected = poisoned.solve(), alone.solve()
        check_estimate(found, tick)
        np.testing.assert_array_equal(found.mean, expected.mean)
        assert found.status is expected.status
    assert poisoned.refused_pairs == 4  # type: ignore[attr-defined]


def test_memory_order_of_a_pair_does_not_matter() -> None:
    # GIVEN the same pair as it came from the wire, and in Fortran order
    rng = np.random.default_rng(4)
    matrix = builders.random_covariance(rng, 12)
    means = []
    for information in (np.ascontiguousarray(matrix), np.asfortranarray(matrix)):
        estimator = make_estimator(EstimatorSettings(), Layout((1, 2)), 0, np.zeros(12), np.eye(12), 0.1)
        for tick in range(3):
            estimator.begin(tick, empty_rows(), empty_inputs())
            estimator.mix(0, {1: Payload(estimator.outgoing(0).tick, information, np.ones(12), 3)})
            means.append(estimator.solve().mean)
    np.testing.assert_array_equal(means[:3], means[3:])
