"""A fleet and its mirror image: ranges cannot tell them apart, fixes can, and until then nobody is sure."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.estimator import Estimate, Status
from estimators.factory import make_estimator
from estimators.integrity.finding import Finding, Gravity, What, has
from estimators.integrity.places.fleet_mirror import (
    CREDIT,
    FleetMirrorMonitor,
    MirrorImage,
    likelihood_ratio,
    mirrored,
)
from estimators.integrity.places.fleet_mirror import mirror_offset as offset_of_bodies
from estimators.integrity.thresholds import CERTAIN_NATS, DECISIVE_NATS
from estimators.integrity.window_evidence import WindowEvidence
from estimators.model.layout import Layout
from estimators.model.measurements import RowTable, empty_inputs, empty_rows, position_rows, range_row
from estimators.settings import EstimatorSettings

DT = 0.1
SHARED = EstimatorSettings(kind="dmhe_shared", rounds=0, window=4, other_accel_variance=0.01)
FIX_SIGMA_M = 2.0
PLACES = np.array([[0, 0, 0], [12, 0, 1], [0, 12, -2], [-11, 3, 2.5], [2, -13, -1.5]], float)


def everybody(state: np.ndarray) -> np.ndarray:
    return np.ones(len(state) // 6, np.bool_)


def mirror_offset(state: np.ndarray) -> np.ndarray:
    """Of a fleet without targets."""
    return offset_of_bodies(state, everybody(state))


def at_rest(places: np.ndarray) -> np.ndarray:
    return np.hstack([places, np.zeros_like(places)]).ravel()


def distances(state: np.ndarray) -> np.ndarray:
    places = state.reshape(-1, 6)[:, :3]
    return np.linalg.norm(places[:, None] - places[None], axis=-1)


def shape_error_m(state: np.ndarray, places: np.ndarray) -> float:
    """RMS distance per agent."""
    return float(np.sqrt(np.mean(np.sum((state.reshape(-1, 6)[:, :3] - places) ** 2, axis=-1))))


def evidence(
    state: np.ndarray,
    rows: RowTable,
    start: list[int],
    information: np.ndarray | None = None,
    *,
    slide: bool = True,
    targets: int = 0,
) -> WindowEvidence:
    """A window of one tick over an estimate that stands still, whose last ``targets`` bodies are no vehicles.

    ``information`` of the arrival cost; without, the estimate is far from a passage.
    """
    n = len(state) // 6
    return WindowEvidence(
        rows=rows,
        start=np.array(start),
        accel_variance=np.ones((1, 3 * n)),
        path=np.array([state, state]),
        arrival_mean=state,
        arrival_information=1e6 * np.eye(6 * n) if information is None else information,
        slide=slide,
        vehicles=np.arange(n) < n - targets,
        period_s=DT,
        norm_smoothing=1e-3,
    )


def look(
    monitor: FleetMirrorMonitor, state: np.ndarray, rows: RowTable, information: np.ndarray | None = None
) -> tuple[Finding, ...]:
    """What is found as ``rows`` leave the window."""
    return monitor.observe(evidence(state, rows, [0, len(rows), len(rows)], information))


def passage(state: np.ndarray) -> np.ndarray:
    """The information of an estimate that leaves two nats for it against its image: odds of 7."""
    offset = mirror_offset(state)
    return np.asarray(np.eye(len(state)) * 4.0 / (CREDIT * offset @ offset))


def image_in(found: tuple[Finding, ...]) -> MirrorImage:
    (image,) = [finding for finding in found if isinstance(finding, MirrorImage)]
    return image


def fixes_at(state: np.ndarray, variance: float) -> RowTable:
    places = state.reshape(-1, 6)[:, :3]
    return np.concatenate([position_rows(1, k, place, np.full(3, variance)) for k, place in enumerate(places)])


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
    monitor, state = FleetMirrorMonitor(), at_rest(PLACES)
    offset = mirror_offset(state)
    right, wrong = fixes_at(state, 100.0), fixes_at(state + offset, 100.0)
    assert look(monitor, state, empty_rows()) == ()
    # GIVEN a passage with sigmas as large as the fleet is thick
    image = image_in(look(monitor, state, empty_rows(), passage(state)))
    # THEN the covariance holds the image by its probability
    assert (image.what, image.gravity) == (What.MIRRORED, Gravity.ALARM)
    assert image.probability == pytest.approx(1.0 / (1.0 + np.exp(2.0)))
    np.testing.assert_allclose(image.covered(np.zeros((30, 30))), image.probability * np.outer(offset, offset))
    # and fixes at the estimate take the doubt away by their likelihood
    gained = 0.5 * float(offset @ offset) / 100.0
    assert image_in(look(monitor, state, right)).probability == pytest.approx(1.0 / (1.0 + np.exp(2.0 + gained)))
    for _ in range(round(2 * CERTAIN_NATS / gained)):
        found = look(monitor, state, right)
    assert found == ()
    # whereupon the matter is closed, whatever the errors of fixes add up to
    assert all(look(monitor, state, wrong) == () for _ in range(1000))
    # until the next passage, after which fixes at the image say that it is the one
    look(monitor, state, empty_rows(), passage(state))
    needed = 1
    while not has(found := look(monitor, state, wrong), What.REVERSED):
        needed += 1
    assert needed == pytest.approx((2.0 + DECISIVE_NATS) / gained, abs=1.0)
    # and then the image, which is the estimate from now on, is as sure as the estimate was wrong
    (reversal,) = found
    assert reversal.value is not None
    assert DECISIVE_NATS < reversal.value < 2.0 * DECISIVE_NATS
    assert look(monitor, state + offset, wrong) == ()


def test_what_has_not_left_the_window_counts_too_but_is_not_kept() -> None:
    monitor, state = FleetMirrorMonitor(), at_rest(PLACES)
    rows = fixes_at(state, float(mirror_offset(state) @ mirror_offset(state)))  # half a nat
    m = len(rows)
    look(monitor, state, empty_rows(), passage(state))
    for start, slide in (([0, 0, m], True), ([0, m, m], False), ([0, 0, m], True)):
        image = image_in(monitor.observe(evidence(state, rows, start, slide=slide)))
        assert image.probability == pytest.approx(1.0 / (1.0 + np.exp(2.5)))


def test_a_reversal_turns_the_odds_around() -> None:
    # GIVEN fixes that speak for the image with 20 nats, after a passage that left two for the estimate
    monitor, state = FleetMirrorMonitor(), at_rest(PLACES)
    offset = mirror_offset(state)
    square = float(offset @ offset)
    look(monitor, state, empty_rows(), passage(state))
    (reversal,) = look(monitor, state, fixes_at(state + offset, 0.5 * square / 20.0))
    assert reversal.what is What.REVERSED
    assert reversal.value == pytest.approx(18.0)
    # WHEN later ones speak for what it was THEN that is the image by now, with the odds of both
    image = image_in(look(monitor, state + offset, fixes_at(state, 0.5 * square / 12.0)))
    np.testing.assert_allclose(image.offset, -offset, atol=1e-9)
    assert image.probability == pytest.approx(1.0 / (1.0 + np.exp(18.0 - 12.0)))


def test_whose_place_is_doubted_follows_from_how_far_its_image_is() -> None:
    monitor, state = FleetMirrorMonitor(), at_rest(PLACES)
    image = image_in(look(monitor, state, empty_rows(), np.zeros((30, 30))))
    away_m = np.linalg.norm(image.offset.reshape(5, 6)[:, :3], axis=1)
    assert image.doubtful(1e-4 * np.eye(30)).tolist() == (np.sqrt(image.probability) * away_m > 0.15).tolist()
    assert not image.doubtful(1e4 * np.eye(30)).any()


def test_three_drones_are_their_own_image() -> None:
    monitor, state = FleetMirrorMonitor(), at_rest(PLACES[:3])
    for _ in range(10):
        assert look(monitor, state, position_rows(1, 0, PLACES[1], np.ones(3)), np.zeros((18, 18))) == ()


FAR_TARGET = np.array([-400.0, 30.0, 15.0])


def with_target(information: np.ndarray, along: np.ndarray, weight: float) -> np.ndarray:
    """A fleet's information, and that of a target of which ranges of one drone say a little along one direction."""
    both = np.zeros((36, 36))
    both[:30, :30] = information
    slope = np.concatenate([np.zeros(24), along, np.zeros(3), -along, np.zeros(3)])
    return both + weight * np.outer(slope, slope) + 1e-6 * np.eye(36)


def test_a_target_far_behind_that_is_hardly_known_takes_nothing_from_what_the_fleet_is_sure_of() -> None:
    # GIVEN a fleet that is well known on its side of its plane, and a target of which next to nothing is known
    information = 1e3 * np.eye(30)
    both = with_target(information, np.array([1.0, 0.0, 0.0]), 1.0)
    state = at_rest(np.vstack([PLACES, FAR_TARGET]))
    monitor = FleetMirrorMonitor()
    # THEN nothing is doubted, and the fleet has the image that it has without the target
    assert monitor.observe(evidence(state, empty_rows(), [0, 0, 0], both, targets=1)) == ()
    fleet = np.arange(6) < 5
    np.testing.assert_allclose(offset_of_bodies(state, fleet)[:30], mirror_offset(state[:30]), atol=1e-9)
    # and the target's image is ranged to as the target is
    np.testing.assert_allclose(distances(state + offset_of_bodies(state, fleet)), distances(state), atol=1e-9)


def test_a_fleet_that_is_hardly_known_is_doubted_whatever_is_known_of_a_target() -> None:
    # GIVEN a passage of the fleet, with a target that is ranged to precisely
    state = at_rest(np.vstack([PLACES, FAR_TARGET]))
    both = with_target(passage(state[:30]), np.array([0.0, 0.0, 1.0]), 1e6)
    image = image_in(FleetMirrorMonitor().observe(evidence(state, empty_rows(), [0, 0, 0], both, targets=1)))
    # THEN the range between the two, which both images fit, tells nothing of the side
    assert image.probability == pytest.approx(1.0 / (1.0 + np.exp(2.0)), rel=1e-3)


def test_three_drones_and_a_target_are_their_own_image() -> None:
    state = at_rest(np.vstack([PLACES[:3], FAR_TARGET]))
    assert FleetMirrorMonitor().observe(evidence(state, empty_rows(), [0, 0, 0], np.eye(24), targets=1)) == ()


def test_a_fleet_and_its_target_are_mirrored_together() -> None:
    # GIVEN an estimate in which the distance from a drone to the target is all that is well known
    state, fleet = at_rest(np.vstack([PLACES, FAR_TARGET])), np.arange(6) < 5
    along = (FAR_TARGET - PLACES[4]) / np.linalg.norm(FAR_TARGET - PLACES[4])
    covariance = np.linalg.inv(with_target(1e-2 * np.eye(30), along, 1e4))
    # WHEN it is mirrored
    there, after = mirrored(state, covariance, fleet)
    # THEN the distance is what it was and as well known
    assert distances(there)[4, 5] == pytest.approx(distances(state)[4, 5])
    turned = (there - state).reshape(6, 6)[5, :3] + FAR_TARGET - there.reshape(6, 6)[4, :3]
    slope = np.concatenate([np.zeros(24), turned, np.zeros(3), -turned, np.zeros(3)]) / np.linalg.norm(turned)
    assert slope @ after @ slope == pytest.approx(1e-4, rel=0.02)


def test_a_mirrored_estimate_knows_its_ranges_as_well_and_its_direction_less() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(30, 30))
    mean, information = at_rest(PLACES) + 0.1 * rng.normal(size=30), root @ root.T + np.eye(30)
    before = np.linalg.inv(information)
    there, after = mirrored(mean, before, everybody(mean))
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
    estimator = make_estimator(SHARED, layout, 3, at_rest(start), covariance, DT)
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
    estimator = make_estimator(SHARED, layout, 0, at_rest(places), 0.01 * np.eye(24), DT)
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
    monitor, state = FleetMirrorMonitor(), at_rest(flat)
    look(monitor, state, empty_rows(), np.kron(np.eye(5), np.diag([100.0, 100.0, 4.0, 1e4, 1e4, 100.0])))
    for _ in range(20):
        fixes = [
            position_rows(1, k, place + rng.normal(size=3) * 2.0, np.full(3, 4.0)) for k, place in enumerate(flat)
        ]
        found = look(monitor, state, np.concatenate(fixes))
    assert 0.2 < image_in(found).probability < 0.8
