"""Ranges that share errors: a place with the covariance of its error, between limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.integrity.consistency import nees
from estimators.model.joint_ranges import SharedErrors, locate_jointly
from estimators.model.multilateration import RangeSet, multilaterate

SPEED_SIGMA_MPS = 3.0
EVERYWHERE = np.full(6, -np.inf), np.full(6, np.inf)


def shared_ranges(rng: np.random.Generator) -> tuple[RangeSet, SharedErrors, np.ndarray]:
    """Ranges of anchors that fly by a target and are not where they are said to be; its state."""
    anchors, ticks, sigma_m, bias_m = 6, 20, 0.5, 0.4
    spread = 0.25 * np.diag([1.0, 1.0, 4.0])
    places = rng.uniform([-80, -60, -70], [0, 60, -40], (anchors, 3))
    off = rng.multivariate_normal(np.zeros(3), spread, anchors)
    source = np.tile(np.arange(anchors), ticks)
    lead_s = -np.repeat(np.arange(ticks), anchors).astype(float)
    said = places[source] + lead_s[:, None] * np.array([5.0, 0.0, 0.0])
    state = np.array([*rng.uniform([-100, -50, -5], [40, 50, 5]), 1.0, -1.0, 0.0])
    away = state[:3] + lead_s[:, None] * state[3:] - (said + off[source])
    range_m = np.linalg.norm(away, axis=1) + bias_m * rng.normal() + sigma_m * rng.normal(size=len(source))
    shared = SharedErrors(source, np.tile(spread, (anchors, 1, 1)), bias_m**2)
    moved_m = np.zeros((len(source), 3))
    return RangeSet(said, lead_s, moved_m, range_m, np.full(len(source), sigma_m**2)), shared, state


def test_what_ranges_share_is_told_apart_from_their_noise() -> None:
    rng = np.random.default_rng(4)
    ratios, sigmas_m, independent_m = [], [], []
    for _ in range(24):
        ranges, shared, truth = shared_ranges(rng)
        place = locate_jointly(ranges, shared, SPEED_SIGMA_MPS, EVERYWHERE)
        count, largest_m2 = len(shared.source) / len(shared.covariance), float(shared.covariance.max())
        widened = ranges.variance_m2 + count * (largest_m2 + shared.bias_variance_m2)
        alike = multilaterate(replace(ranges, variance_m2=widened), SPEED_SIGMA_MPS)
        assert place is not None
        assert alike is not None
        if not len(place.rivals):
            assert place.fits
            ratios.append(nees(place.mean - truth, place.covariance) / 6)
            sigmas_m.append(place.sigma_m)
            independent_m.append(alike.sigma_m)
    assert len(ratios) >= 18
    assert 0.7 < np.mean(ratios) < 1.5
    # what differs between ranges of one anchor is free of its error: a motion past it is seen far better
    assert np.median(sigmas_m) < 0.7 * np.median(independent_m)


def test_a_place_that_noise_puts_beyond_a_limit_is_at_the_limit() -> None:
    rng = np.random.default_rng(5)
    low = np.full(6, -np.inf)
    low[2] = -5.0
    limits = low, np.full(6, np.inf)
    held = 0
    for _ in range(20):
        ranges, shared, truth = shared_ranges(rng)
        truth[2] = -4.9
        away = truth[:3] + ranges.lead_s[:, None] * truth[3:] - ranges.anchor_m
        range_m = np.linalg.norm(away, axis=1) + 0.5 * rng.normal(size=len(away))
        place = locate_jointly(replace(ranges, range_m=range_m), shared, SPEED_SIGMA_MPS, limits)
        assert place is not None
        assert place.mean[2] >= -5.0
        held += place.mean[2] == -5.0
        assert (place.rivals[:, 2] >= -5.0).all()
        free = locate_jointly(replace(ranges, range_m=range_m), shared, SPEED_SIGMA_MPS, EVERYWHERE)
        assert free is not None
        # the directions that what ranges share is seen along are those of the search, which differs a little
        assert place.mean[2] == pytest.approx(max(free.mean[2], -5.0), abs=0.5 * free.sigma_m)
    assert 5 <= held <= 15
