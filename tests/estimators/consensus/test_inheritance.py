"""Taking from a neighbour what it knows better."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.consensus.inheritance import Inheritance, inherit, survey
from estimators.estimator import Payload
from estimators.model.layout import BodyKind, Layout, block

NOBODY_STANDS = np.zeros(3, np.bool_)
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


def tell(pair: tuple[np.ndarray, np.ndarray], mean: np.ndarray, scale: float = 1.0) -> Payload:
    """A neighbour's pair with the covariance of ``pair`` by ``scale`` and another mean."""
    return Payload(7, pair[0] / scale, pair[0] / scale @ mean, rank=0)


def test_a_survey_tells_which_pairs_can_be_fused_and_whether_one_knows_better() -> None:
    # GIVEN neighbours of which one knows the third agent better, one the own place only, and two are unusable
    rng = np.random.default_rng(4)
    own = random_pair(rng, (0.5, 0.5, 5.0))
    mean = moments(own)[0]
    third, mine = random_pair(rng, (1.0, 1.0, 0.5)), random_pair(rng, (0.4, 1.0, 6.0))
    received = {1: tell(third, mean), 2: tell(mine, mean)}
    received |= {3: Payload(7, -third[0], third[1], rank=0), 4: Payload(7, third[0], np.full(18, np.nan), rank=0)}
    # WHEN they are surveyed
    usable, better, wrong = survey(own, received, 0, NOBODY_STANDS)
    # THEN the best informed of those that are sound comes first
    log_dets = {slot: np.linalg.slogdet(received[slot].information)[1] for slot in (1, 2)}
    assert list(usable) == sorted(log_dets, key=lambda slot: -log_dets[slot])
    assert better
    assert wrong == ()
    # and what is known of the own place does not count
    assert survey(own, {2: received[2]}, 0, NOBODY_STANDS) == ({2: received[2]}, False, ())
    assert survey(own, {}, 0, NOBODY_STANDS) == ({}, False, ())


@pytest.mark.parametrize("agent", range(AGENTS))
@pytest.mark.parametrize(("away_sigmas", "believed"), [(4.0, True), (10.0, False)])
def test_a_pair_that_has_an_agent_elsewhere_is_not_inherited(agent: int, away_sigmas: float, believed: bool) -> None:
    # GIVEN a neighbour that knows the third agent better, and has one agent's north so many sigmas off
    own = np.diag(np.repeat([0.2, 0.2, 3.0], 6) ** -2.0), np.zeros(18)
    other = np.diag(np.repeat([0.2, 0.2, 0.5], 6) ** -2.0), np.zeros(18)
    mean = np.zeros(18)
    mean[6 * agent] = away_sigmas * np.sqrt(1.0 / own[0][6 * agent, 6 * agent] + 1.0 / other[0][6 * agent, 6 * agent])
    # WHEN it is looked at THEN it is believed within what both admit, whoever it is about
    usable, better, wrong = survey(own, {2: tell(other, mean)}, 0, NOBODY_STANDS)
    assert bool(usable) == better == believed
    assert wrong == (() if believed else (2,))


@pytest.mark.parametrize(
    ("sigmas", "believed"),
    [
        ((0.2, 0.2, 0.2), True),
        ((0.2, 0.2, 0.012), True),  # sure of the third agent, but not more than can be
        ((0.2, 0.2, 0.008), False),  # less than the floor
        ((0.06, 0.2, 0.2), True),  # knows the own place three times as well
        ((0.04, 0.2, 0.2), False),  # five times
    ],
)
def test_a_pair_that_claims_what_nobody_can_know_is_not_inherited(
    sigmas: tuple[float, ...], believed: bool
) -> None:
    own = np.diag(np.repeat([0.2, 0.2, 3.0], 6) ** -2.0), np.zeros(18)
    other = np.diag(np.repeat(sigmas, 6) ** -2.0), np.zeros(18)
    assert survey(own, {1: Payload(7, *other, rank=0)}, 0, NOBODY_STANDS)[2] == (() if believed else (1,))


@pytest.mark.parametrize(
    ("position_m", "velocity_mps", "kind", "believed"),
    [
        (0.1, 1e-4, BodyKind.ANCHOR, True),  # that it stands still everybody knows
        (0.1, 1e-4, BodyKind.TARGET, False),
        (0.1, 1e-4, BodyKind.VEHICLE, False),
        (0.008, 1e-4, BodyKind.ANCHOR, False),
    ],
)
def test_of_a_body_that_stands_still_the_velocity_may_be_known_to_any_degree(
    position_m: float, velocity_mps: float, kind: BodyKind, believed: bool
) -> None:
    # GIVEN a neighbour that knows the second drone better, and a third body so well
    layout = Layout((1, 2, 9), (BodyKind.VEHICLE, BodyKind.VEHICLE, kind))
    both = np.repeat([position_m, velocity_mps], 3)
    own = np.diag(np.concatenate([np.full(6, 0.2), np.full(6, 3.0), both]) ** -2.0), np.zeros(18)
    other = np.diag(np.concatenate([np.full(6, 0.2), np.full(6, 0.2), both]) ** -2.0), np.zeros(18)
    consensus = Inheritance(layout, 0)
    consensus.begin(7, own)
    # WHEN its pair comes THEN it is inherited from, unless it claims what nobody can know
    assert list(consensus.mix({1: Payload(7, *other, rank=0)})) == ([1] if believed else [])
    assert consensus.disbelieved == (() if believed else (1,))


def test_who_does_not_know_its_own_place_may_learn_it() -> None:
    # GIVEN an own place known to a metre, as after a minute without radio and GPS
    own = np.diag(np.repeat([1.0, 3.0, 3.0], 6) ** -2.0), np.zeros(18)
    other = np.diag(np.repeat([0.1, 0.2, 0.2], 6) ** -2.0), np.zeros(18)
    # THEN a neighbour that knows it ten times as well is believed
    assert survey(own, {1: Payload(7, *other, rank=0)}, 0, NOBODY_STANDS)[2] == ()
