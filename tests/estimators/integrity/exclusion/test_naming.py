"""Who is named when a receiver is off, when, and who never is.

``FLEETLOC_NAMING_SEEDS`` sets how many flights there are of each ramp.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.integrity.exclusion.baselines import Pair, SharedTick
from estimators.integrity.exclusion.naming import NamingMonitor
from estimators.integrity.finding import What, has
from estimators.model.measurements import Kind, RowTable
from tests.support.uncalibrated_fleet import PERIOD_S, Shift, jump, no_shift, ramp, rows_of_flight

BEGUN_S = 30.0
SEEDS = int(os.environ.get("FLEETLOC_NAMING_SEEDS", "2"))


def flown(
    drones: int, seed: int, duration_s: float, shift: Shift = no_shift, *, calibrated: bool = False
) -> tuple[NamingMonitor, list[tuple[float, set[int]]]]:
    """The monitor at the end, and each change of whom it names: instant and ids (slot + 1)."""
    monitor, changes = NamingMonitor(1, PERIOD_S), [(0.0, set[int]())]
    ids = tuple(range(1, drones + 1))
    for tick, rows in rows_of_flight(drones, seed, duration_s, shift, calibrated=calibrated):
        found = monitor.observe(SharedTick(tick, ids, rows))
        named = {each.about for each in found if each.what is What.RECEIVER_OFF and each.about is not None}
        assert named == set(monitor.named)
        if named != changes[-1][1]:
            changes.append((tick * PERIOD_S, named))
    return monitor, changes[1:]


@pytest.mark.parametrize("drones", [2, 3, 4, 5])
@pytest.mark.parametrize("calibrated", [True, False])
def test_nobody_is_named_where_nobody_is_off(drones: int, calibrated: bool) -> None:
    for seed in range(2):
        monitor, changes = flown(drones, seed, 45.0, calibrated=calibrated)
        assert changes == []
        assert monitor.unattributable_nats == 0.0
        assert monitor.receivers == drones


def test_a_drone_alone_and_two_of_which_one_is_off_do_no_harm() -> None:
    for drones in (1, 2):
        monitor, changes = flown(drones, 1, 12.0, jump(0, np.array([20.0, 0.0, 0.0]), 5.0, 99.0))
        assert changes == []
        assert monitor.named == {}
    assert monitor.unattributable_nats > 0.0


@pytest.mark.parametrize(("rate_mps", "within_s"), [(5.0, 3.0), (0.5, 12.0), (0.1, 65.0)])
@pytest.mark.parametrize("seed", range(SEEDS))
def test_a_receiver_that_is_dragged_away_is_named(rate_mps: float, within_s: float, seed: int) -> None:
    slot = seed % 5
    _, changes = flown(5, seed, BEGUN_S + within_s + 1.0, ramp(slot, rate_mps, BEGUN_S, seed))
    (named,) = changes
    assert named[1] == {slot + 1}
    assert 0.0 < named[0] - BEGUN_S <= within_s


def test_a_jump_is_named_within_a_second_or_so_and_taken_back_after_ten_that_agree() -> None:
    # long enough for the jump to have been thirty seconds ago: what was is not held against a receiver for ever
    monitor, (named, taken_back) = flown(5, 3, 60.0, jump(2, np.array([30.0, 20.0, 0.0]), 20.0, 25.0))
    assert not monitor.separation_m.any()
    assert named[1] == {3}
    assert named[0] <= 21.5
    assert taken_back[1] == set()
    assert 10.0 <= taken_back[0] - 25.0 <= 13.0


def test_how_far_it_is_off_is_told() -> None:
    monitor, _ = flown(5, 1, 26.0, jump(2, np.array([12.0, -9.0, 0.0]), 20.0, 99.0))
    # the height is poorly seen: all drones are within a few metres of one
    np.testing.assert_allclose(monitor.named[3].shift_m[:2], [12.0, -9.0], atol=4.0)


def test_of_three_it_is_seen_that_one_is_off_and_not_told_whose() -> None:
    monitor, changes = flown(3, 1, 26.0, jump(1, np.array([20.0, 0.0, 0.0]), 20.0, 99.0))
    assert changes == []
    assert monitor.unattributable_nats > 0.0
    found = monitor.observe(SharedTick(260, (1, 2, 3), next(rows_of_flight(3, 1, 0.1))[1][:0]))
    assert has(found, What.SOMEBODY_OFF)


@pytest.mark.parametrize(("drones", "seed"), [(3, 1), (3, 2), (2, 1)])
def test_that_somebody_of_few_is_off_stands_until_all_have_agreed_for_ten_seconds(drones: int, seed: int) -> None:
    monitor, said = NamingMonitor(1, PERIOD_S), list[float]()
    shift = jump(1, np.array([20.0, 5.0, 0.0]), 20.0, 25.0)
    ids = tuple(range(1, drones + 1))
    for tick, rows in rows_of_flight(drones, seed, 60.0, shift):
        found = monitor.observe(SharedTick(tick, ids, rows))
        assert has(found, What.SOMEBODY_OFF) == (monitor.unattributable_nats > 0.0)
        said += [tick * PERIOD_S - 20.0] if monitor.unattributable_nats else []
        assert monitor.named == {}
    assert 0.0 < said[0] <= 1.5
    assert len(said) == round((said[-1] - said[0]) / PERIOD_S) + 1  # without a gap
    assert 15.0 <= said[-1] <= 18.0
    assert not monitor.separation_m.any()


def test_all_that_are_off_alike_cannot_be_seen() -> None:
    monitor, changes = flown(5, 2, 40.0, lambda t_s, _: np.array([5.0, 0.0, 0.0]) * max(0.0, t_s - 20.0))
    assert changes == []
    assert monitor.unattributable_nats == 0.0


def test_two_are_named_one_after_the_other() -> None:
    first, second = jump(0, np.array([25.0, 0.0, 0.0]), 15.0, 99.0), jump(3, np.array([0.0, 25.0, 0.0]), 25.0, 99.0)
    _, changes = flown(6, 4, 32.0, lambda t_s, slot: first(t_s, slot) + second(t_s, slot))
    assert [named for _, named in changes] == [{1}, {1, 4}]


Spoiled = Callable[[RowTable, float], None]
"""(rows of a tick, seconds since the fault began): what becomes of them."""


def spoiled(
    seed: int, spoil: Spoiled, duration_s: float = 12.0
) -> tuple[NamingMonitor, list[tuple[float, set[Pair]]]]:
    """The monitor of a fleet of five, and each change of whose ranges are off, since the fault began."""
    monitor, changes = NamingMonitor(1, PERIOD_S), [(0.0, set[Pair]())]
    for tick, rows in rows_of_flight(5, seed, 20.0 + duration_s):
        if tick >= 200:
            spoil(rows, tick * PERIOD_S - 20.0)
        found = monitor.observe(SharedTick(tick, (1, 2, 3, 4, 5), rows))
        assert len([each for each in found if each.what is What.RANGES_OFF]) == len(monitor.ranges_off)
        if set(monitor.ranges_off) != changes[-1][1]:
            changes.append((tick * PERIOD_S - 20.0, set(monitor.ranges_off)))
    return monitor, changes[1:]


def between(rows: RowTable, one: int, other: int) -> NDArray[np.intp]:
    """The ranges between two slots."""
    ends = np.isin(rows["agent"], (one, other)) & np.isin(rows["other"], (one, other))
    return np.flatnonzero((rows["kind"] == Kind.RANGE) & ends)


def pair_of(one: int, other: int) -> Pair:
    """The ids of two slots."""
    return min(one, other) + 1, max(one, other) + 1


def test_a_pair_whose_ranges_are_off_is_named_and_no_receiver_and_taken_back() -> None:
    def off_for_five_seconds(rows: RowTable, t_s: float) -> None:
        rows["value"][between(rows, 1, 3)] += 8.0 * (t_s < 5.0)

    monitor, changes = spoiled(6, off_for_five_seconds, 20.0)
    assert monitor.named == {}
    (named, taken_back) = changes
    assert named[1] == {(2, 4)}
    assert named[0] <= 3.0
    assert taken_back[1] == set()
    assert 10.0 <= taken_back[0] - 5.0 <= 13.0


def seldom(
    seed: int, duration_s: float, shift: Shift = no_shift, off_m: float = 0.0
) -> list[tuple[float, set[int], set[Pair]]]:
    """Each change of whose fixes and ranges are off, where a pair has three ranges a second, few in a bin.

    One in twenty has no line of sight, one in a hundred is a spike; those between 2 and 4 are ``off_m`` from 20 s on.
    """
    monitor, rng = NamingMonitor(1, PERIOD_S), np.random.default_rng([seed, 5])
    changes = [(0.0, set[int](), set[Pair]())]
    for tick, rows in rows_of_flight(5, seed, duration_s, shift):
        ranges, chance = rows["kind"] == Kind.RANGE, rng.random(len(rows))
        rows["value"] += np.where(ranges & (chance < 0.05), rng.exponential(1.0, len(rows)), 0.0)
        rows["value"] += np.where(ranges & (chance > 0.99), rng.uniform(5.0, 19.0, len(rows)), 0.0)
        rows["value"][between(rows, 1, 3)] += off_m * (tick >= 200)
        monitor.observe(SharedTick(tick, (1, 2, 3, 4, 5), rows[~ranges | (tick % 3 == 0)]))
        now = set(monitor.named), set(monitor.ranges_off)
        if now != changes[-1][1:]:
            changes.append((tick * PERIOD_S, *now))
    return changes[1:]


def test_spikes_of_ranges_that_are_alone_in_their_bin_accuse_nobody() -> None:
    for seed in range(2):
        assert seldom(seed, 40.0) == []


def test_ranges_that_come_seldom_tell_a_jump_and_a_pair_that_is_off() -> None:
    for seed in range(2):
        ((when_s, named, ranges_off), *_) = seldom(seed, 24.0, jump(2, np.array([30.0, 0.0, 0.0]), 20.0, 99.0))
        assert (named, ranges_off) == ({3}, set())
        assert when_s <= 22.0
        ((when_s, named, ranges_off), *_) = seldom(seed, 24.0, off_m=8.0)
        assert (named, ranges_off) == (set(), {(2, 4)})
        assert when_s <= 23.0


def test_ranges_that_are_stuck_are_named() -> None:
    held: list[float] = []

    def stuck(rows: RowTable, t_s: float) -> None:
        held.extend(rows["value"][between(rows, 0, 2)][: not held])
        rows["value"][between(rows, 0, 2)] = held[0]

    monitor, changes = spoiled(1, stuck)
    assert monitor.named == {}
    assert changes[0][1] == {(1, 3)}
    assert changes[0][0] <= 3.0


@pytest.mark.parametrize(("seed", "slot"), [(2, 0), (2, 2), (11, 1), (15, 0)])
def test_two_ranges_that_are_swapped_are_named_and_not_the_receiver_that_they_look_like(seed: int, slot: int) -> None:
    one, other = (slot + 1) % 5, (slot + 2) % 5

    def swapped(rows: RowTable, t_s: float) -> None:
        mixed = np.concatenate((between(rows, slot, one), between(rows, slot, other)))
        rows["value"][mixed] = rows["value"][mixed[::-1]]

    monitor, changes = spoiled(seed, swapped)
    assert monitor.named == {}
    assert changes[-1][1] == {pair_of(slot, one), pair_of(slot, other)}


def from_both_ends(rows: RowTable) -> RowTable:
    """With the ranges that the other ends measure of the same pairs."""
    back = rows[rows["kind"] == Kind.RANGE]
    back["agent"], back["other"] = back["other"].copy(), back["agent"].copy()
    back["observer"], back["offset_s"] = back["agent"], back["offset_s"] + 0.02
    for axis in "xyz":
        back[axis] *= -1.0
    return np.concatenate((rows, back))


@pytest.mark.parametrize("drones", [3, 5])
@pytest.mark.parametrize("seed", range(2))
def test_what_one_end_of_a_pair_measures_otherwise_than_the_other_is_off_in_any_fleet(drones: int, seed: int) -> None:
    # no receiver makes two ends differ, so the ranges are named where nobody could tell whose receiver is off
    monitor, named_after_s = NamingMonitor(1, PERIOD_S), list[float]()
    for tick, rows in rows_of_flight(drones, seed, 40.0):
        rows = from_both_ends(rows)
        wrong = (rows["kind"] == Kind.RANGE) & (rows["agent"] == 1) & (rows["other"] == 0)
        rows["value"][wrong] += 3.0 * (200 <= tick < 250)
        monitor.observe(SharedTick(tick, tuple(range(1, drones + 1)), rows))
        assert monitor.named == {}
        assert monitor.unattributable_nats == 0.0
        assert set(monitor.ranges_off) <= {(1, 2)}
        named_after_s += [tick * PERIOD_S - 20.0] if monitor.ranges_off else []
    assert named_after_s[0] <= 1.5
    assert 15.0 <= named_after_s[-1] <= 19.0


def test_ranges_that_cannot_be_right_are_named_without_fixes_and_between_drones_side_by_side() -> None:
    monitor, named_after_s = NamingMonitor(1, PERIOD_S), list[float]()
    for tick, rows in rows_of_flight(5, 2, 24.0):
        blind = (rows["kind"] == Kind.POSITION) & (rows["agent"] == 4) & (tick > 50)
        rows["value"][between(rows, 0, 1)] = 2.0 + 0.01 * tick if tick < 200 else 3.0  # stuck, within 4 m
        rows["value"][between(rows, 3, 4)] = rows["value"][between(rows, 3, 4)] if tick < 200 else 9.0
        monitor.observe(SharedTick(tick, (1, 2, 3, 4, 5), rows[~blind]))
        assert set(monitor.ranges_off) <= {(1, 2), (4, 5)}
        named_after_s += [tick * PERIOD_S - 20.0] if len(monitor.ranges_off) == 2 else []
    assert monitor.named == {}
    assert 0.0 < named_after_s[0] <= 4.0


def test_ranges_to_a_drone_that_has_lost_its_fixes_count_again() -> None:
    # nothing can be held against them any more, and that drone has nothing else
    rng = np.random.default_rng(2)
    monitor, off = NamingMonitor(1, PERIOD_S), list[float]()
    for tick, rows in rows_of_flight(5, 4, 50.0):
        rows["value"][between(rows, 1, 3)] += rng.exponential(4.0, len(between(rows, 1, 3))) * (200 <= tick < 300)
        rows = rows[~((rows["kind"] == Kind.POSITION) & (rows["agent"] == 3) & (tick >= 230))]
        monitor.observe(SharedTick(tick, (1, 2, 3, 4, 5), rows))
        assert set(monitor.ranges_off) <= {(2, 4)}
        off += [tick * PERIOD_S] if monitor.ranges_off else []
    assert monitor.named == {}
    assert off[0] <= 23.0
    assert 39.0 <= off[-1] <= 46.0  # ten seconds after they no longer scatter


@pytest.mark.parametrize(("seed", "draws", "slot"), [(3, 1, 2), (10, 15, 0), (6, 11, 1)])
def test_a_drone_without_line_of_sight_is_named_by_its_ranges(seed: int, draws: int, slot: int) -> None:
    rng = np.random.default_rng(draws)

    def blocked(rows: RowTable, t_s: float) -> None:
        of = (rows["kind"] == Kind.RANGE) & ((rows["agent"] == slot) | (rows["other"] == slot))
        rows["value"][of] += rng.exponential(2.0, np.count_nonzero(of))

    monitor, changes = spoiled(seed, blocked)
    assert monitor.named == {}
    whole = {pair_of(slot, other) for other in range(5) if other != slot}
    (when,) = {t_s for t_s, pairs in changes if pairs == whole}
    assert when <= 3.0


@pytest.mark.parametrize("seed", range(2))
def test_ends_that_measure_the_same_pair_differently_are_no_scatter(seed: int) -> None:
    # antennas have lobes: what one end of a pair measures may be off by a constant against what its other end does
    monitor = NamingMonitor(1, PERIOD_S)
    for tick, rows in rows_of_flight(5, seed, 15.0):
        sensed = from_both_ends(rows)
        sensed["value"][len(rows) :][between(sensed[len(rows) :], 1, 3)] += 0.4
        monitor.observe(SharedTick(tick, (1, 2, 3, 4, 5), sensed))
        assert monitor.ranges_off == {}
    assert monitor.named == {}


def test_ranges_that_all_scatter_alike_are_used() -> None:
    # what they claim is wrong, not one of them
    rng = np.random.default_rng(1)

    def noisy(rows: RowTable, t_s: float) -> None:
        of = rows["kind"] == Kind.RANGE
        rows["value"][of] += rng.normal(0.0, 1.0, np.count_nonzero(of))

    monitor, changes = spoiled(3, noisy)
    assert changes == []
    assert monitor.named == {}


def test_a_receiver_that_repeats_one_fix_is_named() -> None:
    monitor, named_after_s = NamingMonitor(1, PERIOD_S), list[float]()
    for tick, rows in rows_of_flight(5, 1, 26.0):
        fix = np.flatnonzero((rows["kind"] == Kind.POSITION) & (rows["agent"] == 3))
        if tick == 200:
            held = rows["value"][fix]
        if tick >= 200 and len(fix):
            rows["value"][fix] = held
        monitor.observe(SharedTick(tick, (1, 2, 3, 4, 5), rows))
        named_after_s += [tick * PERIOD_S - 20.0] if monitor.named else []
    assert set(monitor.named) == {4}
    assert named_after_s[0] <= 4.0


def test_a_member_that_says_it_is_nowhere_harms_nobody_else() -> None:
    monitor = NamingMonitor(1, PERIOD_S)
    for tick, rows in rows_of_flight(5, 3, 25.0):
        said = (rows["kind"] == Kind.POSITION) & (rows["agent"] == 3) & (tick > 100)
        rows["value"][said] = 1e300
        with np.errstate(over="ignore", invalid="ignore"):
            found = monitor.observe(SharedTick(tick, (1, 2, 3, 4, 5), rows))
        assert {each.about for each in found} <= {4}
        assert np.isfinite(monitor.separation_m).all()


def test_late_rows_and_those_who_leave_do_no_harm() -> None:
    monitor = NamingMonitor(1, PERIOD_S)
    shift = jump(2, np.array([30.0, 0.0, 0.0]), 20.0, 99.0)
    for tick, rows in rows_of_flight(5, 3, 30.0, shift):
        monitor.observe(SharedTick(tick + 1, (1, 2, 3, 4, 5), rows))  # everything a tick late
    assert set(monitor.named) == {3}
    rest = rows[(rows["agent"] != 2) & (rows["other"] != 2)]
    rest["agent"] -= rest["agent"] > 2
    rest["other"] -= rest["other"] > 2
    monitor.observe(SharedTick(301, (1, 2, 4, 5), rest))
    assert monitor.named == {}
