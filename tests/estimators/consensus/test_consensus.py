"""Consensus on information pairs: weights, fusion, rounds, and who is left out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.consensus.information import fuse, metropolis_weights, rank_weights, uniform_weights
from estimators.estimator import Payload
from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import empty_inputs, empty_rows
from estimators.settings import EstimatorSettings
from estimators.settings import Kind as EstimatorKind
from tests.support import builders

RANKS = st.lists(st.integers(0, 60), max_size=8)


def pair(seed: int, *, rank: int = 6, degree: int = 1, tick: int = 0, order: int = 12) -> Payload:
    rng = np.random.default_rng(seed)
    information = builders.random_covariance(rng, order)
    return Payload(tick, 0.5 * (information + information.T), rng.normal(size=order), rank, degree)


@given(own=st.integers(0, 60), others=RANKS)
@settings(max_examples=100)
def test_rank_weights(own: int, others: list[int]) -> None:
    weight, shares = rank_weights(own, others)
    assert weight + sum(shares) == pytest.approx(1.0, abs=1e-12)
    total = own + sum(others)
    for share, rank in zip([weight, *shares], [own, *others], strict=True):
        expected = rank / total if total else 1 / (len(others) + 1)
        assert share == pytest.approx(expected, abs=1e-12)


def test_rank_weights_of_the_line_of_three() -> None:
    # the figures of a line of three with GPS everywhere and N = 2: ranks 15, 18, 15
    assert rank_weights(15, [18]) == (pytest.approx(0.4545, abs=1e-4), [pytest.approx(0.5454, abs=1e-4)])
    assert rank_weights(18, [15, 15]) == (pytest.approx(0.375), [pytest.approx(0.3125)] * 2)


@given(st.lists(st.integers(1, 8), min_size=0, max_size=8))
@settings(max_examples=50)
def test_metropolis_weights_are_a_convex_combination(degrees: list[int]) -> None:
    weight, shares = metropolis_weights(len(degrees), degrees)
    assert weight + sum(shares) == pytest.approx(1.0, abs=1e-12)
    assert weight > 0
    assert all(share > 0 for share in shares)


def test_metropolis_weights_are_doubly_stochastic() -> None:
    # GIVEN a star of four: the sum over receivers is one too, which makes the average the limit
    star = {0: [1, 2, 3], 1: [0], 2: [0], 3: [0]}
    mixing = np.zeros((4, 4))
    for agent, others in star.items():
        weight, shares = metropolis_weights(len(others), [len(star[other]) for other in others])
        mixing[agent, agent] = weight
        mixing[agent, others] = shares
    np.testing.assert_allclose(mixing.sum(axis=0), 1.0)
    np.testing.assert_allclose(mixing.sum(axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.matrix_power(mixing, 200), 0.25)


@given(st.integers(0, 20))
@settings(max_examples=10)
def test_uniform_weights(neighbours: int) -> None:
    weight, shares = uniform_weights(neighbours)
    assert [weight, *shares] == [pytest.approx(1 / (neighbours + 1))] * (neighbours + 1)


@pytest.mark.parametrize(
    ("rule", "shares"),
    [
        ("observability_rank", {0: 6 / 18, 1: 3 / 18, 2: 9 / 18}),
        ("metropolis", {0: 1 - 1 / 3 - 1 / 4, 1: 1 / 3, 2: 1 / 4}),
        ("uniform", {0: 1 / 3, 1: 1 / 3, 2: 1 / 3}),
    ],
)
def test_fusion_is_the_convex_combination(rule: str, shares: dict[int, float]) -> None:
    # GIVEN an agent with two neighbours
    pairs = {0: pair(0, rank=6, degree=2), 1: pair(1, rank=3, degree=1), 2: pair(2, rank=9, degree=3)}
    ranks = {1: 3, 2: 9}
    before = pairs[0].information.copy()
    information, vector = fuse(pairs[0], {s: pairs[s] for s in (2, 1)}, rule, ranks)  # type: ignore[arg-type]
    # THEN its pair is (13)-(14), and nobody's own pair is touched
    np.testing.assert_allclose(information, sum(shares[s] * p.information for s, p in pairs.items()), atol=1e-14)
    np.testing.assert_allclose(vector, sum(shares[s] * p.vector for s, p in pairs.items()), atol=1e-14)
    np.testing.assert_array_equal(pairs[0].information, before)


@pytest.mark.parametrize("rule", ["observability_rank", "uniform"])
def test_missing_neighbour_is_renormalised_away(rule: str) -> None:
    own, other = pair(0, rank=6), pair(1, rank=2)
    information, _ = fuse(own, {1: other}, rule, {1: 2})  # type: ignore[arg-type]
    share = 0.25 if rule == "observability_rank" else 0.5
    np.testing.assert_allclose(information, (1 - share) * own.information + share * other.information, atol=1e-14)


def test_alone_nothing_changes() -> None:
    own = pair(0)
    for rule in ("observability_rank", "metropolis", "uniform"):
        information, vector = fuse(own, {}, rule, {})
        np.testing.assert_allclose(information, own.information, rtol=1e-15)
        np.testing.assert_allclose(vector, own.vector, rtol=1e-15)


@given(seeds=st.lists(st.integers(0, 10**6), min_size=1, max_size=4, unique=True))
@settings(max_examples=25)
def test_fusion_never_claims_more_than_the_best(seeds: list[int]) -> None:
    # covariance-intersection property: between the smallest and the largest in every direction
    pairs = [pair(seed) for seed in seeds]
    information, _ = fuse(pairs[0], dict(enumerate(pairs[1:])), "uniform", {})
    direction = np.random.default_rng(0).normal(size=12)
    values = [direction @ p.information @ direction for p in pairs]
    assert min(values) * (1 - 1e-12) <= direction @ information @ direction <= max(values) * (1 + 1e-12)


@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dekf_ci"])
@pytest.mark.parametrize("rounds", [0, 1, 2, 4])
def test_rounds_are_powers_of_the_mixing_matrix(kind: EstimatorKind, rounds: int) -> None:
    # GIVEN a line of three with uniform weights, without rows: only priors that differ are mixed
    layout, table = Layout((1, 2, 3)), EstimatorSettings(kind=kind, rounds=rounds, weights="uniform")
    rng = np.random.default_rng(8)
    means, covariances = rng.normal(size=(3, 18)), [builders.random_covariance(rng, 18) for _ in range(3)]
    fleet = [make_estimator(table, layout, s, means[s], covariances[s], 0.1) for s in range(3)]
    line = {0: [1], 1: [0, 2], 2: [1]}
    mixing = np.array([[1 / 2, 1 / 2, 0], [1 / 3, 1 / 3, 1 / 3], [0, 1 / 2, 1 / 2]])
    first = 1 if kind == "dmhe_pre_ekf" else 0  # a moving horizon estimator has nothing to fuse at its first tick
    for tick in range(first + 1):
        for estimator in fleet:
            estimator.begin(tick, empty_rows(), empty_inputs())
        before = [estimator.outgoing(0) for estimator in fleet]
        for round_ in range(rounds):
            sent = [estimator.outgoing(round_) for estimator in fleet]
            for slot, estimator in enumerate(fleet):
                estimator.mix(round_, {other: sent[other] for other in line[slot]})
        after = [estimator.outgoing(rounds) for estimator in fleet]
        if tick == first:
            # THEN L rounds are the L-th power of the weights
            power = np.linalg.matrix_power(mixing, rounds)
            for slot in range(3):
                expected = sum(power[slot, j] * before[j].information for j in range(3))
                np.testing.assert_allclose(after[slot].information, expected, rtol=0, atol=1e-12)
                expected = sum(power[slot, j] * before[j].vector for j in range(3))
                np.testing.assert_allclose(after[slot].vector, expected, rtol=0, atol=1e-12)
        for estimator in fleet:
            estimator.solve()


@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dmhe", "dekf_ci"])
def test_pair_of_another_tick_is_not_used(kind: EstimatorKind) -> None:
    # GIVEN a neighbour whose pair speaks of another tick
    table, layout = EstimatorSettings(kind=kind, weights="uniform"), Layout((1, 2))
    late, alone = (make_estimator(table, layout, 0, np.zeros(12), np.eye(12), 0.1) for _ in range(2))
    for tick in range(4):
        for estimator in (late, alone):
            estimator.begin(tick, empty_rows(), empty_inputs())
        late.mix(0, {1: pair(tick, tick=late.outgoing(0).tick - 1)})
        alone.mix(0, {})
        # THEN it changes nothing
        np.testing.assert_array_equal(late.solve().mean, alone.solve().mean)


def test_weights_of_later_rounds_are_those_of_the_first() -> None:
    # GIVEN ranks that a neighbour reports differently in the second round: (26) is computed once a tick
    own, other = pair(0, rank=6), pair(1, rank=2)
    information, _ = fuse(own, {1: other}, "observability_rank", {1: 18})
    np.testing.assert_allclose(information, 0.25 * own.information + 0.75 * other.information, atol=1e-14)
