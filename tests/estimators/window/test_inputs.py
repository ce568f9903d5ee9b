"""Known accelerations, and what stands for the unknown ones."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.model.layout import Layout
from estimators.model.measurements import input_rows
from estimators.model.members import MemberChange
from estimators.settings import EstimatorSettings, fade_per_tick
from estimators.window.inputs import HISTORY_TICKS, InputHistory

OTHER = 4.0 / 3.0
NOISE = np.full(3, 0.01)


def history(hold: bool, accels: dict[int, float], slot: int = 1) -> InputHistory:
    """A history of two agents; ``accels`` by tick, the same on all axes, of one of them."""
    made = InputHistory(np.full(2, OTHER), hold=hold)
    for tick, value in accels.items():
        made.insert(input_rows(tick, slot, np.full(3, value), NOISE), 0)
    return made


def test_known_inputs_stand_at_their_ticks_and_unknown_ones_are_zero_and_wide() -> None:
    accel, variance = history(False, {4: 0.5, 6: 0.7}).table(4, 7)
    assert accel[:, 3:].tolist() == [[0.5] * 3, [0.0] * 3, [0.7] * 3]
    assert variance[:, 3:].tolist() == [[0.01] * 3, [OTHER] * 3, [0.01] * 3]
    assert (accel[:, :3] == 0).all()
    assert (variance[:, :3] == OTHER).all()


def test_an_unknown_input_is_held_with_a_variance_that_grows_with_its_age() -> None:
    # GIVEN an agent whose acceleration changed by 0.1 per tick
    held = history(True, {0: 0.0, 1: 0.1, 2: 0.2, 3: 0.3})
    # WHEN nothing is known from tick 4 on
    accel, variance = held.table(3, 7)
    # THEN the last one is held, and its variance grows by the square of the ticks
    assert accel[:, 3] == pytest.approx([0.3] * 4)
    assert variance[:, 3] == pytest.approx([0.01, 0.02, 0.05, 0.10])


def test_a_held_input_fades_and_its_variance_is_that_of_the_fading_guess() -> None:
    # GIVEN an agent whose acceleration halves every tick, and one guess that knows so and one that does not
    halving = {tick: 0.5**tick for tick in range(5)}
    fading, staying = InputHistory(np.array([OTHER]), hold=True, fade=0.5), InputHistory(np.array([OTHER]), hold=True)
    for tick, value in halving.items():
        for made in (fading, staying):
            made.insert(input_rows(tick, 0, np.full(3, value), NOISE), 0)
    accel, variance = fading.table(4, 8)
    # THEN the first is right, and as sure as its sensor
    assert accel[:, 0] == pytest.approx([0.5**tick for tick in range(4, 8)])
    assert variance[:, 0] == pytest.approx([0.01] * 4)
    # and the other takes the changes for noise
    assert staying.table(4, 8)[1][1, 0] > 0.05


def test_the_fade_of_a_tick_follows_from_its_time_constant() -> None:
    assert fade_per_tick(EstimatorSettings(), 0.1) == 1.0
    assert fade_per_tick(EstimatorSettings(held_accel_fade_s=2.0), 0.1) == pytest.approx(np.exp(-0.05))


def test_a_held_input_is_never_trusted_less_than_an_unknown_one() -> None:
    _, variance = history(True, {tick: 0.5 * tick for tick in range(6)}).table(5, 40)
    assert variance[1:, 3].max() == OTHER


def test_too_few_known_changes_hold_nothing() -> None:
    accel, variance = history(True, {0: 1.0, 1: 1.0}).table(1, 3)
    assert accel[1, 3] == 0.0
    assert variance[1, 3] == OTHER


def test_an_input_is_held_forward_never_backward() -> None:
    accel, _ = history(True, dict.fromkeys(range(10, 15), 1.0)).table(8, 12)
    assert accel[:, 3].tolist() == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_arrival_does_not_matter(seed: int) -> None:
    # GIVEN accelerations that change little enough to be held with less than the variance of an unknown one
    rng = np.random.default_rng(seed)
    samples = {tick: 0.1 * float(rng.normal()) for tick in range(20) if tick % 7}
    shuffled = {int(tick): samples[int(tick)] for tick in rng.permutation(list(samples))}
    one, other = history(True, samples).table(10, 25), history(True, shuffled).table(10, 25)
    # THEN what is held is the same to the last bit
    assert (one[0] == other[0]).all()
    assert (one[1] == other[1]).all()
    assert NOISE[0] < one[1][11, 3] < OTHER


def test_the_first_of_two_inputs_for_one_tick_counts() -> None:
    made = history(False, {3: 1.0})
    made.insert(input_rows(3, 1, np.full(3, 9.0), NOISE), 0)
    assert made.table(3, 4)[0][0, 3] == 1.0


def test_memory_is_bounded() -> None:
    made = history(True, dict.fromkeys(range(500), 1.0))
    made.forget_before(500)
    assert made.table(490 - HISTORY_TICKS, 491 - HISTORY_TICKS)[0][0, 3] == 0.0  # gone
    assert made.table(499, 500)[0][0, 3] == 1.0


def test_in_another_fleet_a_history_knows_the_same_of_the_same_agents() -> None:
    # GIVEN a history of two agents, WHEN they go on in another order with a third between them
    made = history(True, {4: 0.5, 5: 0.6}, slot=1)
    made.insert(input_rows(5, 0, np.full(3, 0.1), NOISE), 0)
    change = MemberChange.between(Layout((1, 2)), (2, 3, 1), 1, {3: (np.zeros(6), np.eye(6))})
    made.change_members(change, np.full(3, OTHER))
    # THEN it knows the same of them, and goes on
    for tick, slot, value in ((5, 2, 9.0), (4, 1, 0.7)):
        made.insert(input_rows(tick, slot, np.full(3, value), NOISE), 0)
    accel, _ = made.table(4, 6)
    assert accel[:, ::3].tolist() == [[0.5, 0.7, 0.0], [0.6, 0.0, 0.1]]
