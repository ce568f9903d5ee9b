"""What must not matter: the agents' order, where the origin is, which way north is.

Estimates are equal up to rounding, amplified by the recursion and, most of all, by the information vector: a mean of
a kilometre that is recovered from it with a condition of 1e6 has 1e-7 m of rounding. Asked for is 1e-6 m, far below
any effect of a wrong formula. The good start is used, and a flight whose windows have one minimum each: at the
paper's start (all agents at one point) norms have no direction, so that rounding chooses among several.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.model.measurements import Kind
from estimators.settings import EstimatorSettings
from estimators.settings import Kind as EstimatorKind
from estimators.window.problem import WindowProblem
from estimators.window.solving import solve_window
from sim_bridge.studies.lockstep import LockstepResult, run_lockstep
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario
from tests.support import builders

Array = NDArray[np.float64]
ESTIMATORS: tuple[EstimatorKind, ...] = ("dmhe_pre_ekf", "dmhe", "dmhe_shared", "dekf_ci", "centralized_ekf")
ROUNDING_M = 1e-6


def run(recording: StudyInput, kind: EstimatorKind) -> LockstepResult:
    settings = EstimatorSettings(kind=kind, window=3, rounds=2, tolerance=1e-10, max_iterations=500)
    return run_lockstep(recording, settings)


@pytest.fixture(scope="module")
def recording() -> StudyInput:
    """A flight of four on a ring with some packets lost, so that the agents' situations differ."""
    made = StudyScenario(graph="ring4", samples=25).record(11, 1)
    received = np.random.default_rng(1).random(made.received.shape) < 0.8
    gps = made.gps.copy()
    gps[5:9, 2] = np.nan
    return replace(made, received=received, gps=gps)


def fleet_matrix(turn: Array, agents: int) -> Array:
    """A rotation ``(3, 3)`` applied to every position and velocity."""
    return np.asarray(np.kron(np.eye(2 * agents), turn), np.float64)


def about_the_vertical(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    "kind", ESTIMATORS
)
def test_renaming_the_agents(recording: StudyInput, kind: EstimatorKind) -> None:
    # GIVEN the same flight with the agents in another order
    order = np.array([2, 0, 3, 1])  # place k of the new recording is agent order[k] of the old
    states = (6 * order[:, None] + np.arange(6)).ravel()
    place = np.argsort(order)
    assert recording.truth is not None
    renamed = replace(
        recording,
        edges=place[recording.edges],
        accel=recording.accel[:, order],
        gps=recording.gps[:, order],
        ranges=recording.ranges[:, order][:, :, order],
        received=recording.received[:, order][:, :, order],
        x0=recording.x0[order][:, states],
        P0=recording.P0[np.ix_(states, states)],
        truth=recording.truth[:, order],
    )
    if kind == "centralized_ekf":  # starts from the first row: the same one for both
        renamed = replace(renamed, x0=np.tile(recording.x0[0, states], (4, 1)))
    # THEN everybody estimates what it did before
    before, after = run(recording, kind), run(renamed, kind)
    expected = before.mean[:, order][:, :, states]
    np.testing.assert_allclose(after.mean, expected, rtol=0, atol=ROUNDING_M)
    np.testing.assert_allclose(after.cov_diag, before.cov_diag[:, order][:, :, states], rtol=1e-6)
    np.testing.assert_array_equal(after.status, before.status[:, order])


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_moving_the_origin_by_a_kilometre(recording: StudyInput, kind: EstimatorKind) -> None:
    shift = np.array([1000.0, -700.0, 150.0])
    whole = np.tile(np.concatenate([shift, np.zeros(3)]), 4)
    assert recording.truth is not None
    gps, truth = recording.gps.copy(), recording.truth.copy()
    gps[..., :3] += shift
    truth[..., :3] += shift
    moved = replace(recording, gps=gps, truth=truth, x0=recording.x0 + whole)
    before, after = run(recording, kind), run(moved, kind)
    np.testing.assert_allclose(after.mean - whole, before.mean, rtol=0, atol=ROUNDING_M)
    np.testing.assert_allclose(after.cov_diag, before.cov_diag, rtol=1e-6)
    np.testing.assert_array_equal(after.status, before.status)


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_turning_north(recording: StudyInput, kind: EstimatorKind) -> None:
    # GIVEN the same flight seen in a frame turned about the vertical; the noises are equal in both horizontal axes
    turn = about_the_vertical(0.7)
    fleet = fleet_matrix(turn, 4)
    assert recording.truth is not None
    gps, truth = recording.gps.copy(), recording.truth.copy()
    gps[..., :3] = gps[..., :3] @ turn.T
    truth = truth.reshape(len(truth), 24) @ fleet.T
    turned = replace(
        recording,
        gps=gps,
        truth=truth.reshape(recording.truth.shape),
        accel=recording.accel @ turn.T,
        x0=recording.x0 @ fleet.T,
        P0=fleet @ recording.P0 @ fleet.T,
    )
    before, after = run(recording, kind), run(turned, kind)
    np.testing.assert_allclose(after.mean, before.mean @ fleet.T, rtol=0, atol=ROUNDING_M)
    np.testing.assert_array_equal(after.status, before.status)
    vertical = np.arange(2, 24, 3)
    np.testing.assert_allclose(after.cov_diag[:, :, vertical], before.cov_diag[:, :, vertical], rtol=1e-6)


# --- a single window with rows of all kinds ---------------------------------------------------------------------


def solved(problem: WindowProblem) -> tuple[Array, Array]:
    solution = solve_window(problem, EstimatorSettings(tolerance=1e-10, max_iterations=500))
    return solution.path, solution.next_information


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
def test_window_in_any_rotated_frame(with_gains: bool) -> None:
    # GIVEN a window with directions and anchors of its own, turned in space by any rotation; what is not turned is
    # the input noise, so it is made the same in all axes, and heights, which have one axis, are left out
    rng = np.random.default_rng(2)
    kinds = [kind for kind in builders.ALL_KINDS if kind is not Kind.HEIGHT]
    problem, _ = builders.random_window(rng, agents=3, ticks=3, kinds=kinds, with_gains=with_gains)
    problem = problem._replace(accel_variance=np.full_like(problem.accel_variance, 0.3))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    fleet = fleet_matrix(turn, 3)
    rows = problem.rows.copy()
    vectors = np.stack([rows["x"], rows["y"], rows["z"]], axis=1) @ turn.T
    rows["x"], rows["y"], rows["z"] = vectors.T
    information = fleet @ problem.information @ fleet.T
    turned = problem._replace(
        rows=rows,
        accel=np.ascontiguousarray((problem.accel.reshape(-1, 3) @ turn.T).reshape(problem.accel.shape)),
        information=np.ascontiguousarray(0.5 * (information + information.T)),
        vector=fleet @ problem.vector,
    )
    path, information = solved(problem)
    turned_path, turned_information = solved(turned)
    np.testing.assert_allclose(turned_path, path @ fleet.T, rtol=0, atol=1e-8)
    scale = np.abs(information).max()
    np.testing.assert_allclose(turned_information, fleet @ information @ fleet.T, rtol=0, atol=1e-8 * scale)


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
def test_window_a_kilometre_away(with_gains: bool) -> None:
    rng = np.random.default_rng(3)
    problem, _ = builders.random_window(rng, agents=3, ticks=3, with_gains=with_gains)
    shift = np.array([1000.0, -2000.0, 300.0])
    whole = np.tile(np.concatenate([shift, np.zeros(3)]), 3)
    rows = problem.rows.copy()
    direction = np.stack([rows["x"], rows["y"], rows["z"]], axis=1)
    rows["value"] += np.where(rows["kind"] == Kind.POSITION, direction @ shift, 0.0)
    rows["value"] += np.where(rows["kind"] == Kind.HEIGHT, shift[2], 0.0)
    anchors = rows["kind"] == Kind.ANCHOR_RANGE
    for axis, name in enumerate("xyz"):
        rows[name] += np.where(anchors, shift[axis], 0.0)
    moved = problem._replace(rows=rows, vector=problem.vector + problem.information @ whole)
    path, information = solved(problem)
    moved_path, moved_information = solved(moved)
    np.testing.assert_allclose(moved_path - whole, path, rtol=0, atol=ROUNDING_M)
    scale = np.abs(information).max()
    np.testing.assert_allclose(moved_information, information, rtol=0, atol=1e-6 * scale)
