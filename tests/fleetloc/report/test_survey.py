"""Fixed targets of a flight become anchors of the next one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.log.estimate_log import EstimateLogWriter, header_of
from agent.outputs import EstimateReady
from estimators.estimator import Estimate, Status
from fleetloc.cli import main
from fleetloc.run import run_files
from transport.messages.estimate_body import MAX_AGE_TICKS

BEACON, MAST, ROVER = 201, 202, 203
BEACON_M, MAST_M = (12.3456, -7.0, 0.5), (-30.0, 4.0, -3.25)


FLEET = """
fleet = { name = "survey", origin = { lat_deg = 41.0, lon_deg = 14.0, alt_m = 20.0 } }
agents = [{ id = 1, mavlink = "udpin:127.0.0.1:24661" }, { id = 2, mavlink = "udpin:127.0.0.1:24662" }]
security = { mode = "unsigned" }
"""
FIXED = """
[[targets]]
id = 201
name = "beacon"
motion = "fixed"

[[targets]]
id = 202
motion = "fixed"
"""
MOVING = """
[[targets]]
id = 203
"""


def record(config: FleetConfig, folder: Path, agent_id: int, sigma_m: dict[int, float], off_m: float) -> None:
    """Two estimates of a drone that knows targets so well, the first of them poor; who is not named is absent."""
    bodies = config.bodies
    mean, variance, age = np.zeros((len(bodies), 6)), np.full(6 * len(bodies), 1e8), [0, 0] + [MAX_AGE_TICKS] * 3
    places = {BEACON: BEACON_M, MAST: MAST_M, ROVER: (1.0, 1.0, 0.0)}
    for target, sigma in sigma_m.items():
        slot = bodies.index(target)
        mean[slot, :3] = np.array(places[target]) + off_m
        variance[6 * slot : 6 * slot + 6], age[slot] = sigma**2 / 3.0, 4
    writer = EstimateLogWriter(run_files.record_path(folder, agent_id), header_of(config, agent_id), 10**6)
    for tick, shift in ((7, 5.0), (8, 0.0)):
        covariance = np.diag(variance)
        estimate = Estimate(tick, mean.ravel() + shift, covariance, Status.OK, np.array(age))
        writer.write(EstimateReady(estimate, 0.1 * tick, 0.1 * tick + 0.1, True), 0.1 * tick + 0.1, 0.001)
    writer.close()


@pytest.fixture
def config_file(tmp_path: Path) -> Path:
    path = tmp_path / "fleet.toml"
    path.write_text(FLEET + FIXED + MOVING)
    return path


def run(*arguments: object) -> int:
    return main(["survey", *map(str, arguments)])


def test_the_last_estimate_of_who_knows_each_best_becomes_an_anchor(
    tmp_path: Path, config_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # GIVEN two drones, of which one knows the beacon better, and one alone has found the mast
    config = load_config(config_file)
    record(config, tmp_path, 1, {BEACON: 0.05, ROVER: 0.01}, off_m=0.0)
    record(config, tmp_path, 2, {BEACON: 0.2, MAST: 0.1}, off_m=0.5)
    # WHEN the flight is surveyed THEN the next configuration has both where they were found, and the rover is none
    assert run(config_file, tmp_path, "--out", tmp_path / "anchors.toml") == 0
    assert "2 anchors" in capsys.readouterr().out
    (tmp_path / "next.toml").write_text(FLEET + (tmp_path / "anchors.toml").read_text())
    anchors = load_config(tmp_path / "next.toml").anchors
    assert [anchor.id for anchor in anchors] == [BEACON, MAST]
    np.testing.assert_allclose(anchors[0].position_m, BEACON_M, atol=0.0006)
    np.testing.assert_allclose(anchors[1].position_m, np.array(MAST_M) + 0.5, atol=0.0006)


def test_what_is_not_known_well_enough_is_left_out_and_said(
    tmp_path: Path, config_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(load_config(config_file), tmp_path, 1, {BEACON: 0.5}, off_m=0.0)
    assert run(config_file, tmp_path) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert "target 201: known to 0.50 m, --within 0.3 m, left out" in said.err
    assert "target 202: not found, left out" in said.err
    assert "agent_002" in said.err  # of which there is no record
    assert run(config_file, tmp_path, "--within", "0.6") == 1
    assert "id = 201" in capsys.readouterr().out


def test_a_fleet_without_fixed_targets_is_told_so(
    tmp_path: Path, config_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config_file.write_text(FLEET + MOVING)
    assert run(config_file, tmp_path) == 2
    assert 'expected at least one with motion = "fixed"' in capsys.readouterr().err
