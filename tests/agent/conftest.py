"""A small fleet's configuration, and an autopilot that streams what it is asked for."""

from __future__ import annotations

import socket
import tomllib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.mavlink.codec import Decoder, Encoder, mavlink
from tests.support.ports import HOST, free_ports

CONFIG = """
[fleet]
name = "test"
period_s = 0.1
origin = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 400.0 }

[estimator]
kind = "dekf_ci"
share_inputs = "fleet"

[sensors]
gps_position_half_width_m = 0.15
gps_speed = "norm"
gps_speed_half_width_mps = 0.08
uwb_bound_m = 0.1
accel_sigma_mps2 = 0.0577
gravity_mps2 = 9.80665

[security]
mode = "unsigned"
"""


def fleet_config(count: int = 3, *overrides: str) -> FleetConfig:
    """A small fleet's configuration."""
    document: dict[str, Any] = tomllib.loads(CONFIG)
    document["agents"] = [{"id": i, "mavlink": f"udpin:127.0.0.1:{15000 + i}"} for i in range(1, count + 1)]
    return config_from(document, "test", overrides)


HIGHRES, RAW, QUATERNION = 105, 27, 31


@dataclass
class VirtualAutopilot:
    """Streams what it is asked for, answers commands and TIMESYNC; ``boot_s`` is host time of its start."""

    autopilot: int = mavlink.MAV_AUTOPILOT_PX4
    boot_s: float = 90.0
    system_id: int = 1
    refuses: tuple[int, ...] = ()
    forgets: tuple[int, ...] = ()
    """What it accepts to send and does not."""
    deaf: bool = False
    answers_timesync: bool = True
    rates: dict[int, float] = field(default_factory=dict)
    commands: list[tuple[int, float]] = field(default_factory=list)
    received: dict[str, list[Any]] = field(default_factory=lambda: defaultdict(list))

    def __post_init__(self) -> None:
        self.encoder, self.decoder = Encoder(self.system_id, 1), Decoder(datagrams=True)
        self.next: dict[int, float] = defaultdict(float)
        self.out: list[bytes] = []

    def send(self, message: Any) -> None:
        self.out.append(self.encoder.encode(message))

    def receive(self, frame: bytes, now_s: float) -> None:
        for message in self.decoder.feed(frame):
            self.received[message.get_type()].append(message)
            if message.get_type() == "COMMAND_LONG" and not self.deaf:
                message_id = int(message.param1)
                self.commands.append((message_id, message.param2))
                result = 4 if message_id in self.refuses else 0
                if not result and message_id not in self.forgets:
                    self.rates[message_id] = 1e6 / message.param2
                self.send(mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, 1, 197))
            elif message.get_type() == "TIMESYNC" and not message.tc1 and self.answers_timesync:
                self.send(mavlink.MAVLink_timesync_message(round((now_s - self.boot_s) * 1e9), message.ts1))

    def step(self, now_s: float) -> list[bytes]:
        boot_s = now_s - self.boot_s
        for message_id, rate_hz in {0: 1.0, **self.rates}.items():
            if now_s >= self.next[message_id]:
                self.next[message_id] = (self.next[message_id] or now_s) + 1 / rate_hz
                self.stream(message_id, boot_s)
        out, self.out = self.out, []
        return out

    def stream(self, message_id: int, boot_s: float) -> None:
        ms, us = int(boot_s * 1e3) % 2**32, int(boot_s * 1e6)
        if message_id == 0:
            self.send(mavlink.MAVLink_heartbeat_message(2, self.autopilot, 0, 0, 4, 3))
        elif message_id == HIGHRES:
            self.send(mavlink.MAVLink_highres_imu_message(us, 0, 0, -9.8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x1FFF))
        elif message_id == RAW:
            self.send(mavlink.MAVLink_raw_imu_message(us, 0, 0, -1000, 0, 0, 0, 0, 0, 0))
        elif message_id == QUATERNION:
            self.send(mavlink.MAVLink_attitude_quaternion_message(ms, 1, 0, 0, 0, 0, 0, 0))
        elif message_id == 24:
            place = (3, 470001000, 80002000, 410_000, 80, 120, 0, 0, 12, 450_000, 300, 500, 200)
            self.send(mavlink.MAVLink_gps_raw_int_message(us, *place))
        elif message_id == 2:
            self.send(mavlink.MAVLink_system_time_message(0, ms))


@pytest.fixture
def make_config() -> Callable[..., FleetConfig]:
    return fleet_config


@pytest.fixture
def virtual_autopilot() -> type[VirtualAutopilot]:
    return VirtualAutopilot


@pytest.fixture
def config_of(make_config: Callable[..., FleetConfig], tmp_path: Path) -> Callable[..., FleetConfig]:
    """A fleet on free ports, whose agents start at once."""

    def make(count: int, *overrides: str) -> FleetConfig:
        udp, tcp = free_ports(socket.SOCK_DGRAM, count), free_ports(socket.SOCK_STREAM, count)
        own: list[str] = ["initial.position_m=[0.0, 0.0, -5.0]", f"record.directory={tmp_path / 'rec'}"]
        for i in range(count):
            own.append(f"agents.{i + 1}.mavlink=udpin:{HOST}:{udp[i]}")
            own.append(f'agents.{i + 1}.listen=["tcp/{HOST}:{tcp[i]}"]')
        if count > 1:
            own.append(f'agents.2.connect=["tcp/{HOST}:{tcp[0]}"]')
        return make_config(count, *own, *overrides)

    return make
