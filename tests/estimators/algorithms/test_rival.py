"""The belief that is held beside an estimate: when there is one, how the two are weighed, what both say together."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.algorithms.rival import Passages, Rival, log_likelihood
from estimators.integrity.thresholds import CREDIT
from estimators.model.layout import Layout, block
from estimators.model.measurements import RowTable, input_rows, position_rows, range_row
from estimators.settings import EstimatorSettings
from estimators.systematic.belief import SlowBelief
from estimators.window.assembly import open_window
from estimators.window.slow_window import SlowProblem, SlowSolution, continued, slow_problem, solve_slow

DT = 0.1
BODIES = np.array([[8.0, 0.0, 0.0], [-6.0, 7.0, 0.0], [-5.0, -8.0, 0.0]])
BLIND = 3


def fleet(height_m: float, sigma_m: float = 0.5, shared_m: float = 0.0, bodies: np.ndarray = BODIES) -> SlowBelief:
    """Three bodies, and a drone over their plane that is known so well across it; all share an error."""
    places = np.vstack([bodies, [1.0, 2.0, height_m]])
    mean = np.hstack([places, np.zeros((4, 3))]).ravel()
    covariance = 1e-4 * np.eye(24)
    covariance[20, 20] += sigma_m**2
    shared = np.tile(np.repeat([1.0, 0.0], 3), 4)
    return SlowBelief.first(mean, covariance + shared_m**2 * np.outer(shared, shared), np.zeros(0))


def rows(*fixed: int, ranged: tuple[int, ...] = (0, 1, 2)) -> RowTable:
    """Fixes of some, and ranges of the blind drone to others."""
    tables = [position_rows(0, slot, np.zeros(3), np.ones(3)) for slot in fixed]
    return np.concatenate(tables + [range_row(0, BLIND, slot, 9.0, 0.01) for slot in ranged])


def test_there_is_a_rival_of_a_drone_that_ranges_alone_hold_near_a_plane() -> None:
    rival = Passages(4).rival(rows(0, 1, 2), fleet(1.5), [0, 1, 2, 3])
    assert rival is not None
    assert rival.slot == BLIND
    assert rival.lead_nats == pytest.approx(0.5 * CREDIT * (3.0 / 0.5) ** 2, rel=0.01)
    assert rival.belief.mean[block(BLIND)] == pytest.approx([1.0, 2.0, -1.5, 0.0, 0.0, 0.0])
    # and of the others it holds the same
    np.testing.assert_array_equal(rival.belief.mean[:18], fleet(1.5).mean[:18])


@pytest.mark.parametrize(
    ("fixed", "ranged", "height_m"),
    [
        ((0, 1, 2, 3), (0, 1, 2), 1.5),
        ((0, 1, 2), (0, 1), 1.5),
        ((0, 1, 2), (0, 1, 2), 9.0),
        ((0, 1, 2), (0, 1, 2), 0.3),
    ],
    ids=["with fixes", "two ranges", "far from the plane", "in the plane"],
)
def test_else_there_is_none(fixed: tuple[int, ...], ranged: tuple[int, ...], height_m: float) -> None:
    assert Passages(4).rival(rows(*fixed, ranged=ranged), fleet(height_m), [0, 1, 2, 3]) is None


def test_an_error_that_all_share_does_not_bring_the_drone_nearer_to_the_plane() -> None:
    passages = Passages(4)
    assert passages.rival(rows(0, 1, 2), fleet(9.0, shared_m=20.0), [0, 1, 2, 3]) is None


def test_a_passage_is_remembered_until_the_side_is_decided() -> None:
    # GIVEN a drone that was in the plane, and is far from it by its own word
    passages = Passages(4)
    assert passages.rival(rows(0, 1, 2), fleet(0.3), [0, 1, 2, 3]) is None
    found = passages.rival(rows(0, 1, 2), fleet(6.0), [0, 1, 2, 3])
    # THEN the side is as open as it was there
    assert found is not None
    assert found.lead_nats < 1.0
    for settle in (lambda: passages.settle(BLIND), lambda: passages.rival(rows(0, 1, 2, 3), fleet(6.0), [0, 1, 2])):
        settle()
        assert passages.rival(rows(0, 1, 2), fleet(6.0), [0, 1, 2, 3]) is None


def solved(belief: SlowBelief, fixes: np.ndarray) -> tuple[SlowProblem, SlowSolution]:
    """A window of one tick with a fix ``(2, 3)`` at each end."""
    window = open_window(EstimatorSettings(kind="dmhe_shared", window=1), Layout((1,)), DT)
    for tick, fix in enumerate(fixes):
        window.open(tick)
        given = input_rows(0, 0, np.zeros(3), 0.01)
        window.insert(position_rows(tick, 0, fix, np.full(3, 0.25)), given if tick else given[:0])
    ignored = np.zeros(1, np.bool_)
    problem = slow_problem(window, belief, np.ones((1, 3)), DT, 1e-3, robust=False, ignored=ignored)
    guess = continued(belief.mean[None], problem, np.zeros(0)), np.zeros(0)
    return problem, solve_slow(problem, belief, guess, 50, 1e-10, slide=True)


def test_what_is_foretold_is_weighed_by_its_density() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    belief = SlowBelief.first(rng.normal(size=6), root @ root.T + np.eye(6), np.zeros(0))
    fixes = belief.mean[:3] + rng.normal(size=(2, 3))
    found = log_likelihood(*solved(belief, fixes), belief.covariance)
    spread = belief.covariance[:3, :3] + 0.25 * np.eye(3)
    off = fixes[0] - belief.mean[:3]
    expected = -0.5 * (off @ np.linalg.solve(spread, off) + np.linalg.slogdet(spread)[1])
    assert found == pytest.approx(expected)


def test_one_outlier_does_not_decide() -> None:
    belief = SlowBelief.first(np.zeros(6), 1e-4 * np.eye(6), np.zeros(0))
    near, far = (log_likelihood(*solved(belief, np.full((2, 3), off_m)), belief.covariance) for off_m in (0.0, 50.0))
    assert 100.0 < near - far < 3 * 3.0 * 100.0  # the squares would give 15 000


def test_new_rivals_find_their_place_before_they_are_weighed() -> None:
    belief = SlowBelief.first(np.zeros(6), np.eye(6), np.zeros(0))
    _, solution = solved(belief, np.zeros((2, 3)))
    rival = Rival(0, belief, None, 1.0)
    for _ in range(10):
        rival = rival.weighed(3.0, belief, solution)
    assert rival.lead_nats == 1.0
    assert rival.weighed(3.0, belief, solution).lead_nats == 4.0


def test_both_places_are_covered_by_their_probability() -> None:
    belief = SlowBelief.first(np.array([4.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.01 * np.eye(6), np.zeros(0))
    _, solution = solved(belief, np.tile([4.0, 0.0, 0.0], (2, 1)))
    path, covariance = np.zeros((2, 6)), 0.01 * np.eye(6)
    for lead_nats, share in ((0.0, 0.5), (np.log(99.0), 0.01)):
        rival = Rival(0, belief, solution, lead_nats)
        assert rival.probability == pytest.approx(share)
        assert rival.covered(path, covariance)[0, 0] == pytest.approx(share * 16.0, abs=0.02)
    np.testing.assert_array_equal(Rival(0, belief, None, 0.0).covered(path, covariance), covariance)
