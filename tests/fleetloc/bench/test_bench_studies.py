"""``fleetloc bench accuracy | loss | blind | partition``: figures by hand, and the commands from end to end."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from estimators.estimator import Status
from estimators.settings import EstimatorSettings, default_settings
from fleetloc import cli
from fleetloc.bench import partition as parts
from fleetloc.bench.accuracy import sweep_points
from fleetloc.bench.blind import CASES, blind_row
from fleetloc.bench.links import CHANNELS, points
from fleetloc.bench.methods import CENTRALISED, FLAGSHIP, GENIE, chosen, default_methods, methods_with_genie
from fleetloc.errors import InputError
from sim_bridge.studies.air import Air, lossy
from sim_bridge.studies.genie import Genie
from sim_bridge.studies.monte_carlo import Sample
from sim_bridge.studies.study_scenario import GRAPHS, StudyScenario

# --- methods and conditions -------------------------------------------------------------------------------------


def test_methods_are_chosen_by_name() -> None:
    methods = methods_with_genie()
    assert list(chosen(methods, "")) == list(methods)
    assert list(chosen(methods, " genie, dmhe_shared")) == [FLAGSHIP, GENIE]
    assert list(chosen(methods, "dmhe_relay")) == [FLAGSHIP]  # its former name
    with pytest.raises(InputError, match=r"--methods: expected some of .*, found kalman"):
        chosen(methods, "dmhe,kalman")


def test_the_genie_has_the_flagships_model() -> None:
    methods = methods_with_genie()
    assert methods[FLAGSHIP] == default_settings()
    assert methods[GENIE] == Genie(default_settings())
    assert set(methods) == {*default_methods(), GENIE}


def test_conditions_of_the_link_study() -> None:
    found = points([0.0, 0.3], [0, 2], list(CHANNELS))
    assert [(each.axis, each.value, each.is_reference) for each in found[:4]] == [
        ("loss", 0.0, True),
        ("loss", 0.3, False),
        ("delay_ticks", 0.0, True),
        ("delay_ticks", 2.0, False),
    ]
    assert [each.value for each in found[4:]] == [None] * len(CHANNELS)
    assert [each.air for each in found[:4]] == [None, lossy(0.3), None, Air(delay_ticks=2)]
    assert [each.air for each in found[4:]] == [air for _, air, _ in CHANNELS.values()]
    assert [each.scenario.graph for each in found[4:]] == ["line", "line", "line", "triangle", "line"]


def test_conditions_of_the_accuracy_study() -> None:
    found = sweep_points(StudyScenario("K5"), "ring", [3, 7], [1.0, 0.6], [0.0, 10.0])
    assert [each.scenario.graph for each in found] == ["triangle", "ring7", "K5", "K5", "K5", "K5"]
    assert [each.scenario.blind for each in found] == [0, 0, 0, 2, 0, 0]
    assert [each.scenario.start_offset_m for each in found] == [0, 0, 0, 0, 0, 10.0]
    assert [each.is_reference for each in found] == [False, False, True, False, True, False]


# --- the blind drone, by hand -----------------------------------------------------------------------------------


def a_blind_sample(errors_m: list[float], sigma_m: float, status: list[Status]) -> Sample:
    """Runs of two agents, the last one's error and status the same at every tick."""
    sample = Sample()
    for error, said in zip(errors_m, status, strict=True):
        sample.own_position.append(np.stack([np.zeros(101), np.full(101, error)], axis=1))
        sample.own_sigma.append(np.full((101, 2), sigma_m))
        sample.status.append(np.stack([np.zeros(101, np.int8), np.full(101, said, np.int8)], axis=1))
        sample.nees_own.append(np.stack([np.zeros(101), np.full(101, 2.0)], axis=1))
        sample.nees_full.append(np.full((101, 2), 1.5))
    return sample


def test_figures_of_the_blind_drone_by_hand() -> None:
    # GIVEN five runs: one right, one right but flagged, three wrong by more than 3 sigma, of which two are flagged
    lost = Status.NOT_OBSERVABLE
    row = blind_row(a_blind_sample([0.1, 0.2, 5.0, 6.0, 7.0], 1.0, [Status.OK, lost, lost, Status.OK, lost]))
    assert row["own_position_median_m"] == 5.0
    assert row["own_position_p90_m"] == pytest.approx(7.0)
    assert row["anees_own_mean"] == 2.0
    assert row["anees_full_mean"] == 1.5
    assert row["runs"] == 5
    assert row["runs_beyond_3_sigma"] == 3
    assert row["runs_beyond_3_sigma_flagged"] == 2
    assert row["runs_within_3_sigma_flagged"] == 1


def test_a_run_is_flagged_by_the_last_ticks_alone() -> None:
    sample = a_blind_sample([5.0], 1.0, [Status.NOT_OBSERVABLE])
    sample.status[0][80:] = Status.OK
    assert blind_row(sample)["runs_beyond_3_sigma_flagged"] == 0
    sample.status[0][80:91] = Status.NOT_OBSERVABLE  # 11 of 21
    assert blind_row(sample)["runs_beyond_3_sigma_flagged"] == 1


def test_cases_of_the_blind_study() -> None:
    assert {case.name: case.ranges for case in CASES} == {
        "K4": 3, "K5": 4, "K6": 5, "triangle from 0.3 m": 2, "triangle": 2, "ring4": 2, "line": 1,
    }  # fmt: skip
    for case in CASES:
        recording = case.scenario().record(0, 0)
        assert np.isnan(recording.gps[:, -1]).all()
        assert len(recording.agents) == GRAPHS[case.graph][0]


# --- the partition, by hand -------------------------------------------------------------------------------------


def test_disagreement_by_hand() -> None:
    mean = np.zeros((1, 3, 2))
    mean[0] = [[0, 0], [3, 4], [0, 1]]
    # pairs (0, 1) and (0, 2): 5 and 1
    assert parts.between(mean, [0], [1, 2]) == pytest.approx([np.sqrt(13.0)])
    assert parts.between(mean, [1, 2], [0]) == pytest.approx([np.sqrt(13.0)])


def test_when_islands_agree_again_by_hand() -> None:
    ratio = np.array([9.0, 1.0, 9.0, 3.0, 1.1, 1.3, 1.2, 1.0])
    assert parts.agrees_after(ratio, 2) == 4  # 1.3 came after 1.1
    assert parts.agrees_after(ratio, 6) == 0
    assert parts.agrees_after(np.array([1.0, 9.0]), 0) is None


def test_figures_of_a_partition_by_hand() -> None:
    # GIVEN one run of 30 ticks cut over ticks 10..19, whose islands agree again 3 ticks after
    plan = parts.PartitionPlan(EstimatorSettings(), 0, begin_s=10, length_s=10, after_s=9, period_s=1.0)
    assert plan.cut == (10, 20)
    island, rest, apart = np.ones(30), np.full(30, 0.5), np.ones(30)
    island[15], rest[22] = 3.0, 7.0
    apart[10:23] = 8.0
    outcome = parts.PartitionOutcome((island, rest), 2 * apart, 2 * np.ones(30), 4 * apart, np.ones(30), 0.75)
    found = parts.figures(plan, [outcome, outcome])
    assert found["availability"] == 0.75
    assert found["anees_island_largest_of_a_tick"] == 3.0
    assert found["anees_island_mean_while_cut"] == pytest.approx(1.2)
    assert found["anees_rest_largest_of_a_tick"] == 7.0  # after the cut counts too
    assert found["disagreement_norm_clean"] == 2.0
    assert found["disagreement_ratio_at_the_end_of_the_cut"] == 8.0
    assert found["agrees_again_after_s"] == 3.0
    assert (found["disagreement_norm_1s_after"], found["disagreement_norm_5s_after"]) == (16.0, 2.0)
    assert found["norm_full_error_while_cut"] == 32.0
    assert found["norm_full_clean_error_last_5s"] == 1.0


# --- the commands -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["accuracy", "--graph", "star"], "--graph: expected one of line, triangle"),
        (["accuracy", "--agents", "2,5"], "--agents: expected numbers from 3 to 10"),
        (["accuracy", "--agents", "3.5"], "--agents: expected whole numbers from 3 to 10"),
        (["accuracy", "--gps-shares", "1.5"], "--gps-shares: expected numbers from 0 to 1"),
        (["accuracy", "--start", "paper", "--start-offsets", "10"], "--start-offsets: expected the good start"),
        (["accuracy", "--methods", "kalman"], "--methods: expected some of dmhe_pre_ekf"),
        (["loss", "--losses", "0,x"], "--losses: expected numbers from 0 to 0.99"),
        (["loss", "--losses", "nan"], "--losses: expected numbers from 0 to 0.99"),
        (["loss", "--channels", "smoke"], "--channels: expected some of bursts"),
        (["blind", "--methods", "kalman"], "--methods: expected some of"),
    ],
)
def test_bad_options_are_refused_in_one_line(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.strip().splitlines()) == 1


def test_a_folder_that_cannot_be_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert cli.main(["bench", "loss", "--runs", "1", "--out", str(tmp_path / "file" / "x")]) == 2
    assert "--out: expected a folder that can be written" in capsys.readouterr().err


def test_loss_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--runs", "1", "--losses", "0.5", "--delays", "", "--channels", "duplicates", "--jobs", "1"]
    methods = ["--methods", f"{FLAGSHIP},{GENIE},{CENTRALISED}", "--out", str(tmp_path / "out")]
    assert cli.main(["bench", "loss", *arguments, *methods, "--json", str(tmp_path / "a.json")]) == 0
    assert "Beside the genie" in capsys.readouterr().out
    document = json.loads((tmp_path / "a.json").read_text())
    assert document == json.loads((tmp_path / "out" / "results.json").read_text())
    assert (tmp_path / "out" / "loss.png").read_bytes().startswith(b"\x89PNG")
    lossless, lossy, doubled = document["points"]
    assert (lossless["loss"], lossy["loss"]) == (0.0, 0.5)
    figures = [each["rows"][FLAGSHIP] for each in (lossless, lossy, doubled)]
    # the same flights, flown: all ticks served, late copies cost little, the central filter does not know of links
    assert [each["availability_steady"] for each in figures] == [1.0] * 3
    assert figures[2]["norm_full_steady_mean"] == pytest.approx(figures[0]["norm_full_steady_mean"], rel=0.2)
    ratio = figures[1]["norm_full_steady_ratio_to_reference"]
    assert ratio == pytest.approx(figures[1]["norm_full_steady_mean"] / figures[0]["norm_full_steady_mean"])
    assert 0.9 < ratio < 1.3
    assert lossy["rows"][CENTRALISED]["norm_full_steady_ratio_to_reference"] == 1.0
    central = lossy["rows"][CENTRALISED]["norm_full_steady_mean"]
    assert figures[1]["norm_full_steady_ratio_to_centralized"] == pytest.approx(
        figures[1]["norm_full_steady_mean"] / central
    )


def test_accuracy_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--runs", "1", "--samples", "20", "--agents", "3,4", "--jobs", "1", "--out", str(tmp_path)]
    methods = ["--methods", f"dekf_ci_shared,{CENTRALISED}", "--gps-shares", "0.67", "--start-offsets", "10"]
    assert cli.main(["bench", "accuracy", *arguments, *methods]) == 0
    assert "2 of 3 with GPS" in capsys.readouterr().out
    document = json.loads((tmp_path / "results.json").read_text())
    assert [each["graph"] for each in document["points"]] == ["triangle", "ring4", "line", "line"]
    assert [each["blind"] for each in document["points"]] == [0, 0, 1, 0]
    assert set(document["rows"]) == {"dekf_ci_shared", CENTRALISED}
    assert (tmp_path / "agents.png").exists()
    assert not (tmp_path / "gps_share.png").exists()  # a single point is no curve


def test_partition_and_blind_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(parts, "PartitionPlan", partial(parts.PartitionPlan, begin_s=1.0, after_s=5.5))
    partition = ["partition", "--runs", "1", "--length", "1", "--jobs", "1", "--out", str(tmp_path)]
    assert cli.main(["bench", *partition]) == 0
    document = json.loads((tmp_path / "results.json").read_text())
    assert document["disagreement_ratio_at_the_end_of_the_cut"] > 1.2
    assert (tmp_path / "partition.png").exists()
    monkeypatch.setattr("fleetloc.bench.blind.CASES", CASES[:1])
    blind = ["blind", "--runs", "1", "--methods", "centralized_iekf", "--jobs", "1"]
    assert cli.main(["bench", *blind, "--json", str(tmp_path / "b.json")]) == 0
    row = json.loads((tmp_path / "b.json").read_text())["rows"]["K4"]["centralized_iekf"]
    assert row["runs"] == 1
    assert "K4 |" in capsys.readouterr().out
