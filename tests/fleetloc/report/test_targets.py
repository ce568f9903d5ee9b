"""A rover on the ground under four drones: located by all, and shown in report, live table and monitor."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.log.estimate_log import covariance_of, read_entries
from fleetloc.monitor import table as monitor_table
from fleetloc.monitor.picture import FleetPicture
from fleetloc.report.fleet_report import write_report
from fleetloc.report.fleet_results import load_results
from fleetloc.run import live_targets, run_files
from fleetloc.run.fleet_observer import RunObserver
from fleetloc.run.live_truth import LiveTruth, TruePlaces
from fleetloc.run.lockstep_run import fly_in_lockstep
from sim_bridge.world.truth import load_truth
from transport.messages.estimate_body import FleetEstimate
from transport.messages.report_body import Diagnostics

ROVER = 101
START_M, VELOCITY_MPS = (-10.0, -10.0, 0.0), (1.0, 0.8, 0.0)
SECONDS = 24.0
CENTERS_M = ((0, 0, -25), (30, 0, -30), (0, 30, -20), (30, 30, -35))


def config() -> FleetConfig:
    circle = {"kind": "circle", "radius_m": 20.0, "lap_s": 40.0}
    return config_from(
        {
            "fleet": {"name": "hunt", "period_s": 0.2, "origin": {"lat_deg": 41.0, "lon_deg": 14.0, "alt_m": 20.0}},
            "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{24560 + i}"} for i in (1, 2, 3, 4)],
            "targets": [{"id": ROVER, "name": "rover"}],
            "estimator": {"limits": {"target": {"ceiling_m": 3.0}}},
            "security": {"mode": "unsigned"},
            "sim": {
                "duration_s": SECONDS,
                "profile": "nom",
                "gps_hz": 5.0,
                "uwb_hz": 5.0,
                "paths": [
                    *(circle | {"agent": i, "center_m": list(c), "phase_rad": 1.5 * i}
                      for i, c in enumerate(CENTERS_M, 1)),
                    {"agent": ROVER, "kind": "line", "start_m": list(START_M), "velocity_mps": list(VELOCITY_MPS)},
                ],
            },
        },
        "test",
    )  # fmt: skip


@dataclass(frozen=True)
class Flown:
    config: FleetConfig
    folder: Path
    report: dict[str, Any]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder, fleet = tmp_path_factory.mktemp("hunt"), config()
    outcome = fly_in_lockstep(fleet, folder)
    outcome.wall_s = SECONDS
    return Flown(fleet, folder, write_report(fleet, folder, outcome, None, "lockstep"))


def test_the_truth_holds_the_target_behind_the_drones(flown: Flown) -> None:
    truth = load_truth(flown.folder / run_files.TRUTH)
    assert truth.agents == (1, 2, 3, 4, ROVER)
    since_s = truth.time_unix_s - truth.time_unix_s[0]
    expected = np.array(START_M) + since_s[:, None] * np.array(VELOCITY_MPS)
    np.testing.assert_allclose(truth.position_m[:, 4], expected, atol=1e-6)


def test_every_drone_finds_it_and_says_honestly_how_well(flown: Flown) -> None:
    rows = flown.report["targets"]
    assert [(row["id"], row["seen_by"]) for row in rows] == [(ROVER, i) for i in (1, 2, 3, 4)]
    for row in rows:
        assert row["below_5m_after_s"] <= 8.0
        assert row["availability"] >= 0.7
        assert row["position_rmse_settled_m"] <= 3.0  # the receivers themselves wander by more than a metre
        assert 0.1 <= row["anees_settled"] <= 3.0
        assert row["ticks_ok_beyond_5_sigma"] == 0
    page = (flown.folder / run_files.REPORT_HTML).read_text()
    assert "<h2>Targets</h2>" in page
    assert "101 rover" in page


def test_the_figures_of_the_drones_are_of_drones_alone(flown: Flown) -> None:
    results = load_results(flown.config, flown.folder)
    assert all(track.full_error.shape[1] == 24 for track in results.tracks)


def last_estimate(flown: Flown, agent_id: int) -> FleetEstimate:
    """As a drone sends it."""
    entry = read_entries(run_files.record_path(flown.folder, agent_id))[1][-3]
    whole = covariance_of(entry, 5)
    own = slice(6 * (agent_id - 1), 6 * agent_id)
    ages = tuple(entry["age_ticks"].tolist())
    bodies = flown.config.bodies
    return FleetEstimate(int(entry["tick"]), 0, bodies, entry["mean"], whole.diagonal(), ages, whole[own, own])


def test_the_live_table_has_it_with_its_error(flown: Flown) -> None:
    # GIVEN the estimates of two drones, and the truth of that instant
    observer, truth, now_s = RunObserver(flown.config, Path(), lambda: None), LiveTruth(), time.monotonic()
    assert [row.seen_by for row in live_targets.target_rows(flown.config, observer, truth, now_s)] == ["nobody"]
    kept = load_truth(flown.folder / run_files.TRUTH)
    for unix_s, places in zip(kept.time_unix_s, kept.position_m, strict=True):
        truth.on_line(live_line(float(unix_s), places))
    for agent_id in (1, 2):
        observer.agents[agent_id].estimate = last_estimate(flown, agent_id)
        observer.agents[agent_id].estimate_s = now_s
    # THEN one row says who knows it best, and how far off that is
    observer.agents[1].diagnostics = observer.agents[2].diagnostics = Diagnostics(1, "ok", targets={"101": "poor"})
    (row,) = live_targets.target_rows(flown.config, observer, truth, now_s)
    assert row.state == "poor"
    assert row.target == "101 rover"
    assert row.seen_by in ("1", "2")
    assert 0.0 < float(row.error) < 5.0
    terminal = Console(width=100, record=True)
    terminal.print(live_targets.table([row]))
    assert "rover" in terminal.export_text()
    assert f"error {row.error} m" in live_targets.lines([row])[0]


def live_line(unix_s: float, places: Any) -> bytes:
    return msgspec.json.encode(TruePlaces(unix_s, tuple(map(tuple, places.tolist()))))


def test_the_monitor_shows_it_with_its_ellipse_and_without_anybody_says_so(flown: Flown) -> None:
    picture = FleetPicture(flown.config)
    (target,) = picture.at(100.0, 1e9).targets
    assert target.seen_by is None
    estimate = last_estimate(flown, 2)
    picture.on_estimate(2, estimate, 100.0)
    picture.on_diagnostics(Diagnostics(2, "ok", targets={"101": "not observable"}), 100.0)
    shown = picture.at(100.1, 1e9)
    (target,) = shown.targets
    assert target.name == "rover"
    assert target.seen_by is not None
    assert target.seen_by.agent_id == 2
    np.testing.assert_allclose(target.seen_by.position_m, estimate.mean[24:27])
    assert target.ellipse is not None
    sigma_m = np.sqrt(estimate.variance[24:27])
    assert target.ellipse.major_m == pytest.approx(3 * max(sigma_m[:2]))
    assert target.ellipse.up_m == pytest.approx(3 * sigma_m[2])
    assert target.state == "not observable"
    (line,) = [line for line in monitor_table.lines(shown) if "target 101 rover" in line]
    assert line.endswith("by drone 2: not observable")
