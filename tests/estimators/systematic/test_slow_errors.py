"""Where slow errors stand, and in which rows they are: nothing depends on how the agents are numbered."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.model.measurements import Kind, RowTable, height_row, position_rows
from estimators.systematic import slow_errors
from tests.support import builders
from tests.support.joint_reference import coupling_matrix

AGENTS = st.integers(1, 7)


def drawn_rows(seed: int, agents: int) -> RowTable:
    """Some rows of all kinds, fixes along the axes and along others, two of them with a hard bound."""
    rng = np.random.default_rng(seed)
    kinds = [kind for kind in Kind if agents > 1 or kind not in (Kind.RANGE, Kind.RELATIVE)]
    tables = [
        builders.row_of(kind, rng, 0, agent, agents) for agent in range(agents) for kind in kinds
    ]
    bounded = position_rows(0, 0, np.zeros(3), np.ones(3), half_width_m=2.0)
    return builders.joined([*tables, position_rows(0, agents - 1, np.zeros(3), np.ones(3)), bounded])


def dense_couplings(rows: RowTable, agents: int, targets: tuple[int, ...] = ()) -> np.ndarray:
    at, by = slow_errors.couplings(rows, ~np.isin(np.arange(agents), targets))
    out = np.zeros((len(rows), slow_errors.count(agents)))
    for r in range(len(rows)):
        held = at[r] >= 0
        assert not held[int(held.sum()) :].any()  # the list ends at the first -1
        out[r, at[r][held]] += by[r][held]
    return out


@given(agents=AGENTS)
def test_every_error_has_one_place(agents: int) -> None:
    places = np.zeros(slow_errors.count(agents), int)
    for slot in range(agents):
        places[slow_errors.wander_of(slot)] += 1
        places[slow_errors.acceleration_of(slot, agents)] += 1
    places[slow_errors.common(agents)] += 1
    for one, other in combinations(range(agents), 2):
        places[slow_errors.pair_of(one, other, agents)] += 1
        assert slow_errors.pair_of(one, other, agents) == slow_errors.pair_of(other, one, agents)
    places[slow_errors.drifts(agents)] += 1
    places[slow_errors.scales(agents)] += 1
    assert (places == 1).all()
    pairs = np.zeros(len(places), int)
    pairs[slow_errors.pairs(agents)] += 1
    assert pairs.sum() == agents * (agents - 1) // 2


@given(seed=st.integers(0, 999), agents=AGENTS)
def test_rows_hold_what_their_sensor_has(seed: int, agents: int) -> None:
    rows = drawn_rows(seed, agents)
    np.testing.assert_array_equal(dense_couplings(rows, agents), coupling_matrix(rows, agents))


@given(seed=st.integers(0, 999), agents=st.integers(2, 5), data=st.data())
def test_ranges_to_a_target_hold_what_its_sensor_has(seed: int, agents: int, data: st.DataObject) -> None:
    target = data.draw(st.integers(0, agents - 1))
    rows = drawn_rows(seed, agents)
    rows = rows[(rows["kind"] != Kind.HEIGHT) | (rows["agent"] != target)]  # it has no barometer
    held = dense_couplings(rows, agents, (target,))
    np.testing.assert_array_equal(held, coupling_matrix(rows, agents, (target,)))
    to_it = (rows["kind"] == Kind.RANGE) & ((rows["agent"] == target) | (rows["other"] == target))
    free = to_it & ~np.isfinite(rows["half_width"])
    np.testing.assert_array_equal(held[:, slow_errors.drifts(agents)][:, target], free.astype(float))


@given(seed=st.integers(0, 999), order=AGENTS.flatmap(lambda agents: st.permutations(range(agents))))
def test_renamed_agents_have_the_same_errors_at_other_places(seed: int, order: list[int]) -> None:
    # GIVEN a fleet in another order: slot k of the new one was order[k]
    agents = len(order)
    place = np.argsort(order)
    rows = drawn_rows(seed, agents)
    renamed = rows.copy()
    renamed["agent"] = place[rows["agent"]]
    between = rows["other"] >= 0
    renamed["other"][between] = place[rows["other"][between]]
    was = slow_errors.places_before(agents, dict(enumerate(order)), agents)
    # THEN each error has moved to one place, and rows hold it there
    assert sorted(was) == list(range(slow_errors.count(agents)))
    np.testing.assert_array_equal(dense_couplings(renamed, agents), dense_couplings(rows, agents)[:, was])
    kept = slow_errors.kept_per_tick(agents, 0.1)
    np.testing.assert_array_equal(kept, kept[was])


@given(data=st.data(), before=AGENTS, after=AGENTS)
def test_who_stayed_keeps_his_errors_and_others_begin_anew(data: st.DataObject, before: int, after: int) -> None:
    known = data.draw(st.integers(0, min(before, after)))
    slots = data.draw(st.permutations(range(after)))[:known]
    olds = data.draw(st.permutations(range(before)))[:known]
    stayed = dict(zip(slots, olds, strict=True))
    was = slow_errors.places_before(before, stayed, after)
    np.testing.assert_array_equal(
        was[slow_errors.common(after)], np.arange(slow_errors.count(before))[slow_errors.common(before)]
    )
    for slot in range(after):
        drift, scale = slow_errors.drifts(after).start + slot, slow_errors.scales(after).start + slot
        barometer = was[[drift, scale]]
        here = was[slow_errors.wander_of(slot)], was[slow_errors.acceleration_of(slot, after)], barometer
        if slot not in stayed:
            assert (np.concatenate(here) == -1).all()
            continue
        places = np.arange(slow_errors.count(before))
        np.testing.assert_array_equal(here[0], places[slow_errors.wander_of(stayed[slot])])
        np.testing.assert_array_equal(here[1], places[slow_errors.acceleration_of(stayed[slot], before)])
        assert barometer[0] == slow_errors.drifts(before).start + stayed[slot]
        assert barometer[1] == slow_errors.scales(before).start + stayed[slot]
    for one, other in combinations(range(after), 2):
        both = one in stayed and other in stayed
        expected = slow_errors.pair_of(stayed[one], stayed[other], before) if both else -1
        assert was[slow_errors.pair_of(one, other, after)] == expected


def test_two_steps_of_change_are_one() -> None:
    # GIVEN agent 1 of three leaves, a new one comes, and then the order is turned
    first, second = {0: 0, 1: 2}, {0: 1, 2: 0}
    one = slow_errors.places_before(3, first, 2)
    two = slow_errors.places_before(2, second, 3)
    both = slow_errors.places_before(3, {new: first[old] for new, old in second.items()}, 3)
    np.testing.assert_array_equal(both, np.where(two >= 0, one[two], -1))


def test_corrected_rows_are_less_their_errors_and_less_sure() -> None:
    rng = np.random.default_rng(3)
    rows = drawn_rows(5, 3)
    errors, variance = rng.normal(size=slow_errors.count(3)), rng.uniform(0.1, 1.0, slow_errors.count(3))
    at, by = slow_errors.couplings(rows, np.ones(3, np.bool_))
    corrected = slow_errors.corrected_rows(rows, at, by, errors, variance)
    held = coupling_matrix(rows, 3)
    np.testing.assert_allclose(corrected["value"], rows["value"] - held @ errors, rtol=0, atol=1e-12)
    np.testing.assert_allclose(corrected["variance"], rows["variance"] + held**2 @ variance, rtol=1e-12)
    # and where there are none, the rows are what they were
    same = slow_errors.corrected_rows(rows, at[:, :1], by[:, :1], np.zeros(0), np.zeros(0))
    np.testing.assert_array_equal(same, rows)
    assert same is not rows


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.5])
def test_errors_decay_by_their_time_constants(period_s: float) -> None:
    kept = slow_errors.kept_per_tick(2, period_s)
    assert kept[slow_errors.wander_of(1)] == pytest.approx(np.exp(-period_s / slow_errors.WANDER_S))
    assert kept[slow_errors.acceleration_of(1, 2)] == pytest.approx(np.exp(-period_s / slow_errors.ACCELERATION_S))
    assert kept[slow_errors.common(2)] == pytest.approx(np.exp(-period_s / slow_errors.WANDER_S))
    assert kept[slow_errors.pairs(2)] == pytest.approx(np.exp(-period_s / slow_errors.PAIR_S))
    assert kept[slow_errors.drifts(2)] == pytest.approx(np.exp(-period_s / slow_errors.HEIGHT_S))
    assert kept[slow_errors.scales(2)] == pytest.approx(np.exp(-period_s / slow_errors.HEIGHT_S))


def test_a_barometer_holds_its_drift_and_its_scale_by_the_height_and_a_range_finder_neither() -> None:
    rows = builders.joined([height_row(0, 1, -40.0, 0.1, drifts=True), height_row(0, 1, -40.0, 0.1, drifts=False)])
    held = dense_couplings(rows, 3)
    assert held[0, slow_errors.drifts(3)].tolist() == [0.0, 1.0, 0.0]
    assert held[0, slow_errors.scales(3)].tolist() == [0.0, -40.0, 0.0]
    assert np.count_nonzero(held[0]) == 2
    assert not held[1].any()
