"""Sets hold what they must hold: random trials with the truth inside, on the rim, and errors at their bounds.

``FLEETLOC_CONTAINMENT_TRIALS`` sets their number; 100 000 are what the published figure is of.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

from estimators.integrity.sets.cuts import Outcome, Strip, cut, predicted, strip_of_range
from estimators.integrity.sets.ellipsoid import Ellipsoid, box_ellipsoid, interval_ellipsoid
from estimators.integrity.sets.relative import Conflict, RelativeBounds, RelativeFilter
from estimators.model.measurements import Matrix, Vector

TRIALS = int(os.environ.get("FLEETLOC_CONTAINMENT_TRIALS", "2000"))
STEPS = max(TRIALS // 5, 400)
ROUNDING = 1e-9


def random_set(rng: np.random.Generator, n: int) -> Ellipsoid:
    """Axes from 0.03 to 30."""
    turned = np.linalg.qr(rng.normal(size=(n, n)))[0]
    shape = turned @ np.diag(10.0 ** rng.uniform(-3.0, 3.0, n)) @ turned.T
    return Ellipsoid(rng.normal(size=n) * 10.0, 0.5 * (shape + shape.T))


def point_of(held: Ellipsoid, rng: np.random.Generator) -> Vector:
    """A point of a set, every other time on its rim."""
    direction = rng.normal(size=len(held.centre))
    direction /= np.linalg.norm(direction)
    radius = 1.0 if rng.random() < 0.5 else rng.random()
    return np.asarray(held.centre + radius * np.linalg.cholesky(held.shape) @ direction)


def at_bound(rng: np.random.Generator) -> float:
    """-1..1, every other time one of the two."""
    return float(rng.choice((-1.0, 1.0)) if rng.random() < 0.5 else rng.uniform(-1.0, 1.0))


def test_what_is_in_set_and_strip_is_in_the_cut() -> None:
    rng = np.random.default_rng(1)
    cuts = 0
    for trial in range(TRIALS):
        held = random_set(rng, 2 + trial % 5)
        inside = point_of(held, rng)
        row = rng.normal(size=len(inside))
        width = float(np.sqrt(row @ held.shape @ row)) * 10.0 ** rng.uniform(-3.0, 0.5)
        middle = float(row @ inside) + at_bound(rng) * width
        made = cut(held, Strip(row, middle - width, middle + width))
        assert made.outcome is not Outcome.EMPTY
        assert made.ellipsoid.level(inside) <= 1.0 + ROUNDING
        assert made.ellipsoid.trace <= held.trace * (1.0 + ROUNDING)
        cuts += made.outcome is Outcome.CUT
    assert cuts > TRIALS // 3


def test_what_fits_a_range_is_in_the_cut() -> None:
    rng = np.random.default_rng(2)
    origin_inside = 0
    for trial in range(TRIALS):
        held = random_set(rng, 3)
        inside = point_of(held, rng)
        width = 10.0 ** rng.uniform(-2.0, 0.5)
        range_m = float(np.linalg.norm(inside)) + at_bound(rng) * width
        u = rng.normal(size=3)
        strip, rho = strip_of_range(held, range_m, width, direction=u / np.linalg.norm(u) if trial % 4 == 0 else None)
        assert rho >= 0.0
        assert strip.low - ROUNDING <= strip.row @ inside <= strip.high + ROUNDING
        made = cut(held, strip)
        assert made.outcome is not Outcome.EMPTY
        assert made.ellipsoid.level(inside) <= 1.0 + ROUNDING
        origin_inside += held.level(np.zeros(3)) <= 1.0
    assert origin_inside > TRIALS // 100


def test_a_range_between_two_places_cuts_both() -> None:
    rng = np.random.default_rng(3)
    between = np.hstack([np.eye(3), -np.eye(3)])
    for _ in range(TRIALS // 5):
        held = random_set(rng, 6)
        inside = point_of(held, rng)
        width = 10.0 ** rng.uniform(-2.0, 0.5)
        range_m = float(np.linalg.norm(between @ inside)) + at_bound(rng) * width
        made = cut(held, strip_of_range(held, range_m, width, of=between)[0])
        assert made.outcome is not Outcome.EMPTY
        assert made.ellipsoid.level(inside) <= 1.0 + ROUNDING


def test_the_sum_of_two_sets_is_in_the_prediction_and_the_least() -> None:
    rng = np.random.default_rng(4)
    for trial in range(TRIALS // 5):
        n = 2 + trial % 5
        held, noise, transition = random_set(rng, n), random_set(rng, n), rng.normal(size=(n, n))
        moved = rng.normal(size=n)
        made = predicted(held, transition, moved, noise.shape)
        ended = transition @ point_of(held, rng) + moved + point_of(Ellipsoid(np.zeros(n), noise.shape), rng)
        assert made.level(ended) <= 1.0 + ROUNDING
        before = transition @ held.shape @ transition.T
        assert made.trace == pytest.approx((np.sqrt(np.trace(before)) + np.sqrt(np.trace(noise.shape))) ** 2)


@pytest.mark.parametrize("transition", [np.zeros((3, 3)), np.eye(3)])
def test_a_prediction_without_noise_or_without_a_set(transition: Matrix) -> None:
    held = random_set(np.random.default_rng(5), 3)
    noise = np.zeros((3, 3)) if transition.any() else random_set(np.random.default_rng(6), 3).shape
    made = predicted(held, transition, np.zeros(3), noise)
    np.testing.assert_allclose(made.shape, held.shape if transition.any() else noise, rtol=1e-12)


def test_a_flat_set_is_cut_exactly() -> None:
    line = Ellipsoid(np.zeros(3), np.outer([4.0, 0.0, 0.0], [4.0, 0.0, 0.0]))
    made = cut(line, Strip(np.array([1.0, 0.0, 0.0]), 1.0, 3.0))
    assert made.outcome is Outcome.CUT
    np.testing.assert_allclose(made.ellipsoid.centre, [2.0, 0.0, 0.0])
    np.testing.assert_allclose(made.ellipsoid.half_axes(), [1.0, 0.0, 0.0], atol=1e-9)
    assert cut(line, Strip(np.array([0.0, 1.0, 0.0]), -1.0, 1.0)).outcome is Outcome.UNCHANGED
    assert cut(line, Strip(np.array([0.0, 1.0, 0.0]), 1.0, 2.0)).outcome is Outcome.EMPTY


def test_the_least_range_is_never_above_that_of_any_point() -> None:
    rng = np.random.default_rng(7)
    zero = 0
    for _ in range(TRIALS // 10):
        held = random_set(rng, 3)
        directions = rng.normal(size=(400, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        rim = held.centre + directions @ np.linalg.cholesky(held.shape).T
        least = held.min_range()
        assert least <= np.linalg.norm(rim, axis=1).min() * (1.0 + ROUNDING)
        if held.level(np.zeros(3)) > 1.0 + 1e-6:
            assert least > 0.0
        else:
            assert least == pytest.approx(0.0, abs=1e-6)
            zero += 1
    assert zero


def test_the_least_range_of_a_ball_is_exact() -> None:
    assert Ellipsoid(np.array([6.0, 0.0, 8.0]), 4.0 * np.eye(3)).min_range() == pytest.approx(8.0, rel=1e-9)


def test_boxes_and_intervals_hold_their_corners() -> None:
    rng = np.random.default_rng(8)
    for _ in range(100):
        widths = rng.uniform(0.1, 5.0, 3)
        corner = widths * rng.choice((-1.0, 1.0), 3)
        assert box_ellipsoid(np.zeros(3), widths).level(corner) == pytest.approx(1.0)
        rows, truth = rng.normal(size=(6, 3)), rng.normal(size=3)
        bounds = rng.uniform(0.1, 1.0, 6)
        held = interval_ellipsoid(rows, rows @ truth + bounds * rng.choice((-1.0, 1.0), 6), bounds)
        assert held.level(truth) <= 1.0 + ROUNDING
    with pytest.raises(np.linalg.LinAlgError, match="do not determine"):
        interval_ellipsoid(np.eye(3)[:2], np.zeros(2), np.ones(2))


def test_errors_at_their_bounds_step_after_step() -> None:
    # GIVEN a neighbour on an eight, a displacement within 2 cm, fixes within 3 m and ranges within 0.5 m
    rng = np.random.default_rng(9)
    relative, worst = RelativeFilter(0.1), 0.0
    where = [
        10.0 * np.array([np.sin(0.02 * k), np.sin(0.04 * k), 0.3 + 0.1 * np.sin(0.03 * k)]) for k in range(STEPS)
    ]
    for k, truth in enumerate(where):
        step = truth - where[k - 1] if k else np.zeros(3)
        # WHEN every error is at its bound, of either sign
        signs = rng.choice((-1.0, 1.0), 7)
        fix = truth + 3.0 * signs[3:6]
        ranges = np.array([[np.linalg.norm(truth) + 0.5 * signs[6], 0.5, 0.0, 0.0, 0.0]])
        if k % 3:  # fixes and ranges come less often
            fix, ranges = np.full(3, np.nan), ranges[:0]
        low, high = np.nan_to_num(fix - 3.0, nan=-np.inf), np.nan_to_num(fix + 3.0, nan=np.inf)
        bounds = RelativeBounds(step + 0.02 * signs[:3], np.full(3, 0.02), low, high, ranges)
        assert relative.observe(bounds) is Conflict.NONE
        held = relative.set
        assert held is not None
        # THEN the truth is inside, and the set stays sound
        worst = max(worst, held.level(truth))
        np.testing.assert_array_equal(held.shape, held.shape.T)
        assert np.linalg.eigvalsh(held.shape)[0] > 0.0
    assert 0.3 < worst <= 1.0 + ROUNDING
