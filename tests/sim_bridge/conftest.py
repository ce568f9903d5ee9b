"""What the simulator's tests share: a small fleet, and its frames decoded by pymavlink itself."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from agent.sensing.frames import FleetFrame
from sim_bridge.world.scenario import Scenario, Vehicle
from sim_bridge.world.simulation import Simulation

FRAME = FleetFrame(47.397742, 8.545594, 489.4, True, None)
CLIENT_SYSTEM, CLIENT_COMPONENT = 245, 190


class Client:
    """A ground station on one autopilot's link, in virtual time and without sockets."""

    def __init__(self, simulation: Simulation, agent: int = 1) -> None:
        self.simulation, self.agent = simulation, agent
        self.parser = mavlink.MAVLink(None)
        self.parser.robust_parsing = True
        self.packer = mavlink.MAVLink(None, CLIENT_SYSTEM, CLIENT_COMPONENT)
        self.received: dict[str, list[Any]] = defaultdict(list)
        self.arrivals: dict[str, list[float]] = defaultdict(list)
        self.sequence: list[int] = []
        """Sequence numbers of all messages in order of arrival."""

    def _take(self, frames: list[bytes], now: float) -> None:
        for frame in frames:
            for message in self.parser.parse_buffer(frame) or ():
                assert not isinstance(message, mavlink.MAVLink_bad_data), message
                self.received[message.get_type()].append(message)
                self.arrivals[message.get_type()].append(now)
                self.sequence.append(message.get_seq())

    def run_to(self, time_s: float) -> None:
        """Advance the simulation step by step to ``time_s`` after its start."""
        end_s = self.simulation.start_s + time_s
        while self.simulation.next_step_s() <= end_s + 1e-9:
            now = self.simulation.next_step_s()
            outputs = self.simulation.advance(now)
            self._take([frame for agent, frame in outputs.frames if agent == self.agent], now)

    def send(self, message: Any, now: float | None = None) -> None:
        """Send a message; what comes back at once is in ``received``."""
        now = self.simulation.now if now is None else now
        frame = bytes(message.pack(self.packer))
        self.packer.seq = (self.packer.seq + 1) % 256
        self._take(self.simulation.receive(self.agent, frame, now), now)

    def command(self, number: int, *params: float, system: int = 0) -> int:
        """Send a COMMAND_LONG; the result of its acknowledgement."""
        full = (*params, *[float("nan")] * (7 - len(params)))
        before = len(self.received["COMMAND_ACK"])
        self.send(mavlink.MAVLink_command_long_message(system, 1, number, 0, *full))
        acks = self.received["COMMAND_ACK"][before:]
        assert [ack.command for ack in acks] == [number]
        assert (acks[0].target_system, acks[0].target_component) == (CLIENT_SYSTEM, CLIENT_COMPONENT)
        return int(acks[0].result)

    def set_rate(self, message_id: int, rate_hz: float) -> int:
        """Ask for a message rate."""
        return self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / rate_hz)

    def between(self, kind: str, from_s: float, to_s: float) -> list[Any]:
        """Messages that arrived in an interval after the start."""
        start_s = self.simulation.start_s
        return [
            message
            for message, now in zip(self.received[kind], self.arrivals[kind], strict=True)
            if from_s <= now - start_s < to_s
        ]


@pytest.fixture(scope="session")
def make_scenario() -> Callable[..., Scenario]:
    """Scenario of vehicles (default: one PX4 hovering at its reference)."""

    def make(*vehicles: Vehicle, **settings: Any) -> Scenario:
        fleet = vehicles or (Vehicle(1, "px4", 1, start_m=(5.0, 0.0, 5.0), start_velocity_mps=(0.0, 0.0, 0.0)),)
        return Scenario(vehicles=fleet, **{"frame": FRAME, **settings})

    return make


@pytest.fixture(scope="session")
def connect(make_scenario: Callable[..., Scenario]) -> Callable[..., Client]:
    """Client on the first vehicle of a new simulation."""

    def make(*vehicles: Vehicle, start_s: float = 1000.0, unix_offset_s: float = 0.0, **settings: Any) -> Client:
        scenario = make_scenario(*vehicles, **settings)
        return Client(Simulation(scenario, start_s, unix_offset_s), scenario.ids[0])

    return make
