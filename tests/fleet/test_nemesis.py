"""The nemesis: a few seeds keep everything, a history that does not is noticed, and a run goes on where it was."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.fleet.nemesis import CALM_S, FAULTS_S, Flight, Kind, get_args, main, schedule, seeds_of


@functools.cache
def flown(seed: int) -> Flight:
    return Flight(seed)


@pytest.mark.parametrize("seed", [2, 3, 16])
def test_what_must_hold_holds_whatever_happens(seed: int) -> None:
    found = flown(seed).judged()
    assert found.broken == []
    assert 0.01 < found.rmse_m < 1.0


def test_a_seed_gives_the_same_faults_and_all_kinds_come_up() -> None:
    schedules = [schedule(seed, (1, 2, 3)) for seed in range(100)]
    assert schedules[7] == schedule(7, (1, 2, 3))
    assert {blow.kind for blows in schedules for blow in blows} == set(get_args(Kind))
    for blow in (blow for blows in schedules for blow in blows):
        assert CALM_S <= blow.from_s < blow.to_s <= CALM_S + FAULTS_S
        assert blow.of != blow.agent


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"least_eigenvalue": -1e-9}, "not positive definite"),
        ({"finite": False}, "not finite"),
        ({"level_m": (0.0, 0.0)}, "outside their protection level"),
        ({"age_ticks": (0, 255, 0)}, "does not know all others"),
        ({"state": "ALERT"}, "is ALERT at the end"),
        ({"t_s": 1e9}, "newer than now"),
    ],
)
def test_a_history_that_does_not_keep_it_is_noticed(change: dict[str, Any], word: str) -> None:
    flight = flown(3)
    kept = flight.told
    try:
        flight.told = [replace(each, **change) for each in kept]
        assert any(word in line for line in flight.judged().broken)
        flight.told = kept[::-1]
        assert any("do not rise" in line for line in flight.judged().broken)
        flight.told = [each for each in kept if each.agent != 2]
        assert any("2 is not back" in line for line in flight.judged().broken)
    finally:
        flight.told = kept


def test_packets_that_were_played_back_and_taken_are_noticed() -> None:
    flight = flown(3)
    flight.agents[0].stale_taken = 2
    assert "1 took 2 packets that were played back" in flight.judged().broken
    flight.agents[0].stale_taken = 0


def test_a_run_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.jsonl"
    out.write_text("".join(json.dumps({"seed": seed, "broken": ["x"] * (seed == 5)}) + "\n" for seed in (4, 5)))
    assert main(["--seeds", "4..5", "--out", str(out)]) == 1
    assert capsys.readouterr().out == "1 of 2 seeds ok, not [5]\n"
    assert main(["--seeds", "4", "--out", str(out)]) == 0
    assert list(seeds_of("4..5")) == [4, 5]
    assert np.size(seeds_of("7")) == 1
