"""What `fleetloc doctor` says of set-ups, right and wrong."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path
from typing import Any

import pytest

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.inputs import Served
from agent.outputs import ToAutopilot
from agent.sensing.frames import FleetFrame
from fleetloc.cli import main
from fleetloc.doctor.examination import Examined, Mark, of_autopilot, of_computer
from fleetloc.doctor.listening import Listened, listen
from sim_bridge.world.noise import FlavourName
from sim_bridge.world.scenario import Scenario, Vehicle
from sim_bridge.world.simulation import Simulation
from tests.support.onboard import onboard_of
from tests.support.ports import free_port

START_S = 1000.0


def fleet(**tables: Any) -> FleetConfig:
    """One drone."""
    document = {
        "fleet": {"name": "one", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}},
        "agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:14561", "system_id": 1}],
        "security": {"mode": "unsigned"},
    }
    return config_from(document | tables, "test")


def heard(
    config: FleetConfig,
    flavour: FlavourName,
    seconds: float = 12.0,
    *,
    system_id: int = 1,
    garble: bool = False,
    lacking: bytes | None = None,
) -> Listened:
    """A simulated autopilot listened to in virtual time; ``lacking``: a parameter that its firmware does not have."""
    vehicle = Vehicle(1, flavour, system_id, start_m=(0.0, 0.0, -5.0), start_velocity_mps=(0.0, 0.0, 0.0))
    simulation = Simulation(Scenario(vehicles=(vehicle,), frame=FleetFrame.of(config)), START_S)
    onboard = onboard_of(config, linked=True, fleet_offset_s=0.0)
    read = 0

    def take(frames: list[bytes], now_s: float) -> None:
        nonlocal read
        for frame in frames:
            if lacking is not None and lacking in frame:
                continue
            data = bytes(each ^ 0x5A for each in frame) if garble else frame
            read += len(data)
            onboard.on_mavlink(data, now_s)

    next_s = START_S
    while (now_s := simulation.next_step_s()) < START_S + seconds:
        take([frame for _, frame in simulation.advance(now_s).frames], now_s)
        if now_s >= next_s:
            next_s += 0.05
            for output in onboard.take(Served(now_s)):
                if isinstance(output, ToAutopilot):
                    for frame in output.frames:
                        take(simulation.receive(1, frame, now_s), now_s)
    return Listened(onboard, read)


def by_name(lines: list[Examined]) -> dict[str, Examined]:
    return {line.what: line for line in lines}


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_of_a_drone_that_is_set_up_right_everything_is_good(flavour: FlavourName) -> None:
    config = fleet(feedback={"kind": "odometry"})
    lines = of_autopilot(config, 1, heard(config, flavour))

    assert [str(line) for line in lines if line.mark is not Mark.GOOD] == []
    named = by_name(lines)
    assert {"TIMESYNC", "GPS", "ATTITUDE_QUATERNION", "its origin"} <= named.keys()
    assert ("EKF2_EV_CTRL" if flavour == "px4" else "VISO_TYPE") in named


def test_without_feedback_no_parameter_is_asked_for() -> None:
    config = fleet()
    lines = of_autopilot(config, 1, heard(config, "px4", 8.0))

    assert by_name(lines)["feedback"].found == "off: the autopilot is given nothing"


def test_a_parameter_that_is_wrong_is_told_with_what_to_do() -> None:
    config = fleet(feedback={"kind": "gps_input", "gps_id": 0})
    lines = by_name(of_autopilot(config, 1, heard(config, "ardupilot", 12.0)))
    assert str(lines["GPS1_TYPE"]).startswith("WRONG GPS1_TYPE: 1; set it to 14 (MAVLink)")

    config = fleet(feedback={"kind": "gps_input"})
    lines = by_name(of_autopilot(config, 1, heard(config, "ardupilot", 12.0, lacking=b"GPS2_TYPE")))
    assert str(lines["GPS2_TYPE"]).startswith("warn  GPS2_TYPE: not told; this firmware has none")
    wrong = by_name(of_autopilot(fleet(feedback={"kind": "gps_input"}), 1, heard(config, "px4", 3.0)))
    assert str(wrong["feedback.kind"]).startswith('WRONG feedback.kind: "gps_input" is not read by px4')


def test_another_system_id_a_wrong_baud_rate_and_silence_are_told_apart() -> None:
    config = fleet()
    serial = fleet(agents=[{"id": 1, "mavlink": "serial:/dev/ttyUSB0:921600", "system_id": 1}])

    [other] = of_autopilot(config, 1, heard(config, "px4", 3.0, system_id=9))
    [garbled] = of_autopilot(serial, 1, heard(config, "px4", 3.0, garble=True))
    [silent] = of_autopilot(config, 1, Listened(onboard_of(config, linked=True)))

    assert "none of system 1 (system 9, heartbeat: other system" in other.found
    assert (garbled.mark, "baud rate" in garbled.to_do) == (Mark.WRONG, True)
    assert silent.found == "nothing came"


def test_a_port_that_somebody_has_is_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        config = fleet(agents=[{"id": 1, "mavlink": f"udpin:127.0.0.1:{taken.getsockname()[1]}"}])
        [line] = of_autopilot(config, 1, asyncio.run(listen(config, 1, Path(), 0.1)))

    assert (line.mark, "is the daemon running?" in line.to_do) == (Mark.WRONG, True)


def test_the_disk_and_the_cache_are_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEETLOC_CACHE", str(tmp_path / "none"))
    lines = by_name(of_computer(fleet(record={"directory": str(tmp_path / "new" / "records")}), []))

    assert lines["disk"].found == f"room in {tmp_path}"
    assert "fleetloc warmup" in lines["cache"].to_do


def test_the_command_says_so_and_fails_where_something_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text(
        f"""
[fleet]
name = "one"
origin = {{ lat_deg = 47.0, lon_deg = 8.0, alt_m = 400.0 }}
[[agents]]
id = 1
mavlink = "udpin:127.0.0.1:{free_port()}"
[security]
mode = "unsigned"
"""
    )

    code = main(["doctor", str(file), "--id", "1", "--listen", "0.2"])

    printed = capsys.readouterr().out
    assert code == 1
    assert "ok    configuration: 1 drones" in printed
    assert "nothing came; is it on, wired" in printed
