"""Taking from a neighbour what it knows better."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.consensus.inheritance import inherit, survey
from estimators.estimator import Payload
from estimators.model.layout import block

AGENTS = 3


def random_pair(rng: np.random.Generator, scales: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A correlated information pair whose blocks have standard deviations of about ``scales``."""
    n = 6 * len(scales)
    root = np.linalg.qr(rng.normal(size=(n, n)))[0] * rng.uniform(0.7, 1.4, n)
    spread = np.repeat(scales, 6)
    covariance = spread[:, None] * (root @ root.T) * spread
    information = np.linalg.inv(covariance)
    information = 0.5 * (information + information.T)
    return information, information @ rng.normal(size=n)


def moments(pair: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    covariance = np.linalg.inv(pair[0])
    return covariance @ pair[1], covariance


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_the_own_marginal_of_what_is_kept_never_changes(seed: int) -> None:
    # GIVEN a neighbour that knows the third agent better and the first two worse
    rng = np.random.default_rng(seed)
    own, other = random_pair(rng, (0.1, 0.2, 5.0)), random_pair(rng, (1.0, 1.0, 0.5))
    # WHEN its knowledge is inherited
    mixed = inherit(own, other, slot=0)
    # THEN the first two are as before, to rounding, and the pair is sound
    mean, covariance = moments(mixed)
    own_mean, own_covariance = moments(own)
    kept = slice(0, 12)
    assert mean[kept] == pytest.approx(own_mean[kept], rel=1e-6, abs=1e-8)
    assert covariance[kept, kept] == pytest.approx(own_covariance[kept, kept], rel=1e-6, abs=1e-9)
    assert np.linalg.eigvalsh(mixed[0]).min() > 0


def test_what_is_taken_is_the_neighbours_conditional() -> None:
    rng = np.random.default_rng(3)
    own, other = random_pair(rng, (0.1, 0.2, 5.0)), random_pair(rng, (1.0, 1.0, 0.5))
    mean, covariance = moments(inherit(own, other, slot=0))
    other_mean, other_covariance = moments(other)
    s, d = slice(0, 12), block(2)
    regression = covariance[d, s] @ np.linalg.inv(covariance[s, s])
    expected = other_covariance[d, s] @ np.linalg.inv(other_covariance[s, s])
    assert regression == pytest.approx(expected, rel=1e-8, abs=1e-10)
    assert mean[d] - regression @ mean[s] == pytest.approx(other_mean[d] - expected @ other_mean[s])
    left = covariance[d, d] - regression @ covariance[s, d]
    assert left == pytest.approx(other_covariance[d, d] - expected @ other_covariance[s, d], rel=1e-8, abs=1e-10)


def test_missing_rows_of_another_agent_are_recovered_exactly() -> None:
    # GIVEN a common prior; the neighbour has a position fix of agent 3 that was lost here
    rng = np.random.default_rng(5)
    prior = random_pair(rng, (1.0, 1.0, 3.0))
    rows = np.zeros((6, 18))
    rows[:, block(2)] = np.eye(6)
    fix = rng.normal(size=6)
    full = (prior[0] + 1e4 * rows.T @ rows, prior[1] + 1e4 * rows.T @ fix)
    # WHEN the neighbour's pair is inherited
    mean, covariance = moments(inherit(prior, full, slot=0))
    # THEN agent 3 is known as there, and what that fix says of the others is not claimed
    full_mean, full_covariance = moments(full)
    assert mean[block(2)] == pytest.approx(full_mean[block(2)], abs=1e-3)
    assert covariance[block(2), block(2)] == pytest.approx(full_covariance[block(2), block(2)], abs=1e-6)
    assert covariance[block(0), block(0)] == pytest.approx(moments(prior)[1][block(0), block(0)], rel=1e-6, abs=1e-9)


def test_nothing_is_taken_from_a_neighbour_that_knows_no_better() -> None:
    rng = np.random.default_rng(7)
    own = random_pair(rng, (0.1, 0.1, 0.1))
    worse = (0.5 * own[0], 0.5 * own[1])
    assert inherit(own, worse, slot=0) is own
    assert inherit(own, own, slot=0) is own


def test_the_own_block_is_never_taken() -> None:
    rng = np.random.default_rng(9)
    own, other = random_pair(rng, (5.0, 0.1, 0.1)), random_pair(rng, (0.1, 1.0, 1.0))
    assert inherit(own, other, slot=0) is own


def test_a_survey_tells_which_pairs_can_be_fused_and_whether_one_knows_better() -> None:
    # GIVEN neighbours of which one knows the third agent better, one the own place only, and two are unusable
    rng = np.random.default_rng(4)
    own = random_pair(rng, (0.5, 0.5, 5.0))
    third, mine = random_pair(rng, (1.0, 1.0, 0.5)), random_pair(rng, (0.01, 1.0, 6.0))
    pairs = {1: third, 2: mine, 3: (-third[0], third[1]), 4: (third[0], np.full(18, np.nan))}
    received = {slot: Payload(7, *pair, rank=0) for slot, pair in pairs.items()}
    # WHEN they are surveyed
    usable, better = survey(own[0], received, slot=0)
    # THEN the best informed of those that are sound comes first
    log_dets = {slot: np.linalg.slogdet(pairs[slot][0])[1] for slot in (1, 2)}
    assert list(usable) == sorted(log_dets, key=lambda slot: -log_dets[slot])
    assert better
    # and what is known of the own place does not count
    assert survey(own[0], {2: received[2]}, slot=0) == ({2: received[2]}, False)
    assert survey(own[0], {}, slot=0) == ({}, False)
