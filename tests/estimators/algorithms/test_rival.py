"""The belief that is held beside an estimate: when there is one, how the two are weighed, what both say together."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.algorithms.rival import Passages, Rival, log_likelihood, placed
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
    rival = Passages(4).rival(rows(0, 1, 2), fleet(1.5, sigma_m=0.75), [0, 1, 2, 3])
    assert rival is not None
    assert rival.slot == BLIND
    assert rival.lead_nats == pytest.approx(0.5 * CREDIT * (3.0 / 0.75) ** 2, rel=0.01)
    assert rival.belief.mean[block(BLIND)] == pytest.approx([1.0, 2.0, -1.5, 0.0, 0.0, 0.0])
    # and of the others it holds the same
    np.testing.assert_array_equal(rival.belief.mean[:18], fleet(1.5).mean[:18])


def test_an_estimate_that_is_sure_of_its_side_begins_with_a_small_lead_all_the_same() -> None:
    rival = Passages(4).rival(rows(0, 1, 2), fleet(1.5, sigma_m=0.4), [0, 1, 2, 3])
    assert rival is not None
    assert rival.lead_nats == 3.0 < 0.5 * CREDIT * (3.0 / 0.4) ** 2


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
        rival = rival.weighed(3.0, solution, solution.cost)
    assert rival.odds_nats == 1.0
    assert rival.weighed(3.0, solution, solution.cost).odds_nats == 4.0


def test_what_is_in_the_window_counts_by_the_optima_and_is_not_summed() -> None:
    belief = SlowBelief.first(np.zeros(6), np.eye(6), np.zeros(0))
    _, solution = solved(belief, np.ones((2, 3)))
    rival = Rival(0, belief, None, 1.0)
    for _ in range(3):
        rival = rival.weighed(0.0, solution, solution.cost - 4.0)
        assert rival.odds_nats == pytest.approx(3.0)


def test_a_rival_that_is_far_likelier_leads_once_it_has_found_its_place() -> None:
    belief = SlowBelief.first(np.zeros(6), np.eye(6), np.zeros(0))
    _, solution = solved(belief, np.zeros((2, 3)))
    leads = {}
    for ahead_nats in (5.0, 7.0):
        rival, leads[ahead_nats] = Rival(0, belief, None, 0.0), []
        for _ in range(12):
            rival = rival.weighed(0.0, solution, solution.cost + 2.0 * ahead_nats)
            leads[ahead_nats].append(rival.leads)
    assert leads == {5.0: 12 * [False], 7.0: 10 * [False] + 2 * [True]}


def test_the_estimate_that_gave_way_is_the_rival_of_the_other() -> None:
    belief = SlowBelief.first(np.zeros(6), np.eye(6), np.zeros(0))
    _, mine = solved(belief, np.zeros((2, 3)))
    _, other = solved(belief, np.ones((2, 3)))
    rival = Rival(0, belief, None, -2.0).weighed(0.0, other, other.cost + 4.0)
    swapped = rival.exchanged(mine)
    assert swapped.last is mine
    assert swapped.belief is mine.arrival
    assert swapped.odds_nats == pytest.approx(4.0)
    assert swapped.probability == pytest.approx(1.0 - rival.probability)
    # THEN nothing is claimed that was not before: the other place is covered as it was
    away = mine.path[-1] - other.path[-1]
    expected = rival.probability * other.covariance + swapped.probability * (mine.covariance + np.outer(away, away))
    np.testing.assert_allclose(swapped.covered(other.path, other.covariance), expected, atol=1e-12)


def test_an_image_goes_with_what_its_neighbours_share() -> None:
    # GIVEN places that are known well relative to each other, and badly together
    rival = Passages(4).rival(rows(0, 1, 2), fleet(1.5, shared_m=20.0), [0, 1, 2, 3])
    assert rival is not None
    # THEN so they are with the drone at its image, only less well across the plane
    away = np.zeros(24)
    away[20], away[[2, 8, 14]] = 1.0, -1.0 / 3.0
    found = rival.belief.covariance
    assert away @ found @ away == pytest.approx(2.0 * 0.5**2, rel=0.01)
    assert found[20, 20] == pytest.approx(20.0**2, rel=0.01)
    assert np.linalg.eigvalsh(found).min() > 0.0


def test_a_drone_that_is_placed_elsewhere_is_known_relative_to_its_neighbours() -> None:
    belief = fleet(1.5, shared_m=20.0)
    there = np.arange(6.0), 0.04 * np.eye(6)
    found = placed(belief, BLIND, there, [0, 1, 2])
    np.testing.assert_array_equal(found.mean[block(BLIND)], there[0])
    np.testing.assert_array_equal(found.covariance[:18, :18], belief.covariance[:18, :18])
    away = np.zeros(24)
    away[18], away[[0, 6, 12]] = 1.0, -1.0 / 3.0
    assert away @ found.covariance @ away == pytest.approx(0.04)
    assert found.covariance[18, 18] == pytest.approx(400.0, rel=0.01)


def test_both_places_are_covered_by_their_probability() -> None:
    belief = SlowBelief.first(np.array([4.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.01 * np.eye(6), np.zeros(0))
    _, solution = solved(belief, np.tile([4.0, 0.0, 0.0], (2, 1)))
    path, covariance = np.zeros((2, 6)), 0.01 * np.eye(6)
    for lead_nats, share in ((0.0, 0.5), (np.log(99.0), 0.01)):
        rival = Rival(0, belief, solution, lead_nats)
        assert rival.probability == pytest.approx(share)
        assert rival.covered(path, covariance)[0, 0] == pytest.approx(share * 16.0, abs=0.02)
    np.testing.assert_array_equal(Rival(0, belief, None, 0.0).covered(path, covariance), covariance)
