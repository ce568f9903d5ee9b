"""The verdict on a run: one line, and whether the run was as wanted."""

from __future__ import annotations

from typing import Any

import pytest

from fleetloc import cli
from fleetloc.errors import InputError
from fleetloc.verdict import read_requirements, verdict
from tests.fleetloc.report.test_fleet_report import LINE3


def figures(mode: str = "live", **fleet: Any) -> dict[str, Any]:
    agents = [{"id": agent, "ticks_expected": 100, "ticks_without_estimate": 10} for agent in (1, 2)]
    found = {
        "availability": 0.9,
        "ticks_on_time_fraction": 0.99,
        "position_rmse_m": 0.05,
        "anees": None,
        "deaths": [],
        "interrupted": False,
    }
    return {"mode": mode, "agents": agents, "fleet": found | fleet}


def test_a_run_without_limits_passes_and_says_how_available_it_was() -> None:
    found = verdict(figures(), {})
    assert (found.line, found.failed) == ("passed: available 90.0 %", False)


def test_alarms_doubts_and_what_was_not_used_are_said() -> None:
    run = figures(mode="replay")
    calm = {"alarm": {"ticks": 0}, "doubts": {}, "refusals": {}, "other": {"no_fix": {"ticks": 9}}}
    for agent in run["agents"]:
        agent |= {"said": calm, "refused": {}, "packets": {"rejected": {}}}
    assert verdict(run, {}).line == "passed: available 90.0 %"
    run["agents"][1] |= {
        "said": {
            "alarm": {"ticks": 12},
            "doubts": {"one_plane": {"ticks": 3}, "ambiguous": {"ticks": 5}},
            "refusals": {"receiver_off": {"ticks": 40}},
            "other": {},
        },
        "refused": {"heard: impossible": 4},
        "packets": {"rejected": {"replay": 3}},
    }
    assert verdict(run, {}).line == (
        "passed: alarm of 2 in 12.0 %; doubts of 2 (ambiguous 5.0 %, one plane 3.0 %); "
        "not used by 2 (receiver off 40.0 %, 7 item(s)); available 90.0 %"
    )


@pytest.mark.parametrize(
    ("required", "words"),
    [
        ("availability=0.89,on_time=0.99,rmse=0.05", ""),
        ("availability=0.91", "availability 0.9, at least 0.91 required"),
        ("rmse=0.049", "position RMSE in m 0.05, at most 0.049 required"),
        ("anees=2", "ANEES unknown, at most 2 required"),
    ],
)
def test_a_limit_that_is_not_kept_fails_and_is_named(required: str, words: str) -> None:
    found = verdict(figures(), read_requirements(required))
    assert found.failed == bool(words)
    assert words in found.line
    assert found.line.startswith("FAILED: " if words else "passed: ")


def test_a_run_without_a_single_estimate_fails() -> None:
    run = figures(availability=0.0)
    run["agents"][0]["ticks_without_estimate"] = 100
    assert verdict(run, {}).line == "passed: no estimate at all of 1; available 0.0 %"
    run["agents"][1]["ticks_without_estimate"] = 100
    found = verdict(run, {})
    assert found.failed
    assert found.line.startswith("FAILED: no drone had a single estimate")
    run["fleet"]["interrupted"] = True
    assert verdict(run, {}).line == "passed: no drone had a single estimate; interrupted; available 0.0 %"


def test_who_died_an_interruption_and_an_overloaded_machine_are_said() -> None:
    one = [{"name": "agent 2"}, {"name": "uwb driver 1"}]
    found = verdict(figures(ticks_on_time_fraction=0.4, deaths=one, interrupted=True), {})
    assert not found.failed
    assert "overloaded: 40 % of the ticks on time; ended in flight: agent 2, uwb driver 1; interrupted" in found.line
    assert "overloaded" not in verdict(figures("lockstep", ticks_on_time_fraction=0.4), {}).line
    all_dead = verdict(figures(deaths=[*one, {"name": "agent 1"}]), {})
    assert all_dead.failed
    assert "no daemon was left" in all_dead.line


@pytest.mark.parametrize("text", ["available=0.9", "rmse", "rmse=small", "rmse=nan"])
def test_a_limit_that_is_none_is_refused_before_anything_flies(text: str) -> None:
    with pytest.raises(InputError, match="--require"):
        read_requirements(text)
    assert cli.main(["fleet", str(LINE3), "--lockstep", "--require", text]) == 2


def test_from_the_command_line(tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["fleet", str(LINE3), "--lockstep", "--duration", "4", "--out", str(tmp_path)]
    assert cli.main([*arguments, "--require", "availability=0.3"]) == 0
    assert "\npassed: available" in capsys.readouterr().out
    assert cli.main([*arguments, "--require", "availability=0.999"]) == 1
    assert "at least 0.999 required" in capsys.readouterr().out
    # half a second is no time for an estimate
    assert cli.main([*arguments, "--duration", "0.5"]) == 1
    assert "FAILED: no drone had a single estimate" in capsys.readouterr().out
