"""A place from ranges: found where there is one, and never chosen silently where there are two."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.integrity.consistency import nees
from estimators.model.multilateration import RangeSet, multilaterate

SIGMA_M = 0.06
SPEED_SIGMA_MPS = 3.0


def ranges_of(
    rng: np.random.Generator,
    anchors: int,
    ticks: int,
    *,
    planar: bool = False,
    still: bool = False,
    noise: bool = True,
) -> tuple[RangeSet, np.ndarray]:
    """Ranges of a drone that flies a known curve past moving anchors, and its true state at the reference."""
    places = rng.uniform(-10, 10, (anchors, 3))
    speeds = np.zeros((anchors, 3)) if still else rng.uniform(-1.5, 1.5, (anchors, 3))
    if planar:
        places[:, 2], speeds[:, 2] = -8.0, 0.0
    position, velocity = rng.uniform(-10, 10, 3), rng.uniform(-1.5, 1.5, 3) * (not still)
    rate, radius = rng.uniform(0.2, 1.0), 0.0 if still else 3.0
    columns: list[tuple[np.ndarray, float, np.ndarray, float]] = []
    for tick in range(1, ticks + 1):
        t_s = -0.1 * tick
        moved = radius * np.array([1 - np.cos(rate * t_s), np.sin(rate * t_s) - rate * t_s, 0.0])
        for place, speed in zip(places, speeds, strict=True):
            anchor = place + t_s * speed
            distance = np.linalg.norm(position + t_s * velocity + moved - anchor) + noise * SIGMA_M * rng.normal()
            columns.append((anchor, t_s, moved, float(distance)))
    anchor_m, lead_s, moved_m, range_m = (np.array(column) for column in zip(*columns, strict=True))
    set_ = RangeSet(anchor_m, lead_s, moved_m, range_m, np.full(len(range_m), SIGMA_M**2))
    return set_, np.concatenate((position, velocity))


def test_four_anchors_give_the_place_with_the_covariance_of_its_error() -> None:
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(30):
        ranges, truth = ranges_of(rng, 4, 10)
        place = multilaterate(ranges, SPEED_SIGMA_MPS)
        assert place is not None
        if not len(place.rivals) and place.sigma_m < 1.0:
            assert place.fits
            ratios.append(nees(place.mean - truth, place.covariance) / 6)
    assert len(ratios) >= 25
    assert 0.7 < np.mean(ratios) < 1.5


@pytest.mark.parametrize(("anchors", "planar"), [(3, False), (4, True)])
def test_at_rest_the_mirror_image_is_a_rival_and_is_where_it_must_be(anchors: int, planar: bool) -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        ranges, truth = ranges_of(rng, anchors, 5, planar=planar, still=True, noise=False)
        place = multilaterate(ranges, 0.01)
        assert place is not None
        centre = ranges.anchor_m.mean(axis=0)
        normal = np.linalg.svd(ranges.anchor_m - centre)[2][2]
        away = float((truth[:3] - centre) @ normal)
        if abs(away) < 2.0:
            continue  # its own image: one place, badly known
        mirror = truth[:3] - 2 * away * normal
        found = np.vstack((place.mean[None], place.rivals))[:, :3]
        for one in (truth[:3], mirror):
            assert np.linalg.norm(found - one, axis=1).min() < 0.02


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_an_open_place_is_never_called_sure(seed: int, anchors: int) -> None:
    ranges, truth = ranges_of(np.random.default_rng(seed), anchors, 20)
    place = multilaterate(ranges, SPEED_SIGMA_MPS)
    assert place is not None
    assert np.isfinite(place.mean).all()
    assert np.linalg.eigvalsh(place.covariance)[0] > 0
    if not len(place.rivals) and place.sigma_m < 1.0:
        assert np.linalg.norm(place.mean[:3] - truth[:3]) < 6 * place.sigma_m


def test_no_place_explains_contradicting_ranges() -> None:
    ranges, _ = ranges_of(np.random.default_rng(3), 5, 4)
    ranges.range_m[::5] += 4.0
    place = multilaterate(ranges, SPEED_SIGMA_MPS)
    assert place is not None
    assert not place.fits


def test_without_ranges_there_is_no_place() -> None:
    nothing = RangeSet(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    assert multilaterate(nothing, SPEED_SIGMA_MPS) is None


@given(st.integers(0, 1000))
def test_the_place_moves_and_turns_with_the_anchors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ranges, _ = ranges_of(rng, 5, 6)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    shift = rng.uniform(-50, 50, 3)
    turned = RangeSet(
        ranges.anchor_m @ turn.T + shift,
        ranges.lead_s,
        ranges.moved_m @ turn.T,
        ranges.range_m,
        ranges.variance_m2,
    )
    one, other = multilaterate(ranges, SPEED_SIGMA_MPS), multilaterate(turned, SPEED_SIGMA_MPS)
    assert one is not None
    assert other is not None
    if not len(one.rivals):
        assert other.mean[:3] == pytest.approx(turn @ one.mean[:3] + shift, abs=1e-3)
