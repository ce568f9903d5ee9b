"""A whole field fleet on loopback, as a user starts it: keys by the command, TLS, signed packets, signed MAVLink."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.config.reading import load_config
from agent.log.estimate_log import read_entries
from agent.log.tlog import read_frames
from agent.mavlink.signing import SIGNED
from fleetloc import cli
from fleetloc.report.fleet_results import load_results
from fleetloc.run import run_files
from tests.security.conftest import PROFILES
from tests.support.fleet_process import FleetProcess, on_free_ports, with_overrides
from tests.support.informed import informed
from tests.support.machine import Witness, witnessed

AGREE_M = 0.15
"""Two agents' estimates of one drone, of the same data: several times what either is wrong by."""
MIN_AGREED, WINDOW = 5, 6


@pytest.mark.slow
@pytest.mark.realtime
def test_a_field_fleet_of_three_flies_and_agrees(tmp_path: Path) -> None:
    # GIVEN the field profile as it is shipped, on free ports, with keys made by the command
    file = tmp_path / "field.toml"
    file.write_text((PROFILES / "field.toml").read_text())
    assert cli.main(["keys", "init", str(file)]) == 0
    ports = [override.replace("tcp/", "tls/") for override in on_free_ports(3)]
    # WHEN it flies for five seconds
    fleet = FleetProcess(tmp_path / "run", "--duration", "5", *with_overrides(ports), config=file)
    try:
        with witnessed(tmp_path) as witness:
            code, _, stderr = fleet.finish()
    finally:
        fleet.clean_up()
    # THEN every agent has an estimate of every tick, nothing was refused, and they agree on where everyone is
    assert code == 0, stderr
    results = load_results(load_config(fleet.out / run_files.CONFIG), fleet.out)
    in_time = Witness(witness).sound(results.start_unix_s + results.tracks[0].time_s, results.period_s).mean()
    for agent in fleet.report()["agents"]:
        assert agent["ticks_expected"] == 50
        assert agent["packets"]["rejected"] == {}
        assert agent["sensors"]["range"]["used"] > 30 * in_time  # those that come too late are not
    check_agreement(fleet.out)
    check_all_frames_are_signed(fleet.out)


def check_agreement(out: Path) -> None:
    """Every agent has every tick; of those for which all had everybody's data in time, they say the same."""
    told: list[dict[int, NDArray[np.float64]]] = []
    for agent_id in (1, 2, 3):
        _, entries = read_entries(run_files.record_path(out, agent_id))
        assert (np.diff(entries["tick"]) == 1).all()
        assert len(entries) >= 50  # whether on time is for a machine that does nothing else
        had_all = entries[informed(entries["age_ticks"], np.ones(3, np.uint16), WINDOW)]
        told.append({int(entry["tick"]): entry["mean"].reshape(3, 6)[:, :3] for entry in had_all})
    shared = set.intersection(*map(set, told))
    assert len(shared) >= MIN_AGREED
    for tick in shared:
        assert np.ptp([places_m[tick] for places_m in told], axis=0).max() < AGREE_M


def check_all_frames_are_signed(out: Path) -> None:
    """Both ways: the record holds what was received and what was sent."""
    with (out / "agent_001.tlog").open("rb") as tlog:
        frames = list(read_frames(tlog, 0))
    assert {frame[6] for frame in frames} >= {1, 197}  # the autopilot's component and ours
    assert all(frame[0] == 0xFD and frame[2] & SIGNED for frame in frames)
