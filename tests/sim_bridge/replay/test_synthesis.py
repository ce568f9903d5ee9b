"""Ranges made of the truth of a log."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.logs.events import TruthSample
from sim_bridge.replay.side_files.range_files import RangeLine
from sim_bridge.replay.synthesis import Synthesiser, SyntheticNoise

SPEED_MPS = 3.0
PAIR = {1: (2,), 2: (1,)}


def truth(agent: int, t_s: float) -> TruthSample:
    """Agent 1 stays, agent 2 flies east from 10 m."""
    place = (0.0, 0.0, -5.0) if agent == 1 else (0.0, 10.0 + SPEED_MPS * t_s, -5.0)
    return TruthSample(t_s, place, (0.0, 0.0 if agent == 1 else SPEED_MPS, 0.0), None)


def made(noise: SyntheticNoise, seed: int = 1, seconds: float = 20.0, neighbours: dict[int, tuple[int, ...]] = PAIR
         ) -> tuple[list[RangeLine], Synthesiser]:  # fmt: skip
    synthesiser = Synthesiser(neighbours, noise, seed)
    lines = []
    for k in range(int(seconds / 0.02)):
        for agent in (1, 2):
            lines += synthesiser.on_truth(agent, truth(agent, 0.02 * k))
    return lines, synthesiser


def test_ranges_of_the_truth_have_the_stated_noise_rate_and_losses() -> None:
    # GIVEN noise of 0.1 m at 10 Hz, a fifth lost
    lines, synthesiser = made(SyntheticNoise(sigma_m=0.1, dropout=0.2), seconds=60.0)
    # THEN rate, losses and errors are those
    errors = np.array([line.range_m - (10.0 + SPEED_MPS * line.time_s) for line in lines])
    expected = 2 * 60 * 10
    assert len(lines) == pytest.approx(0.8 * expected, abs=4 * math.sqrt(0.16 * expected))
    assert len(lines) + synthesiser.made["lost"] == pytest.approx(expected, abs=4)
    assert abs(errors.mean()) < 4 * 0.1 / math.sqrt(len(errors))
    assert errors.std() == pytest.approx(0.1, rel=0.12)
    assert {line.sigma_m for line in lines} == {0.1}


def test_the_same_seed_makes_the_same_ranges_and_a_third_drone_changes_none_of_them() -> None:
    noise = SyntheticNoise()
    first, _ = made(noise)
    assert made(noise)[0] == first
    assert made(noise, seed=2)[0] != first
    again, _ = made(noise, neighbours={1: (2, 3), 2: (1, 3), 3: (1, 2)})
    errors = [one.range_m - (10.0 + SPEED_MPS * one.time_s) for one in first[:50] if one.observer == 1]
    others = [one.range_m - (10.0 + SPEED_MPS * one.time_s) for one in again[:50] if one.observer == 1]
    assert others[:20] == pytest.approx(errors[:20], abs=1e-9)


def test_nothing_is_made_across_a_gap_of_the_truth_or_out_of_reach() -> None:
    # GIVEN truth that is silent from 5 to 8 s
    synthesiser = Synthesiser(PAIR, SyntheticNoise(max_range_m=10.0 + SPEED_MPS * 10.0), 1)
    times = []
    for k in range(1000):
        t_s = 0.02 * k
        if not 5.0 < t_s < 8.0:
            times += [line.time_s for agent in (1, 2) for line in synthesiser.on_truth(agent, truth(agent, t_s))]
    # THEN no range lies in the silence, nor after the drones are too far apart
    assert not [t for t in times if 5.02 < t < 7.98]
    assert max(times) <= 10.0 + 1e-9
    assert synthesiser.made["too far"] > 0


@pytest.mark.parametrize("text", ["sigma=1", "rate_hz=0", "dropout=2", "sigma_m=x", "sigma_m"])
def test_a_wrong_noise_model_is_refused(text: str) -> None:
    with pytest.raises(ReplayError, match="--ranges synthetic"):
        SyntheticNoise.parsed(text)


@settings(max_examples=30)
@given(st.floats(0.001, 10), st.floats(0.5, 100), st.floats(0, 1))
def test_a_noise_model_is_read_as_written(sigma_m: float, rate_hz: float, dropout: float) -> None:
    text = f"sigma_m={sigma_m!r},rate_hz={rate_hz!r},dropout={dropout!r}"
    assert SyntheticNoise.parsed(text) == SyntheticNoise(sigma_m=sigma_m, rate_hz=rate_hz, dropout=dropout)
