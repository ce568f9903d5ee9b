"""A fleet and its mirror image: ranges cannot tell them apart, fixes can, and until then nobody is sure."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.estimator import Estimate, Status
from estimators.factory import make_estimator
from estimators.integrity.fleet_mirror import (
    CERTAIN_NATS,
    CREDIT,
    DECISIVE_NATS,
    FleetMirror,
    Image,
    likelihood_ratio,
    mirror_offset,
    mirrored,
)
from estimators.model.layout import Layout
from estimators.model.measurements import RowTable, empty_inputs, empty_rows, position_rows, range_row
from estimators.settings import EstimatorSettings

DT = 0.1
RELAY = EstimatorSettings(kind="dmhe_shared", rounds=0, window=4, other_accel_variance=0.01)
FIX_SIGMA_M = 2.0
PLACES = np.array([[0, 0, 0], [12, 0, 1], [0, 12, -2], [-11, 3, 2.5], [2, -13, -1.5]], float)


def at_rest(places: np.ndarray) -> np.ndarray:
    return np.hstack([places, np.zeros_like(places)]).ravel()


def distances(state: np.ndarray) -> np.ndarray:
    places = state.reshape(-1, 6)[:, :3]
    return np.linalg.norm(places[:, None] - places[None], axis=-1)


def shape_error_m(state: np.ndarray, places: np.ndarray) -> float:
    """RMS distance per agent."""
    return float(np.sqrt(np.mean(np.sum((state.reshape(-1, 6)[:, :3] - places) ** 2, axis=-1))))


def image_of(mirror: FleetMirror, state: np.ndarray) -> Image | None:
    """With nothing that was not weighed."""
    return mirror.image(state, empty_rows(), np.zeros(1, np.int64), [], 1e-3)


def test_the_image_has_the_same_ranges_centre_and_motion_and_is_its_own_inverse() -> None:
    rng = np.random.default_rng(1)
    state = rng.normal(size=30) * 5.0
    image = state + mirror_offset(state)
    np.testing.assert_allclose(distances(image), distances(state), atol=1e-12)
    np.testing.assert_allclose(image.reshape(5, 6).mean(0), state.reshape(5, 6).mean(0), atol=1e-12)
    np.testing.assert_allclose(image + mirror_offset(image), state, atol=1e-12)
    assert np.linalg.norm(image - state) > 1.0


@pytest.mark.parametrize("turn", range(3))
def test_the_image_does_not_depend_on_names_and_axes(turn: int) -> None:
    rng = np.random.default_rng(turn)
    state = rng.normal(size=(5, 2, 3)) * np.array([9.0, 6.0, 2.0])
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    order = rng.permutation(5)
    offset = mirror_offset(state.ravel()).reshape(5, 2, 3)
    other = mirror_offset((state[order] @ rotation + 100.0).ravel()).reshape(5, 2, 3)
    np.testing.assert_allclose(other, offset[order] @ rotation, atol=1e-10)


def test_the_ratio_is_that_of_gaussian_densities_of_the_fixes_and_ranges_say_nothing() -> None:
    rng = np.random.default_rng(2)
    here, there = at_rest(PLACES), at_rest(PLACES + rng.normal(size=PLACES.shape))
    fixes = [rng.normal(size=3) * 3.0 for _ in PLACES]
    rows = np.concatenate([position_rows(1, k, fix, np.full(3, 4.0)) for k, fix in enumerate(fixes)])
    expected = sum(
        0.5 * (np.sum((fix - b) ** 2) - np.sum((fix - a) ** 2)) / 4.0
        for fix, a, b in zip(fixes, here.reshape(-1, 6)[:, :3], there.reshape(-1, 6)[:, :3], strict=True)
    )
    assert likelihood_ratio(rows, here, there, 1e-3) == pytest.approx(expected)
    assert likelihood_ratio(range_row(1, 0, 1, 3.0, 0.01), here, there, 1e-3) == 0.0


def test_the_odds_are_what_the_closest_passage_left_and_what_fixes_add() -> None:
    mirror, state = FleetMirror(), at_rest(PLACES)
    rows = np.concatenate([position_rows(1, k, place, np.full(3, 100.0)) for k, place in enumerate(PLACES)])
    assert image_of(mirror, state) is None
    # GIVEN a passage with sigmas as large as the fleet is thick
    offset = mirror_offset(state)
    information = np.eye(30) * 4.0 / (CREDIT * offset @ offset)
    mirror.pass_by(state, information)
    assert mirror.lead_nats == pytest.approx(2.0)
    # THEN the covariance holds the image by its probability
    image = image_of(mirror, state)
    assert image is not None
    assert image.probability == pytest.approx(1.0 / (1.0 + np.exp(2.0)))
    covered = image.covered(np.zeros((30, 30)))
    np.testing.assert_allclose(covered, image.probability * np.outer(offset, offset))
    # and fixes at the estimate take the doubt away, up to a bound
    mirror.weigh(rows, state, 1e-3)
    assert mirror.lead_nats == pytest.approx(2.0 + 0.5 * float(offset @ offset) / 100.0)
    for _ in range(1000):
        mirror.weigh(rows, state, 1e-3)
    assert mirror.lead_nats == CERTAIN_NATS
    # where the matter is closed, whatever the errors of fixes add up to
    for _ in range(1000):
        mirror.weigh(rows, state + offset, 1e-3)
    assert mirror.lead_nats == CERTAIN_NATS
    # until the next passage, after which fixes at the image say that it is the one
    mirror.pass_by(state, information)
    while not mirror.reversed:
        mirror.weigh(rows, state + offset, 1e-3)
    assert -2.0 * DECISIVE_NATS < mirror.lead_nats < -DECISIVE_NATS


def test_three_drones_are_their_own_image() -> None:
    mirror, state = FleetMirror(), at_rest(PLACES[:3])
    mirror.pass_by(state, np.zeros((18, 18)))
    mirror.weigh(position_rows(1, 0, PLACES[1], np.ones(3)), state, 1e-3)
    assert (mirror.lead_nats, image_of(mirror, state)) == (CERTAIN_NATS, None)


def test_a_mirrored_estimate_knows_its_ranges_as_well_and_its_direction_less() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(30, 30))
    mean, information = at_rest(PLACES) + 0.1 * rng.normal(size=30), root @ root.T + np.eye(30)
    before = np.linalg.inv(information)
    there, after = mirrored(mean, before)
    np.testing.assert_allclose(there, mean + mirror_offset(mean), atol=1e-12)

    def range_variance(state: np.ndarray, covariance: np.ndarray, a: int, b: int) -> float:
        slope = np.zeros((5, 6))
        along = state.reshape(5, 6)[a, :3] - state.reshape(5, 6)[b, :3]
        slope[a, :3] = along / np.linalg.norm(along)
        slope[b, :3] = -slope[a, :3]
        return float(slope.ravel() @ covariance @ slope.ravel())

    for a, b in ((0, 1), (2, 4), (1, 3)):
        assert range_variance(there, after, a, b) == pytest.approx(range_variance(mean, before, a, b), rel=1e-6)
    assert np.trace(after) > np.trace(before) + 1.0


def fly(start: np.ndarray, ticks: int, seed: int) -> list[Estimate]:
    """One of five drones at rest whose first estimate is ``start``, with poor fixes and good ranges."""
    rng = np.random.default_rng(seed)
    layout = Layout((1, 2, 3, 4, 5))
    covariance = np.kron(np.eye(5), np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01]))
    estimator = make_estimator(RELAY, layout, 3, at_rest(start), covariance, DT)
    estimates = []
    for tick in range(ticks):
        estimator.begin(tick, rows_of(tick, rng), empty_inputs())
        estimates.append(estimator.solve())
    return estimates


def rows_of(tick: int, rng: np.random.Generator) -> RowTable:
    tables = [
        position_rows(tick, k, place + rng.normal(size=3) * FIX_SIGMA_M, np.full(3, FIX_SIGMA_M**2))
        for k, place in enumerate(PLACES)
    ]
    for a in range(5):
        for b in range(a):
            away_m = float(np.linalg.norm(PLACES[a] - PLACES[b]))
            tables.append(range_row(tick, a, b, away_m + float(rng.normal()) * 0.1, 0.01))
    return np.concatenate(tables)


@pytest.mark.parametrize("seed", range(3))
def test_a_fleet_taken_for_its_mirror_image_says_so_and_is_set_right(seed: int) -> None:
    # GIVEN an estimate at the mirror image, sure of itself
    image = (at_rest(PLACES) + mirror_offset(at_rest(PLACES))).reshape(-1, 6)[:, :3]
    estimates = fly(image, 80, seed)
    # THEN it doubts itself, is set right once, and is right from then on
    doubted = [k for k, e in enumerate(estimates) if e.status is Status.NOT_OBSERVABLE]
    assert sum(e.report.moves for e in estimates) == 1
    moved = next(k for k, e in enumerate(estimates) if e.report.moves)
    assert doubted
    assert doubted[0] <= moved < 60
    assert shape_error_m(estimates[moved - 1].mean, PLACES) > 1.5
    assert shape_error_m(estimates[-1].mean, PLACES) < 1.0
    assert estimates[-1].status is Status.OK


@pytest.mark.parametrize("seed", range(3))
def test_a_fleet_that_is_right_stays_so_and_does_not_doubt(seed: int) -> None:
    estimates = fly(PLACES, 80, seed)
    assert not any(e.report.moves for e in estimates)
    assert all(e.status is Status.OK for e in estimates[10:])
    assert shape_error_m(estimates[-1].mean, PLACES) < 1.0


@pytest.mark.parametrize("seed", range(6))
def test_fixes_that_err_alike_for_minutes_do_not_turn_a_fleet_around(seed: int) -> None:
    # GIVEN four drones whose places are known well, and receivers that are off by as much as the fleet is thick
    rng = np.random.default_rng(seed)
    layout, places = Layout((1, 2, 3, 4)), PLACES[:4]
    estimator = make_estimator(RELAY, layout, 0, at_rest(places), 0.01 * np.eye(24), DT)
    wander = rng.normal(size=(4, 3)) * 2.0
    for tick in range(150):
        tables = [position_rows(tick, k, places[k] + wander[k], np.full(3, FIX_SIGMA_M**2)) for k in range(4)]
        for a in range(4):
            for b in range(a):
                tables.append(range_row(tick, a, b, float(np.linalg.norm(places[a] - places[b])), 0.01))
        estimator.begin(tick, np.concatenate(tables), empty_inputs())
        # THEN it is never taken for its mirror image
        assert estimator.solve().report.moves == 0


def test_a_flat_fleet_is_never_sure_of_what_is_above_and_what_below() -> None:
    # GIVEN drones within a decimetre of a plane, whose fixes are good to two metres
    flat = PLACES * np.array([1.0, 1.0, 0.04])
    rng = np.random.default_rng(5)
    mirror, state = FleetMirror(), at_rest(flat)
    mirror.pass_by(state, np.kron(np.eye(5), np.diag([100.0, 100.0, 4.0, 1e4, 1e4, 100.0])))
    for _ in range(20):
        fixes = [
            position_rows(1, k, place + rng.normal(size=3) * 2.0, np.full(3, 4.0)) for k, place in enumerate(flat)
        ]
        mirror.weigh(np.concatenate(fixes), state, 1e-3)
    image = image_of(mirror, state)
    assert image is not None
    assert 0.2 < image.probability < 0.8
