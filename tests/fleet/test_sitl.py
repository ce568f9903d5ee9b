"""``fleetloc sitl`` as a user starts it: loopback simulators of both flavours, flown by the real MAVSDK client."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from fleetloc.cli import main
from fleetloc.report.fleet_results import load_results
from sim_bridge.sitl.mission import load_mission
from sim_bridge.sitl.setup import vehicle_links
from sim_bridge.world.truth import load_truth
from tests.support.fleet_process import PATIENCE_S, ROOT, processes_with
from tests.support.informed import informed, settled
from tests.support.loopback_sitl import FRAME, flavour_of
from tests.support.machine import Witness, check_on_time, witnessed
from tests.support.ports import bound, bound_in_a_row

IDS = (1, 2, 3)
SILENCE_S = 60.0
"""Simulators that get no computing time for a while have not gone."""
BOUND_M = 0.15
"""RMS of the own position; noise of GPS 0.15 m uniform per axis and fix, of ranges 0.1 m. Measured: 0.04 to 0.05."""
USUAL_TICKS, MIN_INFORMED = 1, 5
"""Own data are of the tick or the one before, and neighbours' too; all ticks are such on an idle machine."""
RANGE_HZ, GPS_HZ = 10.0, 10.0
MISSION = """
takeoff_m = 5.0
reached_m = 1.0
[[drones]]
agent = 1
waypoints_m = [[0.0, 0.0, -7.0], [5.0, 2.0, -8.0]]
hold_s = 0.5
[[drones]]
agent = 2
waypoints_m = [[4.0, 12.0, -6.0]]
hold_s = 0.5
[[drones]]
agent = 3
waypoints_m = [[12.0, 6.0, -9.0]]
hold_s = 0.5
"""


class Sitl:
    """Loopback simulators as a process, and the configuration that attaches to them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with ExitStack() as stack:
            udp = {agent: [stack.enter_context(bound(socket.SOCK_DGRAM)) for _ in range(2)] for agent in IDS}
            tcp = {agent: [stack.enter_context(bound(socket.SOCK_STREAM)) for _ in range(2)] for agent in IDS}
            client_port = stack.enter_context(bound_in_a_row(socket.SOCK_DGRAM, len(IDS)))
        self.simulators = {
            agent: f"udpin:127.0.0.1:{udp[agent][1]}" if agent % 2 else f"tcp:127.0.0.1:{tcp[agent][1]}"
            for agent in IDS
        }
        vehicles = ", ".join(f'{{ agent = {a}, simulator = "{link}" }}' for a, link in self.simulators.items())
        agents = "".join(
            f'[[agents]]\nid = {agent}\nautopilot = "{flavour_of(agent)}"\n'
            f'mavlink = "udpin:127.0.0.1:{udp[agent][0]}"\nlisten = ["tcp/127.0.0.1:{tcp[agent][0]}"]\n'
            for agent in IDS
        )
        self.config = folder / "fleet.toml"
        self.config.write_text(
            f'[fleet]\nname = "sitltest"\norigin = {{ lat_deg = {FRAME.lat_deg}, lon_deg = {FRAME.lon_deg}, '
            f"alt_m = {FRAME.alt_m} }}\n{agents}"
            "[sensors]\ngps_position_half_width_m = 0.15\ngps_speed_half_width_mps = 0.08\nuwb_bound_m = 0.1\n"
            "accel_sigma_mps2 = 0.0577\nimu_latency_s = 0.0\ngps_latency_s = 0.0\n"
            '[security]\nmode = "unsigned"\n'
            f"[sitl]\nclient_port = {client_port}\nvehicles = [{vehicles}]\n"
            f"appear_timeout_s = {PATIENCE_S}\nsilence_s = {SILENCE_S}\n"
        )
        (folder / "mission.toml").write_text(MISSION)
        self.out = folder / "run"
        self._simulators: list[subprocess.Popen[bytes]] = []

    def start_simulators(self) -> None:
        for agent, link in self.simulators.items():
            command = [sys.executable, "-m", "tests.support.loopback_sitl", str(agent), link]
            process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, start_new_session=True)
            self._simulators.append(process)

    def fly(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "fleetloc", "sitl", str(self.config), "--out", str(self.out), *arguments],
            cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
            start_new_session=True,
        )  # fmt: skip

    def report(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.out / "report.json").read_bytes())
        return content

    def close(self) -> None:
        for process in self._simulators:
            process.communicate(timeout=PATIENCE_S)  # it ends with its stdin
        for pid in processes_with(str(self.folder)):
            os.kill(pid, signal.SIGKILL)


@pytest.fixture
def sitl(tmp_path: Path) -> Iterator[Sitl]:
    fleet = Sitl(tmp_path)
    yield fleet
    fleet.close()


@pytest.mark.slow
@pytest.mark.realtime
def test_a_fleet_of_both_flavours_flies_a_mission_and_knows_where_it_is(sitl: Sitl) -> None:
    pytest.importorskip("mavsdk", reason="the MAVSDK client is not installed: no mission can be flown")
    sitl.start_simulators()
    # WHEN the fleet flies its mission, drone 2's daemon without GPS for a while
    with witnessed(sitl.folder) as witness:
        run = sitl.fly("--mission", str(sitl.folder / "mission.toml"), "--drop-gps", "2:8,10")
    assert run.returncode == 0, run.stderr
    for words in ("drone 1: armed", "drone 2: at height", "drone 3: waypoint 1 of 1", "drone 2: landed"):
        assert words in run.stderr
    # THEN every drone knows its place once its first fixes are in
    report = sitl.report()
    assert report["mode"] == "sitl"
    assert report["fleet"]["deaths"] == []
    config = load_config(sitl.out / "fleet.toml")
    for agent in report["agents"]:
        check_place(config, sitl.out, agent)
    check_on_time(load_results(config, sitl.out), Witness(witness), 0.9)
    check_bridge(report["fleet"]["simulator"], [agent["sensors"]["range"]["used"] for agent in report["agents"]])
    # AND the truth shows the mission: up, along the way, down again
    truth = load_truth(sitl.out / "truth.npz")
    for slot, points in enumerate(([(5.0, 2.0, -8.0)], [(4.0, 12.0, -6.0)], [(12.0, 6.0, -9.0)])):
        for point in points:
            assert np.linalg.norm(truth.position_m[:, slot] - point, axis=1).min() < 1.2
        assert abs(truth.position_m[-1, slot, 2]) < 0.1
    # AND no process of the run is left
    assert not processes_with(str(sitl.out))


def check_place(config: FleetConfig, out: Path, agent: dict[str, Any]) -> None:
    """Where it had its data in time it is right, and at every time as wrong as it says."""
    _, ages, error_m = settled(config, out, agent["id"])
    had_all = informed(ages, np.full(len(config.ids), USUAL_TICKS), config.estimator.window)
    assert had_all.sum() >= MIN_INFORMED
    assert np.sqrt(np.mean(error_m[had_all] ** 2)) < BOUND_M
    assert 0.3 < agent["anees_after_10s"] < 4.0


def check_bridge(bridge: dict[str, Any], ranges_used: list[int]) -> None:
    """It ranges whenever the simulators' truth is there in time, and holds back GPS from one drone, for 2 s."""
    late_s, frames = bridge["truth_missing_s"], bridge["ranges_published"]
    assert frames >= 0.9 * len(IDS) * RANGE_HZ * (bridge["duration_s"] - late_s)
    assert min(ranges_used) >= 0.5 * frames / len(IDS) * (len(IDS) - 1)
    vehicles = bridge["vehicles"]
    assert [vehicle["autopilot"] for vehicle in vehicles] == ["px4", "ardupilot", "px4"]
    assert vehicles[1]["gps_frames_withheld"] > 0
    assert vehicles[1]["gps_frames_withheld"] == pytest.approx(20, abs=3 + GPS_HZ * late_s)
    assert [vehicles[slot]["gps_frames_withheld"] for slot in (0, 2)] == [0, 0]


def test_absent_simulators_end_in_one_line_with_their_addresses(sitl: Sitl) -> None:
    run = sitl.fly("--set", "sitl.appear_timeout_s=0.5", "--duration", "5")
    assert run.returncode == 3
    last = run.stderr.strip().splitlines()[-1]
    assert last.startswith("fleetloc: error: drone 1: simulator at udpin:127.0.0.1:")
    assert "nobody there" in last
    assert f"waiting for drone 2: simulator at {sitl.simulators[2].replace('tcp:', 'tcpout:')}" in run.stderr
    assert "Traceback" not in run.stderr
    assert not processes_with(str(sitl.out))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--drop-gps", "7"), "--drop-gps: expected one of the ids 1, 2, 3, found 7"),
        (("--drop-gps", "2:-5,"), "--duration for times from the end"),
        (("--mission", "nowhere.toml"), "nowhere.toml: expected a readable mission"),
        (("--set", "mavlink.component_id=194"), "component_id"),
    ],
)
def test_bad_input_is_one_line_and_starts_nothing(
    sitl: Sitl, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: str
) -> None:
    code = main(["sitl", str(sitl.config), "--out", str(sitl.out), *arguments])
    stderr = capsys.readouterr().err
    assert code == 2
    assert words in stderr
    assert "Traceback" not in stderr
    assert not sitl.out.exists()


def test_the_mission_beside_the_sample_configuration_can_be_flown() -> None:
    config = load_config(ROOT / "configs" / "sitl3.toml")
    assert [str(link.simulator) for link in vehicle_links(config).values()] == [
        f"tcpout:127.0.0.1:{port}" for port in (5760, 5770, 5780)
    ]
    mission = load_mission(ROOT / "configs" / "mission3.toml", config)
    assert [drone.agent for drone in mission.drones] == list(config.ids)
