"""A whole field fleet on loopback, as a user starts it: keys by the command, TLS, signed packets, signed MAVLink."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.log.estimate_log import read_entries
from agent.log.tlog import read_frames
from agent.mavlink.signing import SIGNED
from fleetloc import cli
from tests.security.conftest import PROFILES
from tests.support.fleet_process import FleetProcess, on_free_ports, with_overrides

AGREE_M = 1.0
"""Two agents' estimates of one drone: several times what either is wrong by, a tenth of what separates drones."""


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
        code, _, stderr = fleet.finish()
    finally:
        fleet.clean_up()
    # THEN every agent has an estimate of every tick, nothing was refused, and they agree on where everyone is
    assert code == 0, stderr
    for agent in fleet.report()["agents"]:
        assert agent["ticks_expected"] == 50
        assert agent["packets"]["rejected"] == {}
        assert agent["sensors"]["range"]["used"] > 30
    last = []
    for agent_id in (1, 2, 3):
        _, entries = read_entries(fleet.out / f"agent_{agent_id:03d}.estimates")
        assert (np.diff(entries["tick"]) == 1).all()
        assert len(entries) >= 50  # whether on time is for a machine that does nothing else
        last.append({int(entry["tick"]): entry["mean"] for entry in entries})
    tick = max(set.intersection(*(set(ticks) for ticks in last))) - 5  # all of them still fly
    for other in last[1:]:
        difference = (other[tick] - last[0][tick]).reshape(3, 6)[:, :3]
        assert np.abs(difference).max() < AGREE_M
    check_all_frames_are_signed(fleet.out)


def check_all_frames_are_signed(out: Path) -> None:
    """Both ways: the record holds what was received and what was sent."""
    with (out / "agent_001.tlog").open("rb") as tlog:
        frames = list(read_frames(tlog, 0))
    assert {frame[6] for frame in frames} >= {1, 197}  # the autopilot's component and ours
    assert all(frame[0] == 0xFD and frame[2] & SIGNED for frame in frames)
