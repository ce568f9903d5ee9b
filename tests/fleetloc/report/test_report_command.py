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


def test_a_missing_truth_is_named_with_who_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path)
    (tmp_path / "truth.npz").unlink()
    assert cli.main(["report", str(LINE3), str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "expected truth.npz, which `fleetloc sim --out` and `fleetloc agent --out` write" in error


def test_a_record_that_is_not_there_or_broken_is_named_and_done_without(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path)  # agent 3 left no record
    (tmp_path / "agent_001.estimates").write_bytes(b'{"format":"fleetloc-est')  # killed before anything was flushed
    assert cli.main(["report", str(LINE3), str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert "left out: record" in said.err
    assert "agent_003.estimates: not there" in said.err
    assert "agent_001.estimates: expected a first line" in said.err
    figures = json.loads((tmp_path / "report.json").read_text())
    assert figures["agents"][0]["ticks_on_time"] > 0  # of its first daemon
    assert figures["agents"][1]["ticks_on_time"] == TICKS
    assert figures["agents"][2]["ticks_on_time"] == 0
    assert figures["verdict"] == {"line": said.out.splitlines()[-2], "failed": False}
    for agent_id in (1, 2):
        for path in tmp_path.glob(f"agent_00{agent_id}*.estimates"):
            path.unlink()
    assert cli.main(["report", str(LINE3), str(tmp_path)]) == 2
    assert "expected agent_001.estimates" in capsys.readouterr().err


def test_waiting_takes_only_what_was_written_since(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """GIVEN the summary of an earlier run WHEN it waits for this one's THEN it says whose it did not get."""
    make_run(tmp_path)
    (tmp_path / "agent_001.json").write_text("{}")
    assert cli.main(["report", str(LINE3), str(tmp_path), "--wait", "1e-9"]) == 3
    error = capsys.readouterr().err
    assert "expected simulator.json, agent_001.json, agent_002.json, agent_003.json within 1e-09 s" in error
