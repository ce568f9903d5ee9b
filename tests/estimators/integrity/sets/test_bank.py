"""The bank of guaranteed sets: rows of a small fleet in, sets and broken bounds out."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.sets.bank import BoundedTick, SensorBounds, SetBank
from estimators.model.measurements import ROW, Kind, RowTable, Vector

PERIOD_S = 0.1
IDS = (4, 7, 9)
FIX_M, RANGE_M, VELOCITY_MPS, ACCELERATION_MPS2 = 2.0, 0.3, 0.2, 3.0


def place(drone: int, t_s: float) -> Vector:
    """Circles of 8 m at different heights; accelerations below `ACCELERATION_MPS2`."""
    angle = 0.4 * t_s + 2.0 * drone
    return np.array([8.0 * math.cos(angle), 8.0 * math.sin(angle), -10.0 - 3.0 * drone])


def velocity(drone: int, t_s: float) -> Vector:
    return (place(drone, t_s + 1e-4) - place(drone, t_s - 1e-4)) / 2e-4


def row(tick: int, offset_s: float, value: float, kind: Kind, agent: int, *, axis: int = -1, other: int = -1,
        half_width: float = math.inf) -> tuple[float, ...]:  # fmt: skip
    direction = [float(axis == each) for each in range(3)]
    return (tick, offset_s, value, 1.0, half_width, *direction, kind, agent, other, agent)


def rows_of(tick: int, rng: np.random.Generator, shift: Vector | None = None) -> RowTable:
    """What the fleet measured in a tick, errors at their bounds; ``shift`` goes to the fixes of the last drone."""
    rows = []
    for slot in range(3):
        offset_s = float(rng.uniform(-0.05, 0.05))
        t_s = tick * PERIOD_S + offset_s
        if (tick + slot) % 2 == 0:
            moved = shift if shift is not None and slot == 2 else np.zeros(3)
            fix = place(slot, t_s) + moved + FIX_M * rng.choice((-1.0, 1.0), 3)
            speed = velocity(slot, t_s) + VELOCITY_MPS * rng.choice((-1.0, 1.0), 3)
            rows += [row(tick, offset_s, float(fix[k]), Kind.POSITION, slot, axis=k) for k in range(3)]
            rows += [row(tick, offset_s, float(speed[k]), Kind.VELOCITY, slot, axis=k) for k in range(3)]
        for other in range(slot + 1, 3):
            late = tick - int(rng.integers(0, 3))
            t_s = late * PERIOD_S + offset_s
            ends = (slot, other) if rng.random() < 0.5 else (other, slot)
            arms = rng.uniform(-1.0, 1.0, 3)  # of the antennas
            true_m = float(np.linalg.norm(place(ends[0], t_s) - place(ends[1], t_s) + arms))
            range_m = true_m + RANGE_M * float(rng.choice((-1.0, 1.0)))
            ranged = row(late, offset_s, range_m, Kind.RANGE, ends[0], other=ends[1])
            rows.append((*ranged[:5], *arms.tolist(), *ranged[8:]))
    return np.array(rows, ROW)


BOUNDS = SensorBounds((FIX_M,) * 3, VELOCITY_MPS, RANGE_M, ACCELERATION_MPS2)


def run(
    bank: SetBank, ticks: range, rng: np.random.Generator, shift: Vector | None = None
) -> Iterator[tuple[int, tuple[Finding, ...]]]:
    for tick in ticks:
        relative = {IDS[k]: place(k, tick * PERIOD_S) - place(0, tick * PERIOD_S) for k in (1, 2)}
        yield tick, bank.observe(BoundedTick(tick, IDS, 0, rows_of(tick, rng, shift), relative))


@pytest.mark.parametrize("seed", range(3))
def test_the_truth_is_in_every_set_at_every_tick(seed: int) -> None:
    # GIVEN fixes of different instants, late ranges, and every error at its bound
    bank, half_axes = SetBank(PERIOD_S, BOUNDS), []
    for tick, found in run(bank, range(300), np.random.default_rng(seed)):
        # THEN nothing is found: no bound is broken, and the truth (here the estimate) is in its set
        assert found == ()
        if tick > 10:
            assert set(bank.sets) == {7, 9}
            half_axes += [each.half_axes()[0] for each in bank.sets.values()]
    # and the sets are of use: smaller than the box of two fixes alone would be
    assert np.median(half_axes) < 2.0 * FIX_M * math.sqrt(3.0)


def test_an_estimate_outside_its_set_is_an_alarm() -> None:
    bank = SetBank(PERIOD_S, BOUNDS)
    rng = np.random.default_rng(0)
    list(run(bank, range(50), rng))
    off = {7: place(1, 5.0) - place(0, 5.0) + np.array([0.0, 0.0, 12.0]), 9: place(2, 5.0) - place(0, 5.0)}
    (found,) = bank.observe(BoundedTick(50, IDS, 0, rows_of(50, rng), off))
    assert (found.what, found.gravity, found.about) == (What.DIVERGED, Gravity.ALARM, 7)
    assert found.value is not None
    assert found.value > 1.0


def test_fixes_beyond_their_bound_break_it_and_are_named() -> None:
    bank, rng = SetBank(PERIOD_S, BOUNDS), np.random.default_rng(0)
    list(run(bank, range(50), rng))
    named = {each.about for _, found in run(bank, range(50, 60), rng, np.array([30.0, 0.0, 0.0])) for each in found
             if each.what is What.BOUNDS_BROKEN}  # fmt: skip
    assert named == {9}
    assert bank.conflicts[9] > 0


def test_what_is_broken_again_stands_until_it_has_agreed_and_one_outlier_does_not() -> None:
    bank, rng = SetBank(PERIOD_S, BOUNDS), np.random.default_rng(0)
    list(run(bank, range(50), rng))
    told = {}
    for tick in range(50, 250):
        off = np.array([0.0, 0.0, 12.0]) * (tick in (60, 100, 130))  # each within ten seconds of the last
        relative = {IDS[k]: place(k, tick * PERIOD_S) - place(0, tick * PERIOD_S) + off * (k == 1) for k in (1, 2)}
        found = bank.observe(BoundedTick(tick, IDS, 0, rows_of(tick, rng), relative))
        told[tick] = {(each.what, each.gravity, each.about) for each in found}
    alarm = {(What.DIVERGED, Gravity.ALARM, 7)}
    assert [tick for tick, each in told.items() if each == alarm] == [60, *range(100, 231)]
    assert not any(told[tick] for tick in told if tick != 60 and not 100 <= tick <= 230)


def test_without_bounds_nothing_is_certain_and_nothing_is_found() -> None:
    bank = SetBank(PERIOD_S, SensorBounds())
    assert [found for _, found in run(bank, range(20), np.random.default_rng(0)) if found] == []
    assert bank.sets == {}


def test_bounds_that_rows_state_count_without_any_configured() -> None:
    bank, rng = SetBank(PERIOD_S, SensorBounds()), np.random.default_rng(0)
    for tick in range(10):
        rows = rows_of(tick, rng)
        rows["half_width"][rows["kind"] == Kind.POSITION] = 3.0
        assert bank.observe(BoundedTick(tick, IDS, 0, rows[np.abs(rows["offset_s"]) < 1.0], {})) == ()
    # nothing says how the drones move between fixes, so a box holds for the tick of a fix at its very instant alone
    assert bank.sets == {}


def test_a_speed_limit_alone_makes_sets() -> None:
    bank, rng = SetBank(PERIOD_S, SensorBounds((FIX_M,) * 3, speed_mps=5.0)), np.random.default_rng(0)
    assert all(found == () for _, found in run(bank, range(50), rng))
    assert set(bank.sets) == {7, 9}


def test_who_leaves_is_forgotten_and_comes_back_anew() -> None:
    bank, rng = SetBank(PERIOD_S, BOUNDS), np.random.default_rng(0)
    list(run(bank, range(20), rng))
    rows = rows_of(20, rng)
    two = rows[(rows["agent"] < 2) & (rows["other"] < 2)]
    assert bank.observe(BoundedTick(20, IDS[:2], 0, two, {})) == ()
    assert set(bank.sets) == {7}
    assert all(found == () for _, found in run(bank, range(21, 60), rng))
    assert set(bank.sets) == {7, 9}
