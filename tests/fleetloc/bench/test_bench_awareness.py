"""``fleetloc bench awareness``: the figures of a flight by hand, and the command from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimators.settings import DEFAULTS_OF_KIND
from fleetloc import cli
from fleetloc.bench.awareness import CEILING_M, FOUND_M, SCENARIOS, SETTLED_S, AwarenessPlan, of_outages, of_target
from sim_bridge.studies.awareness import DRONES
from sim_bridge.studies.awareness_flight import AwarenessFlight


def flight(error_m: np.ndarray, nees: np.ndarray) -> AwarenessFlight:
    bias_m = np.full(error_m.shape[:2], np.nan)
    bias_m[40:, 0], bias_m[:40, 0], bias_m[:, 1] = 0.42, 5.0, 9.0  # drone 1 after 50 s is looked at
    return AwarenessFlight(error_m, nees, np.ones(error_m.shape[:2], bool), bias_m)


def test_a_target_is_found_when_it_is_near_and_lost_where_it_is_no_part_of_the_estimate() -> None:
    error_m, nees = np.ones((150, DRONES, DRONES + 1)), np.ones((150, DRONES, DRONES + 1))
    error_m[:17, 0, DRONES], nees[:17, 0, DRONES] = np.inf, np.nan
    error_m[17:20, 0, DRONES] = FOUND_M + 1.0
    nees[100:, 0, DRONES] = 30.0 / 3.0
    found = of_target(flight(error_m, nees))
    assert found["found_after_s"] == 20.0
    assert found["error_of_target_50s_to_100s_m"] == 1.0
    assert found["share_beyond_5_sigma"] == pytest.approx(50 / 133)
    assert found["bias_of_target_off_by_m"] == pytest.approx(0.12)
    error_m[60, 0, DRONES] = np.inf
    assert of_target(flight(error_m, nees))["error_of_target_50s_to_100s_m"] == np.inf


def test_an_outage_is_looked_at_while_it_lasts_and_when_it_is_over() -> None:
    error_m, nees = np.zeros((181, DRONES, DRONES)), np.ones((181, DRONES, DRONES))
    error_m[70:90, 0, 7], error_m[93:103, 0, 7], nees[60:90, 0, 7] = 9.0, 2.0, 4.0
    found = of_outages(flight(error_m, nees))
    assert found["error_of_8_seen_by_1_late_in_outage_m"] == 9.0
    assert found["error_of_8_seen_by_1_3s_after_m"] == 2.0
    assert found["anees_of_8_seen_by_1_in_outage"] == 4.0


@pytest.mark.parametrize("test", SCENARIOS)
def test_a_plan_keeps_what_its_kind_brings_along(test: str) -> None:
    plan = AwarenessPlan(test, "ladder", "dmhe_shared", 6, None, 0.0, 0)
    settings = plan.settings()
    assert settings.rounds == 6
    assert settings.window == DEFAULTS_OF_KIND["dmhe_shared"]["window"]
    assert plan.scenario().graph == "ladder"
    assert settings.limits.target.ceiling_m == (None if plan.scenario().target is None else CEILING_M)


def test_the_command_writes_a_row_for_each_estimator_and_number_of_rounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN half the flight: ten seconds after it is looked at
    monkeypatch.setitem(SCENARIOS, "1", replace(SCENARIOS["1"], duration_s=SETTLED_S + 10.0))
    out = tmp_path / "figures.json"
    arguments = ["bench", "awareness", "--kinds", "consensus_mhe", "--rounds", "0,2", "--runs", "1", "--jobs", "1"]
    assert cli.main([*arguments, "--json", str(out)]) == 0
    none, two = json.loads(out.read_text())["rows"]
    assert (none["rounds"], two["rounds"]) == (0, 2)
    # without rounds nobody tells of others: drone 1 knows itself, and knows others far worse than with them
    assert two["error_of_2_seen_by_1_m"] < 0.5 * none["error_of_2_seen_by_1_m"]
    assert two["own_position_m"] < 1.2
    assert two["availability"] == 1.0


@pytest.mark.parametrize(("option", "value"), [("--test", "5"), ("--kinds", "guess"), ("--rounds", "17")])
def test_a_wrong_option_is_one_line(option: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "awareness", option, value]) == 2
    message = capsys.readouterr().err.strip()
    assert option in message
    assert value in message
