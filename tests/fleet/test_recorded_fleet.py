"""The flight logs of a live fleet, repeated: what was estimated in flight comes out again."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil

from agent.log.estimate_log import covariance_of, read_entries
from agent.log.flight_format import CLOSED, CUT_OFF
from estimators.factory import make_estimator
from sim_bridge.replay.flight_log_replay import ReplayedTick, replay_flight_log
from tests.support.fleet_process import FleetProcess, until

pytestmark = pytest.mark.slow
TOLERANCE = 1e-9
AGENTS = (1, 2, 3)


def test_the_records_of_a_live_run_give_its_estimates_again(start_fleet: Callable[..., FleetProcess]) -> None:
    # GIVEN a live run in which one daemon is killed
    fleet = start_fleet("--duration", "6")
    until(fleet.flying, "the fleet in flight")
    until(lambda: size(fleet.out / "agent_003.mcap") > 60_000, "some of the record")
    os.kill(fleet.pid_of(3), signal.SIGKILL)
    code, _, stderr = fleet.finish()
    assert code == 0, stderr
    # WHEN each record is repeated
    made: dict[int, list[ReplayedTick]] = {agent_id: [] for agent_id in AGENTS}
    records = [fleet.out / f"agent_{agent_id:03d}.mcap" for agent_id in AGENTS]
    results = replay_flight_log(records, None, make_estimator, lambda agent_id, tick: made[agent_id].append(tick))
    # THEN the estimates are those of the flight, up to the end or to the last flush
    for result in results:
        assert result.equal
        assert max(result.max_mean_difference, result.max_sigma_difference) <= TOLERANCE
        assert result.compared > 10
        check_covariances(fleet.out / f"agent_{result.agent_id:03d}.estimates", made[result.agent_id])
    assert [result.ended for result in results[:2]] == [CLOSED] * 2
    assert results[2].ended.startswith(CUT_OFF)
    check_tlog(fleet.out / "agent_001.tlog")


def size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def check_covariances(path: Path, ticks: list[ReplayedTick]) -> None:
    """Against the daemon's other record, which has whole covariances."""
    header, entries = read_entries(path)
    live = {int(entry["tick"]): entry for entry in entries}
    compared = 0
    for tick in ticks:
        assert tick.ready is not None
        estimate = tick.ready.estimate
        if estimate.tick in live:
            entry = live[estimate.tick]
            assert entry["status"] == estimate.status
            assert np.abs(entry["mean"] - estimate.mean).max() <= TOLERANCE
            difference = np.abs(covariance_of(entry, len(header.agents)) - estimate.covariance)
            assert difference.max() <= TOLERANCE * max(1.0, np.abs(estimate.covariance).max())
            compared += 1
    assert compared > 10


def check_tlog(path: Path) -> None:
    """MAVLink's own reader finds whole frames of both sides in the log."""
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    kinds: dict[str, int] = {}
    while (message := log.recv_match()) is not None:
        kinds[message.get_type()] = kinds.get(message.get_type(), 0) + 1
    log.close()
    assert kinds["HIGHRES_IMU"] > 300
    assert kinds["GPS_RAW_INT"] > 30
    assert kinds["COMMAND_LONG"] >= 4  # what we sent
    assert "BAD_DATA" not in kinds
