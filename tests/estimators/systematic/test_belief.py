"""The arrival cost with slow errors: what its operations keep, and what they change."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimators.model.layout import Layout, states_of
from estimators.model.members import InformationState, MemberChange
from estimators.systematic import slow_errors
from estimators.systematic.belief import SlowBelief
from tests.support import builders

Array = NDArray[np.float64]
SEEDS = st.integers(0, 9999)


def drawn_belief(rng: np.random.Generator, agents: int) -> SlowBelief:
    """Correlated between everything."""
    total = 6 * agents + slow_errors.count(agents)
    return SlowBelief(
        rng.normal(size=total), builders.random_covariance(rng, total), rng.uniform(0.3, 2.0, total - 6 * agents)
    )


def conditional(belief: SlowBelief) -> tuple[Array, Array, Array]:
    """Slow errors given the states: slope ``(q, d)``, mean at state zero, covariance."""
    d = belief.states
    slope = np.linalg.solve(belief.covariance[:d, :d], belief.covariance[:d, d:]).T
    mean = belief.mean[d:] - slope @ belief.mean[:d]
    return slope, mean, belief.covariance[d:, d:] - slope @ belief.covariance[:d, d:]


@given(seed=SEEDS, agents=st.integers(1, 4))
@settings(max_examples=30)
def test_another_pair_changes_the_states_and_not_what_they_say_of_the_errors(seed: int, agents: int) -> None:
    rng = np.random.default_rng(seed)
    belief = drawn_belief(rng, agents)
    d = belief.states
    mean, covariance = rng.normal(size=d), builders.random_covariance(rng, d)
    changed = belief.with_pair(belief.kinematic().pair(), InformationState.from_moments(mean, covariance).pair())
    # THEN the states are those of the pair, p(s | x) is what it was, and so are the sizes
    np.testing.assert_allclose(changed.mean[:d], mean, rtol=0, atol=1e-8)
    np.testing.assert_allclose(changed.covariance[:d, :d], covariance, rtol=0, atol=1e-8)
    for after, before in zip(conditional(changed), conditional(belief), strict=True):
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(changed.sizes, belief.sizes)


@given(seed=SEEDS)
@settings(max_examples=20)
def test_the_own_pair_changes_nothing(seed: int) -> None:
    belief = drawn_belief(np.random.default_rng(seed), 2)
    own = belief.kinematic().pair()
    same = belief.with_pair(own, own)
    np.testing.assert_allclose(same.mean, belief.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(same.covariance, belief.covariance, rtol=0, atol=1e-9)


@given(seed=SEEDS)
@settings(max_examples=20)
def test_other_states_say_nothing_of_the_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    belief = drawn_belief(rng, 2)
    mean, covariance = rng.normal(size=12), builders.random_covariance(rng, 12)
    changed = belief.with_states(mean, covariance)
    np.testing.assert_array_equal(changed.mean, np.concatenate([mean, belief.mean[12:]]))
    np.testing.assert_array_equal(changed.covariance[:12, :12], covariance)
    np.testing.assert_array_equal(changed.covariance[12:, 12:], belief.covariance[12:, 12:])
    assert not changed.covariance[:12, 12:].any()
    assert not changed.covariance[12:, :12].any()


def test_a_first_belief_has_its_sizes_as_prior() -> None:
    sizes = np.linspace(0.1, 1.0, slow_errors.count(1))
    belief = SlowBelief.first(np.arange(6.0), np.diag(np.arange(1.0, 7.0)), sizes)
    np.testing.assert_array_equal(belief.mean, np.concatenate([np.arange(6.0), np.zeros(len(sizes))]))
    np.testing.assert_allclose(belief.covariance, np.diag([*np.arange(1.0, 7.0), *sizes**2]), rtol=1e-15)
    assert belief.states == 6


@given(seed=SEEDS, factor=st.floats(0.2, 5.0))
@settings(max_examples=40)
def test_an_unmeasured_error_gets_the_new_prior(seed: int, factor: float) -> None:
    # GIVEN errors of which nothing is known but their priors
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.1, 2.0, slow_errors.count(2))
    belief = SlowBelief.first(rng.normal(size=12), builders.random_covariance(rng, 12), sizes)
    # WHEN one of them gets another size
    wanted = sizes.copy()
    wanted[3] *= factor
    changed = belief.resized(wanted)
    # THEN it has that prior (a change by less than 2 % is none), and nothing else has changed
    expected = belief.covariance.copy()
    if not 1 / 1.02 <= factor <= 1.02:
        expected[15, 15] = wanted[3] ** 2
    np.testing.assert_allclose(changed.covariance, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(changed.mean, belief.mean, rtol=0, atol=1e-12)


def measured_belief(rng: np.random.Generator, sizes: Array) -> SlowBelief:
    """Priors, and then some measurements of states and errors together."""
    fresh = SlowBelief.first(rng.normal(size=12), builders.random_covariance(rng, 12), sizes)
    rows = rng.normal(size=(20, len(fresh.mean)))
    information = np.linalg.inv(fresh.covariance) + rows.T @ rows
    vector = np.linalg.solve(fresh.covariance, fresh.mean) + rows.T @ rng.normal(size=20)
    covariance = np.linalg.inv(information)
    return SlowBelief(covariance @ vector, 0.5 * (covariance + covariance.T), sizes)


@given(seed=SEEDS, factor=st.floats(1.05, 5.0), grows=st.booleans())
@settings(max_examples=40)
def test_another_prior_is_as_if_it_had_been_from_the_start(seed: int, factor: float, grows: bool) -> None:
    # GIVEN the same measurements, after priors of two sizes
    sizes = np.random.default_rng(seed).uniform(0.2, 2.0, slow_errors.count(2))
    others = sizes.copy()
    others[[1, 5, 13]] *= factor if grows else 1.0 / factor
    one, other = (measured_belief(np.random.default_rng(seed), each) for each in (sizes, others))
    # THEN what was learned with the one prior is turned into what the other would have taught, and back
    changed = one.resized(others)
    np.testing.assert_allclose(changed.covariance, other.covariance, rtol=0, atol=1e-8)
    np.testing.assert_allclose(changed.mean, other.mean, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(changed.sizes, others)
    again = changed.resized(sizes)
    np.testing.assert_allclose(again.covariance, one.covariance, rtol=0, atol=1e-8)
    np.testing.assert_allclose(again.mean, one.mean, rtol=0, atol=1e-8)


@given(seed=SEEDS, factor=st.floats(0.1, 10.0))
@settings(max_examples=30)
def test_any_belief_stays_one(seed: int, factor: float) -> None:
    # GIVEN a belief whose errors are less certain than their priors, as a neighbour's pair may leave them
    belief = drawn_belief(np.random.default_rng(seed), 2)
    changed = belief.resized(factor * belief.sizes)
    assert np.linalg.eigvalsh(changed.covariance).min() > 0.0
    assert np.isfinite(changed.mean).all()


def test_a_place_that_hung_on_a_small_wander_is_given_back() -> None:
    # GIVEN one drone whose fixes were believed to a centimetre, since its receiver was taken not to wander
    sizes = np.full(slow_errors.count(1), 0.01)
    fresh = SlowBelief.first(np.zeros(6), 100.0 * np.eye(6), sizes)
    information = np.linalg.inv(fresh.covariance)
    row = np.zeros(len(fresh.mean))
    row[0], row[6 + slow_errors.wander_of(0).start] = 1.0, 1.0
    covariance = np.linalg.inv(information + np.outer(row, row) / 1e-4)
    belief = SlowBelief(np.zeros(len(row)), covariance, sizes)
    assert np.sqrt(belief.covariance[0, 0]) < 0.02
    # WHEN it turns out to wander by a metre
    wanted = sizes.copy()
    wanted[slow_errors.wander_of(0)] = 1.0
    # THEN its place is uncertain by a metre, and the sum of both is what the fixes have told
    changed = belief.resized(wanted).covariance
    assert np.sqrt(changed[0, 0]) == pytest.approx(1.0, rel=0.01)
    assert np.sqrt(row @ changed @ row) == pytest.approx(0.01, rel=0.01)
    assert changed[1, 1] > 0.99**2


@given(seed=SEEDS, order=st.permutations([0, 1, 2]))
@settings(max_examples=20)
def test_a_renamed_fleet_believes_the_same(seed: int, order: list[int]) -> None:
    belief = drawn_belief(np.random.default_rng(seed), 3)
    layout = Layout((1, 2, 3))
    change = MemberChange.between(layout, tuple(layout.agents[old] for old in order), layout.agents[order[0]], {})
    there = belief.reindexed(change, np.ones(slow_errors.count(3)))
    slots = [change.after.agents.index(layout.agents[old]) for old in range(3)]
    back = MemberChange.between(change.after, layout.agents, 1, {})
    again = there.reindexed(back, np.ones(slow_errors.count(3)))
    # THEN every state is at its agent's new place, and there and back is nowhere
    for old, slot in enumerate(slots):
        np.testing.assert_array_equal(there.mean[states_of([slot])], belief.mean[states_of([old])])
    np.testing.assert_array_equal(again.mean, belief.mean)
    np.testing.assert_array_equal(again.covariance, belief.covariance)
    np.testing.assert_array_equal(again.sizes, belief.sizes)


def test_who_leaves_is_marginalised_and_who_comes_has_his_prior() -> None:
    rng = np.random.default_rng(8)
    belief = drawn_belief(rng, 3)
    prior = np.arange(6.0), builders.random_covariance(rng, 6)
    # WHEN agent 2 leaves and agent 9 comes
    change = MemberChange.between(Layout((1, 2, 3)), (1, 3, 9), 1, {9: prior})
    sizes = rng.uniform(0.1, 1.0, slow_errors.count(3))
    after = belief.reindexed(change, sizes)
    stayed, was = states_of([0, 1]), states_of([0, 2])
    np.testing.assert_array_equal(after.mean[stayed], belief.mean[was])
    np.testing.assert_array_equal(after.covariance[np.ix_(stayed, stayed)], belief.covariance[np.ix_(was, was)])
    np.testing.assert_array_equal(after.mean[12:18], prior[0])
    np.testing.assert_array_equal(after.covariance[12:18, 12:18], prior[1])
    assert not after.covariance[12:18, :12].any()
    # and the errors of who stayed with their correlations, of the new one their priors
    pair, pair_before = 18 + slow_errors.pair_of(0, 1, 3), 18 + slow_errors.pair_of(0, 2, 3)
    np.testing.assert_array_equal(after.covariance[pair, stayed], belief.covariance[pair_before, was])
    fresh = slow_errors.pair_of(0, 2, 3)
    assert after.covariance[18 + fresh, 18 + fresh] == pytest.approx(sizes[fresh] ** 2)
    assert after.sizes[fresh] == sizes[fresh]
    assert after.sizes[slow_errors.pair_of(0, 1, 3)] == belief.sizes[slow_errors.pair_of(0, 2, 3)]
    assert np.linalg.eigvalsh(after.covariance).min() > 0.0


def test_without_slow_errors_it_is_the_states_alone() -> None:
    rng = np.random.default_rng(1)
    covariance = builders.random_covariance(rng, 12)
    belief = SlowBelief.first(rng.normal(size=12), covariance, np.zeros(0))
    np.testing.assert_array_equal(belief.resized(np.zeros(0)).covariance, covariance)
    change = MemberChange.between(Layout((1, 2)), (2,), 2, {})
    np.testing.assert_array_equal(belief.reindexed(change, np.zeros(0)).covariance, covariance[6:, 6:])
