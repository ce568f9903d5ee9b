"""The live table: what is shown of a drone that is well, silent, or dead; errors against the truth of the instant."""

from __future__ import annotations

import io
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from estimators.model.layout import position
from fleetloc.run import live_table
from fleetloc.run.fleet_observer import RunObserver
from fleetloc.run.live_truth import LiveTruth, TruePlaces, TruthWriter
from sim_bridge.world.scenario_config import scenario_from_config
from sim_bridge.world.simulation import Simulation
from transport.messages.estimate_body import FleetEstimate
from transport.messages.report_body import Diagnostics

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
NOW_S = 500.0
TICK = 1000


@pytest.fixture
def config() -> FleetConfig:
    return load_config(LINE3)


def truth_moving_north(config: FleetConfig) -> LiveTruth:
    """Every drone at (10 t, 0, -5), t seconds after `TICK`."""
    truth = LiveTruth()
    start_s = config.fleet.epoch_unix_s + TICK * config.fleet.period_s
    for step in range(-5, 6):
        place = (10.0 * 0.1 * step, 0.0, -5.0)
        assert truth.on_line(msgspec.json.encode(TruePlaces(start_s + 0.1 * step, (place,) * 3)))
    return truth


def estimate(north_m: float, sigma_m: float = 0.1) -> FleetEstimate:
    mean = np.zeros(18)
    mean[position(1)] = (north_m, 0.0, -5.0)
    covariance = np.diag([sigma_m**2 / 3] * 3 + [0.01] * 3)
    return FleetEstimate(TICK, 0, (1, 2, 3), mean, np.full(18, 0.01), (0, 0, 0), covariance)


def diagnostics(ticks: int = 10, state: str = "ok", reasons: tuple[str, ...] = ()) -> Diagnostics:
    counters = {"ticks": ticks, "packets received": 40, "packets lost": 3, "rejected stale": 2, "rejected replay": 1}
    gauges = {"gps_fix_type": 3.0, "gps_age_s": 0.08, "tick_time_p50_s": 0.002, "tick_time_p99_s": 0.0105}
    neighbours = {"1": {"heard_age_s": 0.1}, "3": {"heard_age_s": 30.0}}
    return Diagnostics(2, state, reasons, counters, gauges, neighbours)


def row_of(config: FleetConfig, observer: RunObserver, truth: LiveTruth, **ended: str) -> live_table.Row:
    dead = {int(name.removeprefix("agent_")): why for name, why in ended.items()}
    return live_table.rows(config, observer, truth, dead, NOW_S)[1]


def test_a_drone_that_is_well(config: FleetConfig) -> None:
    observer = RunObserver(config, Path(), lambda: None)
    observed = observer.agents[2]
    observed.estimate, observed.estimate_s = estimate(0.25), NOW_S - 0.05
    observed.on_diagnostics(diagnostics())
    row = row_of(config, observer, truth_moving_north(config))
    assert (row.status, row.error, row.sigma) == ("ok", "0.25", "0.10")
    assert (row.gps, row.neighbours, row.tick, row.packets) == ("3-D 0.1 s", "1 (0.1)", "2.0/10.5", "40/3/3")


def test_silence_death_and_start_are_told_apart(config: FleetConfig) -> None:
    observer, truth = RunObserver(config, Path(), lambda: None), truth_moving_north(config)
    assert row_of(config, observer, truth).status == "starting"
    observed = observer.agents[2]
    observed.estimate, observed.estimate_s = estimate(0.0), NOW_S - 5.0
    silent = row_of(config, observer, truth)
    assert (silent.status, silent.error) == ("silent", "")
    assert row_of(config, observer, truth, agent_2="killed by SIGKILL").status == "killed by SIGKILL"
    # GIVEN that somebody has restarted it, THEN its new life is shown
    observed.estimate_s = NOW_S
    observed.on_diagnostics(diagnostics(state="degraded", reasons=("no GPS", "not heard: 3")))
    row = row_of(config, observer, truth, agent_2="killed by SIGKILL")
    assert row.status == "degraded: no GPS; not heard: 3"


def test_an_estimate_that_knows_nothing_has_no_error(config: FleetConfig) -> None:
    observer = RunObserver(config, Path(), lambda: None)
    observer.agents[2].estimate, observer.agents[2].estimate_s = estimate(0.0, sigma_m=1e4), NOW_S
    row = row_of(config, observer, truth_moving_north(config))
    assert (row.error, row.sigma) == ("", "unknown")


def test_counters_that_go_back_begin_another_life(config: FleetConfig) -> None:
    observed = RunObserver(config, Path(), lambda: None).agents[2]
    for ticks in (10, 20, 3, 12):
        observed.on_diagnostics(diagnostics(ticks))
    assert [life.counters["ticks"] for life in observed.ended_lives] == [20]
    assert observed.diagnostics is not None
    assert observed.diagnostics.counters["ticks"] == 12


def test_table_and_lines_hold_the_same(config: FleetConfig) -> None:
    observer = RunObserver(config, Path(), lambda: None)
    observer.agents[2].estimate, observer.agents[2].estimate_s = estimate(0.25), NOW_S
    observer.agents[2].on_diagnostics(diagnostics())
    picture = live_table.rows(config, observer, truth_moving_north(config), {}, NOW_S)
    terminal = Console(file=io.StringIO(), width=160)
    terminal.print(live_table.table("line3", picture))
    assert isinstance(terminal.file, io.StringIO)
    for text in (terminal.file.getvalue(), "\n".join(live_table.lines("line3", picture))):
        for cell in ("0.25", "3-D 0.1 s", "1 (0.1)", "2.0/10.5", "40/3/3", "starting"):
            assert cell in text


def test_the_truth_is_interpolated_and_not_extrapolated(config: FleetConfig) -> None:
    truth = truth_moving_north(config)
    start_s = config.fleet.epoch_unix_s + TICK * config.fleet.period_s
    assert truth.error_m(0, start_s + 0.05, (0.5, 0.0, -5.0)) == pytest.approx(0.0, abs=1e-5)
    assert truth.error_m(0, start_s + 0.05, (0.5, 3.0, -1.0)) == pytest.approx(5.0, abs=1e-5)
    assert truth.error_m(0, start_s + 0.6, (0.0, 0.0, 0.0)) is None
    assert not truth.on_line(b"flown 3 s\n")


def test_the_simulator_writes_what_the_picture_reads(
    config: FleetConfig, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    simulation = Simulation(scenario_from_config(config), 100.0, config.fleet.epoch_unix_s)
    writer, truth = TruthWriter(), LiveTruth()
    for step in range(1, 201):
        simulation.advance(100.0 + 0.005 * step)
        writer(simulation)
    lines = capfdbinary.readouterr().out.splitlines()
    assert len(lines) == pytest.approx(10, abs=1)
    assert all(truth.on_line(line) for line in lines)
    position_m = simulation.truth().at(config.fleet.epoch_unix_s + 100.5)[2, :3]
    error_m = truth.error_m(2, config.fleet.epoch_unix_s + 100.5, tuple(position_m))
    assert error_m == pytest.approx(0.0, abs=0.01)
