"""A live fleet from start to report, with a daemon killed on the way, and interrupted."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.log.estimate_log import read_entries
from fleetloc.report.fleet_results import load_results
from fleetloc.run import run_files
from fleetloc.run.lockstep_run import fly_in_lockstep
from tests.support.fleet_process import ROOT, FleetProcess, until
from tests.support.informed import informed, settled
from tests.support.machine import Witness, check_on_time, witnessed

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
Start = Callable[..., FleetProcess]
DROPPED_WITHIN_S, BACK_WITHIN_S = 2.0, 10.0
TAKEN_BACK_TICKS, MIN_INFORMED = 60, 10


def test_a_live_run_is_on_time_consistent_and_equal_to_the_lockstep_run(start_fleet: Start, tmp_path: Path) -> None:
    with witnessed(tmp_path) as witness:
        fleet = start_fleet("--duration", "20", "--seed", "1", "--json", str(tmp_path / "figures.json"))
        code, stdout, stderr = fleet.finish()
    assert code == 0, stderr
    assert str(fleet.out / "report.html") in stdout
    assert fleet.nothing_left()
    config, report = load_config(fleet.out / "fleet.toml"), fleet.report()
    results, behind = load_results(config, fleet.out), Witness(witness)
    in_time = behind.sound(results.start_unix_s + results.tracks[0].time_s, results.period_s).mean()
    assert (tmp_path / "figures.json").read_bytes() == (fleet.out / "report.json").read_bytes()
    assert report["duration_s"] == pytest.approx(20.0, abs=0.1)
    assert report["seed"] == 1
    assert report["fleet"]["deaths"] == []
    for agent in report["agents"]:
        assert agent["ticks_expected"] == pytest.approx(200, abs=1)
        assert 0.3 < agent["anees_after_10s"] < 3.0
        assert 0.0 < agent["tick_time_p50_s"] <= agent["tick_time_p99_s"]
        assert agent["cpu_fraction"] > 0.0
        assert agent["rss_mb"] > 0.0
        assert agent["packets"]["received"] > 300
        assert agent["packets"]["rejected"] == {}
        assert agent["sensors"]["imu"]["used"] > 1500 * in_time  # those that come too late are not
        assert agent["sensors"]["gps"]["used"] > 150 * in_time
        assert agent["sensors"]["range"]["used"] > 150 * in_time
    check_page((fleet.out / "report.html").read_text())
    check_on_time(results, behind)
    again = tmp_path / "again"
    again.mkdir()
    fly_in_lockstep(config, again)
    check_accuracy(config, fleet.out, again)


def check_accuracy(config: FleetConfig, live: Path, lockstep: Path) -> None:
    """An agent that had in time what it has in virtual time errs as it does there, tick by tick of the same flight.

    On a busy machine some packets are late; the ticks that this touched are left out.
    """
    for agent_id in config.ids:
        flown, expected = (settled(config, folder, agent_id) for folder in (live, lockstep))
        (usual,), counts = np.unique(expected.age_ticks, axis=0, return_counts=True)
        assert counts.sum() >= 90
        ticks = [np.round(each.time_s / config.fleet.period_s).astype(int) for each in (flown, expected)]
        _, mine, theirs = np.intersect1d(*ticks, return_indices=True)
        had_all = informed(flown.age_ticks, usual, config.estimator.window)[mine]
        assert had_all.sum() >= MIN_INFORMED
        rmse_m, expected_m = (
            float(np.sqrt(np.mean(error_m[had_all] ** 2)))
            for error_m in (flown.error_m[mine], expected.error_m[theirs])
        )
        assert rmse_m == pytest.approx(expected_m, rel=0.05)


def check_page(page: str) -> None:
    """Plots are in it, and nothing has to be fetched."""
    assert page.count("<svg") == 5
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!#)""", page)
    assert "url(http" not in page


def test_a_killed_daemon_is_dropped_and_taken_back(start_fleet: Start, tmp_path: Path) -> None:
    fleet = start_fleet("--duration", "600")
    until(fleet.flying, "flight")
    until(lambda: "agent 2: ok" in fleet.log(2), "agent 2 is aligned")
    with witnessed(tmp_path) as witness:
        pid, killed_at = fleet.pid_of(3), datetime.now()
        os.kill(pid, signal.SIGKILL)
        until(lambda: "neighbour 3 has left" in fleet.log(2), "agent 2 notices")
        restarted = subprocess.Popen(
            [sys.executable, "-m", "fleetloc", "agent", str(fleet.out / "fleet.toml"), "--id", "3"],
            cwd=ROOT, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        try:
            until(lambda: entries_of_second_life(fleet.out) >= TAKEN_BACK_TICKS, "the restarted agent estimates")
            fleet.interrupt()
            code, _, stderr = fleet.finish()
        finally:
            restarted.terminate()
            restarted.wait()
    assert code == 0, stderr
    behind = Witness(witness)
    assert "agent 3 killed by SIGKILL" in stderr
    dropped_s = time_of(fleet.log(2), "neighbour 3 has left").timestamp() - killed_at.timestamp()
    late_s = behind.lost_s(killed_at.timestamp(), killed_at.timestamp() + dropped_s)
    assert 0.0 < dropped_s < DROPPED_WITHIN_S + late_s
    report = fleet.report()
    assert [death["name"] for death in report["fleet"]["deaths"]] == ["agent 3"]
    killed = report["agents"][2]
    assert killed["daemons"] == 2
    assert killed["ticks_on_time"] < killed["ticks_expected"]
    check_ticks_without_gap(fleet.out)
    check_taken_back(fleet.out, killed_at.timestamp(), behind)
    assert fleet.nothing_left()


def entries_of_second_life(out: Path) -> int:
    """How many estimates the restarted agent 3 has on the disk."""
    lives = run_files.records(out, 3)
    return len(read_entries(lives[-1])[1]) if len(lives) == 2 else 0


def time_of(log: str, words: str) -> datetime:
    line = next(line for line in log.splitlines() if words in line)
    return datetime.strptime(line[:23], "%Y-%m-%d %H:%M:%S,%f")


def check_ticks_without_gap(out: Path) -> None:
    for agent_id in (1, 2):
        _, entries = read_entries(out / f"agent_{agent_id:03d}.estimates")
        assert (np.diff(entries["tick"]) == 1).all()


def check_taken_back(out: Path, killed_unix_s: float, witness: Witness) -> None:
    """In the eyes of agent 2 the information of agent 3 grows old, and is fresh again soon after the restart."""
    header, entries = read_entries(out / "agent_002.estimates")
    _, second_life = read_entries(out / "agent_003.estimates")
    age, unix_s = entries["age_ticks"][:, 2], entries["t_s"] + header.epoch_unix_s
    assert age[(unix_s > killed_unix_s)].max() > 5
    back_s = second_life["t_s"][0] + header.epoch_unix_s
    fresh_s = unix_s[(unix_s > back_s) & (age <= 2)]
    assert len(fresh_s)
    assert fresh_s[0] - back_s < BACK_WITHIN_S + witness.lost_s(back_s, fresh_s[0])


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
    assert 0.0 < report["duration_s"] < 600.0
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
