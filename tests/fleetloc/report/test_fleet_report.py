"""The report of a run: figures that follow from the files, and a page that needs nothing else."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.config.reading import load_config
from agent.log.estimate_log import EstimateLogHeader, EstimateLogWriter
from agent.outputs import EstimateReady
from estimators.estimator import Estimate, SolverReport, Status
from fleetloc import cli
from fleetloc.report.fleet_report import report_figures, write_report
from fleetloc.report.fleet_results import load_results, unbroken
from fleetloc.run import run_files
from fleetloc.run.fleet_run import Death, RunOutcome, Use
from sim_bridge.world.truth import Truth
from transport.messages.report_body import Diagnostics

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
PERIOD_S = 0.1
FIRST_TICK = 5000
SECONDS = 20
TICKS = round(SECONDS / PERIOD_S)
OFFSET_M = np.array((0.3, 0.0, -0.4))
SIGMA_M = 0.5
AGENTS = (1, 2, 3)


def make_run(directory: Path, north_mps: float = 0.0) -> Any:
    """Three drones; each knows itself to be off by half a metre, with 0.5 m of sigma per state.

    They are at rest, or fly north. Agent 1 has no estimate in its first 10 ticks, 20 late ticks and a restart
    without ticks for a second; agent 3 left no record at all.
    """
    config = load_config(LINE3)
    header = {"fleet": "line3", "agents": AGENTS, "period_s": PERIOD_S, "epoch_unix_s": config.fleet.epoch_unix_s}
    start_s = config.fleet.epoch_unix_s + FIRST_TICK * PERIOD_S
    times = start_s + np.arange(0.0, SECONDS + 0.01, 0.02)
    places = np.broadcast_to(np.arange(9.0).reshape(3, 3), (len(times), 3, 3)).copy()
    places[:, :, 0] += north_mps * (times - start_s)[:, None]
    Truth(times, AGENTS, places, np.zeros((len(times), 3, 3)), np.zeros((0, 2), int), np.zeros(0)).save(
        directory / run_files.TRUTH
    )
    at_start = np.zeros(18)
    for slot in range(3):
        at_start[6 * slot : 6 * slot + 3] = np.arange(9.0).reshape(3, 3)[slot] + OFFSET_M
    lives = {1: [range(100), range(110, TICKS + 5)], 2: [range(-3, TICKS + 5)]}
    for agent_id, parts in lives.items():
        for part in parts:
            run_files.keep_earlier_record(directory, agent_id)
            path = run_files.record_path(directory, agent_id)
            recorder = EstimateLogWriter(path, EstimateLogHeader(agent=agent_id, **header), 10**8)
            for k in part:
                tick = FIRST_TICK + k
                mean = at_start.copy()
                mean[[0, 6, 12]] += north_mps * k * PERIOD_S
                blind = agent_id == 1 and k < 10
                status = Status.NO_DATA if blind else Status.OK
                estimate = Estimate(
                    tick, mean, SIGMA_M**2 * np.eye(18), status, np.zeros(3, np.int64), SolverReport()
                )
                latency_s = 1.5 * PERIOD_S if agent_id == 1 and 20 <= k < 40 else 0.2 * PERIOD_S
                t_s = tick * PERIOD_S
                recorder.write(EstimateReady(estimate, t_s, t_s, True), t_s + PERIOD_S + latency_s, 0.002)
            recorder.close()
    return config


def outcome() -> RunOutcome:
    life = {"packets sent": 100, "packets received": 50, "measurements: late": 2, "information: late": 3}
    life |= {"rejected stale": 1, "gps: samples": 40, "gps: wrong time": 4, "skipped gps: no fix": 6}
    life |= {"gps: received": 46, "gps: used": 34, "gps: late": 2}
    lives = {1: [Diagnostics(1, "ok", (), life, {"cpu_fraction": 0.5}), Diagnostics(1, "ok", (), life)]}
    use = {1: Use(1.0, 3.0, 20.0, 210.0)}
    return RunOutcome(wall_s=21.0, deaths=[Death("agent 1", 10.0, "killed by SIGKILL: <b>")], use=use, lives=lives)


@pytest.fixture
def figures(tmp_path: Path) -> dict[str, Any]:
    config = make_run(tmp_path)
    return report_figures(config, load_results(config, tmp_path), tmp_path, outcome(), "live")


def test_ticks_are_counted_against_what_the_flight_demands(figures: dict[str, Any]) -> None:
    restarted, well, absent = figures["agents"]
    assert [agent["ticks_expected"] for agent in figures["agents"]] == [TICKS] * 3
    assert restarted["ticks_on_time"] == TICKS - 20 - 10
    assert restarted["ticks_without_estimate"] == 10 + 10
    assert restarted["availability"] == pytest.approx((TICKS - 40) / TICKS)
    assert restarted["availability_after_10s"] == pytest.approx(0.9)
    assert (well["availability"], absent["availability"]) == (1.0, 0.0)
    assert figures["fleet"]["availability"] == pytest.approx((2 * TICKS - 40) / (3 * TICKS))
    assert restarted["daemons"] == 2
    assert well["ticks_on_time"] == TICKS
    assert (absent["ticks_on_time"], absent["daemons"], absent["position_rmse_m"]) == (0, 0, None)
    assert figures["fleet"]["ticks_on_time_fraction"] == pytest.approx((2 * TICKS - 30) / (3 * TICKS))


def test_errors_are_those_of_the_truth_at_the_tick(figures: dict[str, Any]) -> None:
    for agent in figures["agents"][:2]:
        for key in ("position_rmse_m", "position_rmse_after_10s_m"):
            assert agent[key] == pytest.approx(0.5)
        assert agent["norm_full_rms"] == pytest.approx(np.sqrt(3 * 0.25))
        assert agent["anees"] == pytest.approx(3 * 0.25 / SIGMA_M**2 / 18)
        assert agent["tick_time_p50_s"] == pytest.approx(0.002)
    assert figures["fleet"]["position_rmse_m"] == pytest.approx(0.5)
    assert figures["fleet"]["times_real_time"] == pytest.approx(SECONDS / 21.0)


def test_a_tick_without_an_estimate_in_time_counts_with_the_last_one_before_it(tmp_path: Path) -> None:
    # GIVEN drones that fly north at 1 m/s, WHEN estimates are late for 20 ticks and missing for 10
    config = make_run(tmp_path, north_mps=1.0)
    restarted, well, _ = report_figures(config, load_results(config, tmp_path), tmp_path, outcome(), "live")["agents"]
    # THEN what was had in the meantime falls behind by 0.1 m a tick
    behind_m = PERIOD_S * np.array([*range(1, 21), *range(1, 11), *[0] * (TICKS - 40)])
    squares = (OFFSET_M[0] - behind_m) ** 2 + OFFSET_M[1] ** 2 + OFFSET_M[2] ** 2
    assert restarted["position_rmse_m"] == pytest.approx(np.sqrt(squares.mean()))
    assert well["position_rmse_m"] == pytest.approx(0.5)


def test_counters_of_all_lives_are_added(figures: dict[str, Any]) -> None:
    agent = figures["agents"][0]
    assert agent["packets"] == {
        "sent": 200, "received": 100, "lost": 0, "injected_losses": 0, "late": 10, "rejected": {"stale": 2},
    }  # fmt: skip
    gps = agent["sensors"]["gps"]
    assert (gps["received"], gps["used"], gps["late"], gps["latency_s"]) == (2 * 46, 2 * 34, 2 * 2, None)
    assert gps["skipped_by_reason"] == {"no fix": 2 * 6, "wrong time": 2 * 4}
    assert gps["skipped"] == 2 * 10
    assert figures["fleet"]["packets"]["rejected"] == {"stale": 2}


def test_use_of_the_machine_is_the_one_measured_from_outside(figures: dict[str, Any]) -> None:
    assert figures["agents"][0]["cpu_fraction"] == pytest.approx(0.1)
    assert figures["agents"][0]["rss_mb"] == 210.0
    assert figures["agents"][1]["cpu_fraction"] is None


def test_the_summary_of_the_last_daemon_beats_what_was_heard_of_it(tmp_path: Path) -> None:
    config = make_run(tmp_path)
    summary: dict[str, Any] = {"state": "ok", "counters": {"packets sent": 7}, "gauges": {"rss_mb": 99.0}}
    summary["gauges"] |= {"gps_latency_s": 0.09, "gps_latency_sigma_s": 0.02}
    (tmp_path / "agent_001.json").write_bytes(msgspec.json.encode(summary))
    figures = report_figures(config, load_results(config, tmp_path), tmp_path, outcome(), "live")
    assert figures["agents"][0]["packets"]["sent"] == 107
    gps = figures["agents"][0]["sensors"]["gps"]
    assert (gps["latency_s"], gps["latency_sigma_s"]) == (0.09, 0.02)


def test_report_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = make_run(tmp_path)
    written = write_report(config, tmp_path, outcome(), tmp_path / "more" / "figures.json", "live")
    for path in (tmp_path / "report.json", tmp_path / "more" / "figures.json"):
        content = msgspec.json.decode(path.read_bytes())
        assert set(content) >= {"config", "seed", "duration_s", "agents", "fleet"}
        assert content["agents"][2]["position_rmse_m"] is None
    assert len(written["agents"]) == 3
    assert f"{TICKS}/{TICKS}" in capsys.readouterr().out
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") == page.count("</svg>") == 5
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!#)""", page)
    assert "agent 1 at 10.0 s: killed by SIGKILL: &lt;b&gt;" in page


def test_who_interrupts_a_run_does_not_wait_for_plots(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # GIVEN an interrupt so long ago that no plot may be begun
    config, interrupted = make_run(tmp_path), outcome()
    interrupted.interrupted, interrupted.plots_until_s = True, -math.inf
    # WHEN the report is written THEN it has all figures and the verdict, and says where the plots are to be had
    written = write_report(config, tmp_path, interrupted, None, "live")
    assert written["verdict"]["line"] in capsys.readouterr().out
    page = (tmp_path / "report.html").read_text()
    assert "<svg" not in page
    assert "fleetloc report" in page
    assert "ticks on time" in page


def test_lines_are_not_drawn_across_gaps() -> None:
    time_s = np.array((0.0, 0.1, 0.2, 1.0, 1.1))
    when, value = unbroken(time_s, np.arange(5.0), gap_s=0.15)
    assert np.isnan(when[3])
    assert np.isnan(value[3])
    assert np.delete(value, 3).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_lockstep_from_the_command_line_repeats(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        arguments = ["--lockstep", "--duration", "3", "--seed", "5", "--loss", "0.2", "--out", str(tmp_path / name)]
        assert cli.main(["fleet", str(LINE3), *arguments]) == 0
        assert f"report: {tmp_path / name / 'report.html'}" in capsys.readouterr().out
    for agent_id in AGENTS:
        records = [run_files.record_path(tmp_path / name, agent_id).read_bytes() for name in ("a", "b")]
        assert records[0] == records[1]
    report = msgspec.json.decode((tmp_path / "a" / "report.json").read_bytes())
    assert (report["mode"], report["seed"], report["config"]["transport"]["loss"]) == ("lockstep", 5, 0.2)
    assert all(agent["tick_time_p50_s"] is None for agent in report["agents"])
    assert all(agent["ticks_on_time"] == agent["ticks_expected"] == 30 for agent in report["agents"])
    assert report["fleet"]["times_real_time"] == pytest.approx(report["duration_s"] / report["fleet"]["wall_s"])
