"""Both sides of a plane are held where ranges do not tell them apart."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.integrity.places.hypotheses import Drift, Mixture, predict
from estimators.integrity.places.mirror_images import flat, hold_both_sides, image_of, mirrored_states
from estimators.integrity.thresholds import CREDIT

PLACES = np.array([[8.0, 0.0, 0.0], [-6.0, 7.0, 0.0], [-5.0, -8.0, 0.0]])
STILL = np.zeros((3, 3))
SIGMAS = np.array([0.1, 0.1, 0.5, 0.1, 0.1, 0.1])


def near(height_m: float, climb_mps: float = 0.0) -> Mixture:
    """One hypothesis over the plane z = 0."""
    return Mixture.single(np.array([1.0, 2.0, height_m, 0.0, 0.0, climb_mps]), np.diag(SIGMAS**2))


def test_a_hypothesis_astride_of_the_plane_is_cut_with_its_moments_kept() -> None:
    mixture = near(0.1)
    before = mixture.second_moment(np.zeros(6))
    hold_both_sides(mixture, PLACES, STILL)
    assert {-1.0, 1.0} <= set(np.sign(mixture.means[:, 2]))
    # THEN nothing was learned or lost, but for the images that were added
    np.testing.assert_allclose(mixture.second_moment(np.zeros(6)), before, atol=0.05)


def test_of_a_side_that_is_only_probable_the_other_is_held_as_likely_as_the_gaussian_left_it() -> None:
    mixture = near(1.5)
    hold_both_sides(mixture, PLACES, STILL)
    assert mixture.means[1] == pytest.approx([1.0, 2.0, -1.5, 0.0, 0.0, 0.0])
    expected = 0.5 * CREDIT * (3.0 / 0.5) ** 2
    assert mixture.log_weights[0] - mixture.log_weights[1] == pytest.approx(expected)
    # and it is not added again
    hold_both_sides(mixture, PLACES, STILL)
    assert len(mixture.log_weights) == 2


@pytest.mark.parametrize(("height_m", "climb_mps"), [(5.0, 0.0), (1.5, 2.0)])
def test_a_side_that_is_certain_by_height_or_speed_has_no_image(height_m: float, climb_mps: float) -> None:
    mixture = near(height_m, climb_mps)
    hold_both_sides(mixture, PLACES, STILL)
    assert len(mixture.log_weights) == 1


def test_bodies_that_are_not_in_a_plane_or_too_few_leave_one_place() -> None:
    for places in (np.vstack([PLACES, [0.0, 0.0, 9.0]]), PLACES[:2]):
        mixture = near(0.1)
        hold_both_sides(mixture, places, np.zeros_like(places))
        assert len(mixture.log_weights) == 1
    assert flat(PLACES)
    assert not flat(np.vstack([PLACES, [0.0, 0.0, 9.0]]))


def test_an_image_has_the_same_ranges_and_goes_on_having_them() -> None:
    rng = np.random.default_rng(1)
    places, velocities = PLACES + rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    state = np.array([1.0, 2.0, -3.0, 0.5, -0.4, 0.8])
    image = mirrored_states(state[None], places, velocities)[0]
    for ahead_s in (0.0, 0.1):
        there = places + ahead_s * velocities
        one, other = (each[:3] + ahead_s * each[3:] for each in (state, image))
        np.testing.assert_allclose(np.linalg.norm(there - one, axis=1), np.linalg.norm(there - other, axis=1))
    assert np.linalg.norm(image[:3] - state[:3]) > 1.0


def test_the_covariance_of_an_image_is_the_mirrored_one() -> None:
    spread = np.diag([1.0, 1.0, 0.5, 1.0, 1.0, 1.0])
    spread[0, 2] = spread[2, 0] = 0.3
    _, mirrored = image_of(np.arange(6.0), spread, PLACES, STILL)
    assert mirrored[0, 2] == pytest.approx(-0.3)
    np.testing.assert_allclose(mirrored.diagonal(), spread.diagonal())


def test_an_image_whose_acceleration_errs_goes_on_as_the_image() -> None:
    drift, spread = Drift(0.99, np.full(3, 0.3)), np.diag(np.arange(1.0, 10.0))
    state = np.array([1.0, 2.0, -3.0, 0.5, -0.4, 0.8, 0.3, -0.2, 0.4])
    tilted = PLACES + np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    first, then = Mixture.single(state, spread), Mixture.single(*image_of(state, spread, tilted, STILL))
    for mixture in (first, then):
        predict(mixture, np.zeros(3), np.full(3, 0.01), 0.1, drift)
    mean, covariance = image_of(first.means[0], first.covariances[0], tilted, STILL)
    np.testing.assert_allclose(then.means[0], mean, atol=1e-9)
    np.testing.assert_allclose(then.covariances[0], covariance, atol=1e-9)
    assert np.abs(mean[6:] - first.means[0, 6:]).max() > 0.1
