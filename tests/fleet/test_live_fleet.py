"""A live fleet from start to report, with a daemon killed on the way, and interrupted."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from agent.config.reading import load_config
from agent.log.estimate_log import read_record
from fleetloc.report.fleet_report import report_figures
from fleetloc.report.fleet_results import load_results
from fleetloc.run.lockstep_run import fly_in_lockstep
from tests.support.fleet_process import ROOT, FleetProcess, until

pytestmark = pytest.mark.slow
Start = Callable[..., FleetProcess]
DROPPED_WITHIN = timedelta(seconds=2)
BACK_WITHIN_S = 10.0


def test_a_live_run_is_on_time_consistent_and_equal_to_the_lockstep_run(start_fleet: Start, tmp_path: Path) -> None:
    fleet = start_fleet("--duration", "20", "--seed", "1", "--json", str(tmp_path / "figures.json"))
    code, stdout, stderr = fleet.finish()
    assert code == 0, stderr
    assert str(fleet.out / "report.html") in stdout
    assert fleet.nothing_left()
    report = fleet.report()
    assert (tmp_path / "figures.json").read_bytes() == (fleet.out / "report.json").read_bytes()
    assert report["duration_s"] == pytest.approx(20.0, abs=0.1)
    assert report["seed"] == 1
    assert report["fleet"]["deaths"] == []
    # GIVEN a machine that may be busy with other things, THEN still nearly every tick is on time
    assert report["fleet"]["ticks_on_time_fraction"] >= 0.95
    again = lockstep_position_rmse_m(fleet.out / "fleet.toml", tmp_path / "again")
    for agent in report["agents"]:
        assert agent["ticks_expected"] == pytest.approx(200, abs=1)
        assert agent["position_rmse_after_10s_m"] == pytest.approx(again[agent["id"]], rel=0.15)
        assert 0.3 < agent["anees_after_10s"] < 3.0
        assert 0.0 < agent["tick_time_p50_s"] <= agent["tick_time_p99_s"] < 0.1
        assert 0.0 < agent["cpu_fraction"] < 1.0
        assert 50.0 < agent["rss_mb"] < 400.0
        assert agent["packets"]["received"] > 300
        assert agent["packets"]["rejected"] == {}
        assert agent["sensors"]["imu"]["used"] > 1500
        assert agent["sensors"]["gps"]["used"] > 150
        assert agent["sensors"]["range"]["used"] > 150
    check_page((fleet.out / "report.html").read_text())


def lockstep_position_rmse_m(config_file: Path, directory: Path) -> dict[int, float]:
    """Own position RMSE after 10 s of the same scenario in virtual time, by agent."""
    config = load_config(config_file)
    directory.mkdir()
    outcome = fly_in_lockstep(config, directory)
    figures = report_figures(config, load_results(config, directory), directory, outcome, "lockstep")
    return {agent["id"]: agent["position_rmse_after_10s_m"] for agent in figures["agents"]}


def check_page(page: str) -> None:
    """Plots are in it, and nothing has to be fetched."""
    assert page.count("<svg") == 5
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!#)""", page)
    assert "url(http" not in page


def test_a_killed_daemon_is_dropped_and_taken_back(start_fleet: Start) -> None:
    fleet = start_fleet("--duration", "14")
    until(fleet.flying, "flight")
    until(lambda: "agent 2: ok" in fleet.log(2), "agent 2 is aligned")
    pid, killed_at = fleet.pid_of(3), datetime.now()
    os.kill(pid, signal.SIGKILL)
    until(lambda: "neighbour 3 has left" in fleet.log(2), "agent 2 notices")
    restarted = subprocess.Popen(
        [sys.executable, "-m", "fleetloc", "agent", str(fleet.out / "fleet.toml"), "--id", "3"],
        cwd=ROOT, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        code, _, stderr = fleet.finish()
    finally:
        restarted.terminate()
        restarted.wait()
    assert code == 0, stderr
    assert "agent 3 killed by SIGKILL" in stderr
    assert time_of(fleet.log(2), "neighbour 3 has left") - killed_at < DROPPED_WITHIN
    report = fleet.report()
    assert [death["name"] for death in report["fleet"]["deaths"]] == ["agent 3"]
    killed = report["agents"][2]
    assert killed["daemons"] == 2
    assert killed["ticks_on_time"] < killed["ticks_expected"]
    check_ticks_without_gap(fleet.out)
    check_taken_back(fleet.out, killed_at.timestamp())
    assert fleet.nothing_left()


def time_of(log: str, words: str) -> datetime:
    line = next(line for line in log.splitlines() if words in line)
    return datetime.strptime(line[:23], "%Y-%m-%d %H:%M:%S,%f")


def check_ticks_without_gap(out: Path) -> None:
    for agent_id in (1, 2):
        _, entries = read_record(out / f"agent_{agent_id:03d}.estimates")
        assert (np.diff(entries["tick"]) == 1).all()


def check_taken_back(out: Path, killed_unix_s: float) -> None:
    """In the eyes of agent 2 the information of agent 3 grows old, and is fresh again soon after the restart."""
    header, entries = read_record(out / "agent_002.estimates")
    _, second_life = read_record(out / "agent_003.estimates")
    age, unix_s = entries["age_ticks"][:, 2], entries["t_s"] + header.epoch_unix_s
    assert age[(unix_s > killed_unix_s)].max() > 5
    back_s = second_life["t_s"][0] + header.epoch_unix_s
    fresh = unix_s[(unix_s > back_s) & (age <= 2)]
    assert len(fresh)
    assert fresh[0] - back_s < BACK_WITHIN_S


def test_ctrl_c_in_flight_ends_all_and_still_reports(start_fleet: Start) -> None:
    fleet = start_fleet("--duration", "600")
    until(fleet.flying, "flight")
    fleet.interrupt()
    code, stdout, stderr = fleet.finish()
    assert code == 0, stderr
    assert "report.html" in stdout
    report = fleet.report()
    assert report["fleet"]["interrupted"] is True
    assert report["fleet"]["deaths"] == []
    assert 0.0 < report["duration_s"] < 60.0
    assert fleet.nothing_left()


def test_ctrl_c_before_the_flight_leaves_nothing_behind(start_fleet: Start) -> None:
    fleet = start_fleet("--duration", "600")
    until(lambda: (fleet.out / "agent_001.log").exists(), "the first daemon")
    fleet.interrupt()
    code, _, stderr = fleet.finish()
    assert code == 130, stderr
    assert not (fleet.out / "report.json").exists()
    assert "Traceback" not in stderr
    assert fleet.nothing_left()
