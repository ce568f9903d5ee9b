"""The second opinion on where a drone without fixes is."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.integrity.ambiguity import BLIND_TICKS, Body, Opinion, Witness, determined
from estimators.model.measurements import RowTable, empty_rows, position_rows, range_row, velocity_rows

DT = 0.1
SURE = np.diag([0.01, 0.01, 0.01, 0.01, 0.01, 0.01])
QUIET = np.full(3, 1e-4)
TRIANGLE = {1: [8.0, 0.0, 0.0], 2: [-6.0, 7.0, 0.0], 3: [-5.0, -8.0, 0.0]}
APEX = {**TRIANGLE, 4: [0.0, 0.0, 9.0]}


def bodies(places: dict[int, list[float]]) -> dict[int, Body]:
    return {slot: (np.array([*place, 0.0, 0.0, 0.0]), 1e-4 * np.eye(6)) for slot, place in places.items()}


def ranges(tick: int, truth: np.ndarray, places: dict[int, list[float]], rng: np.random.Generator) -> RowTable:
    return np.concatenate(
        [
            range_row(tick, 0, slot, float(np.linalg.norm(truth[:3] - place) + rng.normal() * 0.05), 0.0025)
            for slot, place in places.items()
        ]
    )


def watch(
    places: dict[int, list[float]],
    accel: np.ndarray,
    ticks: int,
    at_mirror: bool = False,
    prior_variance: float = 36.0,
) -> tuple[list[Opinion], list[np.ndarray]]:
    """A drone at (1, 2, -6) that starts at rest; its estimate is the truth or its mirror image in z = 0.

    Gives the opinions and the true states.
    """
    rng = np.random.default_rng(1)
    truth = np.array([1.0, 2.0, -6.0, 0.0, 0.0, 0.0])
    side = np.array([1.0, 1.0, -1.0 if at_mirror else 1.0] * 2)
    prior = np.zeros(6), np.diag([prior_variance] * 3 + [1.0] * 3)
    witness = Witness(0, prior, DT)
    opinions, flown = [], []
    estimate = prior
    for tick in range(1, ticks):
        truth[:3] += DT * truth[3:] + 0.5 * DT**2 * accel
        truth[3:] += DT * accel
        witness.advance(empty_rows(), accel, QUIET, False, estimate)
        estimate = side * truth, SURE
        witness.see(ranges(tick, truth, places, rng), bodies(places))
        opinion = witness.judge(estimate)
        assert opinion is not None
        opinions.append(opinion)
        flown.append(truth.copy())
    return opinions, flown


def test_four_neighbours_around_leave_no_doubt() -> None:
    opinions, _ = watch(APEX, np.zeros(3), 20)
    assert not any(opinion.ambiguous for opinion in opinions[5:])


def test_in_front_of_a_plane_of_neighbours_both_sides_are_held_while_nothing_moves() -> None:
    opinions, flown = watch(TRIANGLE, np.zeros(3), 30)
    # THEN the status says so, and what it expects covers the mirror image
    assert all(opinion.ambiguous for opinion in opinions[1:])
    assert opinions[-1].elsewhere is None
    assert opinions[-1].second_moment[2, 2] > 0.05 * (2 * flown[-1][2]) ** 2


@pytest.mark.parametrize("at_mirror", [False, True])
def test_motion_decides_between_the_sides(at_mirror: bool) -> None:
    # GIVEN a known acceleration away from the plane: in the mirror image it would go the other way
    opinions, flown = watch(TRIANGLE, np.array([0.0, 0.0, -1.0]), 40, at_mirror)
    if not at_mirror:
        # THEN an estimate at the true side is confirmed
        assert opinions[2].ambiguous
        assert not opinions[-1].ambiguous
        assert all(opinion.elsewhere is None for opinion in opinions)
        return
    # and one at the wrong side is told where the drone is, but only when the data have decided
    assert all(opinion.ambiguous for opinion in opinions[2:])
    moves = [
        (opinion.elsewhere, truth)
        for opinion, truth in zip(opinions, flown, strict=True)
        if opinion.elsewhere is not None
    ]
    assert moves
    for (mean, covariance), truth in moves:
        error = mean[:3] - truth[:3]
        assert error @ np.linalg.solve(covariance[:3, :3], error) < 16.0


@pytest.mark.parametrize("neighbours", [1, 2])
def test_one_or_two_neighbours_that_hover_do_not_tell(neighbours: int) -> None:
    places = {slot: TRIANGLE[slot] for slot in list(TRIANGLE)[:neighbours]}
    opinions, _ = watch(places, np.zeros(3), 30)
    assert all(opinion.ambiguous for opinion in opinions)


@pytest.mark.parametrize("variance", [0.0001, 100.0])
def test_a_measured_velocity_does_not_tilt_the_scales(variance: float) -> None:
    # GIVEN a witness that holds the same as the estimate, as a mixture of one
    rng = np.random.default_rng(2)
    truth, sure = np.array([1.0, 2.0, -6.0, 0.0, 0.0, 0.0]), np.diag([0.01] * 6)
    witness = Witness(0, (truth, sure), DT)
    for tick in range(1, 200):
        assert witness.mixture is not None
        estimate = witness.mixture.means[0].copy(), witness.mixture.covariances[0].copy()
        rows = velocity_rows(tick, 0, np.zeros(3), np.full(3, variance))
        witness.advance(rows, np.zeros(3), QUIET, False, estimate)
        witness.see(ranges(tick, truth, APEX, rng), bodies(APEX))
    # THEN however many velocities it uses, neither foretells the ranges better
    assert witness._lead_nats == pytest.approx(0.0, abs=1e-6)


def test_it_sleeps_while_there_are_fixes_and_goes_on_from_the_estimate() -> None:
    witness = Witness(0, (np.full(6, 99.0), np.eye(6)), DT)
    here = np.arange(6.0), SURE
    witness.advance(position_rows(1, 0, here[0][:3], np.ones(3)), np.zeros(3), QUIET, True, here)
    witness.see(empty_rows(), {})
    assert witness.judge(here) is None
    for _ in range(BLIND_TICKS - 1):
        witness.advance(empty_rows(), np.zeros(3), QUIET, False, here)
        assert witness.judge(here) is None
    witness.advance(empty_rows(), np.zeros(3), QUIET, False, here)
    opinion = witness.judge(here)
    assert opinion is not None
    assert witness.mixture is not None
    assert witness.mixture.means[0, 3:] == pytest.approx(here[0][3:])


def test_a_neighbour_that_is_not_located_is_not_ranged_to() -> None:
    witness = Witness(0, (np.zeros(6), np.eye(6)), DT)
    witness.advance(empty_rows(), np.zeros(3), QUIET, False, (np.zeros(6), np.eye(6)))
    assert witness.mixture is not None
    before = witness.mixture.means.copy()
    witness.see(range_row(1, 0, 1, 9.0, 0.01), {1: (np.full(6, 3.0), 9.0 * np.eye(6))})
    assert witness.mixture.means == pytest.approx(before)
    witness.see(range_row(1, 0, 1, 9.0, 0.01), {1: (np.full(6, 3.0), 0.01 * np.eye(6))})
    assert not np.allclose(witness.mixture.weights @ witness.mixture.means, before[0])


def test_a_position_is_determined_by_three_directions_that_are_not_in_a_plane() -> None:
    here = np.array([0.0, 0.0, -6.0])
    around = [np.array(place) for place in TRIANGLE.values()]
    assert determined(here, around)
    assert not determined(here, around[:2])
    assert not determined(np.zeros(3), around)  # in the neighbours' own plane
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert determined(turn @ here + 5.0, [turn @ place + 5.0 for place in reversed(around)])


def test_neighbours_that_are_ranged_in_turn_count_together() -> None:
    # GIVEN one range per tick, to one of four neighbours after the other
    rng = np.random.default_rng(3)
    truth = np.array([1.0, 2.0, -6.0, 0.0, 0.0, 0.0])
    witness = Witness(0, (np.zeros(6), np.diag([36.0] * 3 + [1.0] * 3)), DT)
    opinion = None
    for tick in range(1, 60):
        witness.advance(empty_rows(), np.zeros(3), QUIET, False, (truth, SURE))
        slot = 1 + tick % 4
        witness.see(ranges(tick, truth, {slot: APEX[slot]}, rng), bodies(APEX))
        opinion = witness.judge((truth, SURE))
    assert opinion is not None
    assert not opinion.ambiguous
