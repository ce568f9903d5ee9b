"""``fleetloc report``: the report of a run whose parts were started one by one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fleetloc import cli
from tests.fleetloc.report.test_fleet_report import AGENTS, LINE3, TICKS, make_run


def test_the_report_of_a_finished_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path)
    (tmp_path / "agent_003.estimates").write_bytes((tmp_path / "agent_002.estimates").read_bytes())
    assert cli.main(["report", str(LINE3), str(tmp_path)]) == 0
    figures = json.loads((tmp_path / "report.json").read_text())
    assert [agent["id"] for agent in figures["agents"]] == list(AGENTS)
    assert figures["agents"][1]["ticks_on_time"] == TICKS
    assert (tmp_path / "report.html").is_file()
    assert "report.html" in capsys.readouterr().out


@pytest.mark.parametrize("missing", ["truth.npz", "agent_003.estimates"])
def test_what_is_missing_is_named_with_who_writes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], missing: str
) -> None:
    make_run(tmp_path)  # agent 3 left no record
    if missing == "truth.npz":
        (tmp_path / missing).unlink()
    assert cli.main(["report", str(LINE3), str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"expected {missing}, which `fleetloc sim --out` and `fleetloc agent --out` write" in error


def test_waiting_takes_only_what_was_written_since(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """GIVEN the summary of an earlier run WHEN it waits for this one's THEN it says whose it did not get."""
    make_run(tmp_path)
    (tmp_path / "agent_001.json").write_text("{}")
    assert cli.main(["report", str(LINE3), str(tmp_path), "--wait", "1e-9"]) == 3
    error = capsys.readouterr().err
    assert "expected simulator.json, agent_001.json, agent_002.json, agent_003.json within 1e-09 s" in error
