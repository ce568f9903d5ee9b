"""The bridge on real sockets against the loopback autopilots: it relays, waits, names who is missing, and ranges."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from agent.config.endpoints import parse_endpoint
from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from sim_bridge.autopilot.udp_autopilot import PortError
from sim_bridge.sitl.bridge import BridgeProgress, SimulatorAbsent, SitlBridge, bridge
from sim_bridge.sitl.setup import vehicle_links
from sim_bridge.sitl.world import SitlWorld
from sim_bridge.world.simulation import Simulation
from sim_bridge.world.truth import load_truth
from tests.support.loopback_sitl import FRAME, LoopbackSitl, flavour_of, grounded_fleet
from tests.support.ports import bound
from transport.link.session import Handlers, open_session
from transport.link.session_settings import SessionSettings
from transport.link.streams import Stream
from transport.messages.uwb_body import UwbIntake

WAIT_S = 20.0
IDS = (1, 2)


def bridge_config(ids: tuple[int, ...] = IDS, **tables: Any) -> FleetConfig:
    """A PX4 on UDP and an ArduPilot on TCP, on free ports."""
    with ExitStack() as stack:
        udp = {agent: [stack.enter_context(bound(socket.SOCK_DGRAM)) for _ in range(2)] for agent in ids}
        tcp = {agent: [stack.enter_context(bound(socket.SOCK_STREAM)) for _ in range(2)] for agent in ids}
        clients = stack.enter_context(bound(socket.SOCK_DGRAM))
    simulators = {
        agent: f"udpin:127.0.0.1:{udp[agent][1]}" if agent % 2 else f"tcp:127.0.0.1:{tcp[agent][1]}" for agent in ids
    }
    return config_from(
        {
            "fleet": {
                "name": "sitlbridge",
                "origin": {"lat_deg": FRAME.lat_deg, "lon_deg": FRAME.lon_deg, "alt_m": FRAME.alt_m},
            },
            "agents": [
                {
                    "id": agent,
                    "autopilot": flavour_of(agent),
                    "mavlink": f"udpin:127.0.0.1:{udp[agent][0]}",
                    "listen": [f"tcp/127.0.0.1:{tcp[agent][0]}"],
                }
                for agent in ids
            ],
            "sitl": {
                "vehicles": [{"agent": agent, "simulator": simulators[agent]} for agent in ids],
                "client_port": min(clients, 60_000),
                **tables.pop("sitl", {}),
            },
            **tables,
        },
        "test",
    )


@asynccontextmanager
async def simulators_of(config: FleetConfig) -> AsyncIterator[LoopbackSitl]:
    simulation = Simulation(grounded_fleet(config.ids), time.monotonic(), time.time() - time.monotonic())
    sitl = LoopbackSitl(simulation)
    async with sitl.serve({agent: link.simulator for agent, link in vehicle_links(config).items()}):
        yield sitl


class Daemon(asyncio.DatagramProtocol):
    """The other end of a daemon's or a client's link: keeps all bytes, speaks when it has heard."""

    def __init__(self, remote: tuple[str, int] | None = None) -> None:
        self.remote: Any = remote
        self.received = b""
        self.datagrams: list[bytes] = []
        self.heard = asyncio.Event()

    def connection_made(self, transport: Any) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self.received += data
        self.datagrams.append(data)
        self.remote = addr
        self.heard.set()

    def say(self, message: Any, component: int = 197, system: int = 1) -> bytes:
        frame = bytes(message.pack(mavlink.MAVLink(None, system, component)))
        self.transport.sendto(frame, self.remote)
        return frame

    def messages(self) -> list[Any]:
        parser = mavlink.MAVLink(None)
        return [message for data in self.datagrams for message in parser.parse_buffer(data) or ()]

    @classmethod
    async def at(cls, port: int, remote: tuple[str, int] | None = None) -> Daemon:
        loop = asyncio.get_running_loop()
        _, daemon = await loop.create_datagram_endpoint(lambda: cls(remote), local_addr=("127.0.0.1", port))
        return daemon


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(WAIT_S):
        while not condition():
            await asyncio.sleep(0.02)


def types(daemon: Daemon) -> set[str]:
    """The types of the messages that it has heard."""
    return {message.get_type() for message in daemon.messages()}


def heartbeat() -> Any:
    return mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)


@asynccontextmanager
async def running(config: FleetConfig, **options: Any) -> AsyncIterator[tuple[asyncio.Task[Any], asyncio.Event]]:
    stop = asyncio.Event()
    task = asyncio.create_task(bridge(config, stop=stop, **options))
    try:
        yield task, stop
    finally:
        stop.set()
        await asyncio.wait_for(asyncio.gather(task, return_exceptions=True), WAIT_S)


async def test_it_relays_every_byte_and_keeps_several_clients() -> None:
    config = bridge_config()
    links = vehicle_links(config)
    async with simulators_of(config) as sitl:
        daemons = {agent: await Daemon.at(link.daemon.port) for agent, link in links.items()}
        clients = [await Daemon.at(0, ("127.0.0.1", links[2].client_port)) for _ in range(2)]
        async with running(config) as (task, _stop):
            for daemon in daemons.values():
                await asyncio.wait_for(daemon.heard.wait(), WAIT_S)
            said = daemons[2].say(heartbeat())
            client_said = [client.say(heartbeat(), component=190, system=245) for client in clients]
            for client in clients:
                await asyncio.wait_for(client.heard.wait(), WAIT_S)
            await until(lambda: all(len(daemon.received) > 2000 for daemon in daemons.values()))
            assert not task.done()
        for end in (*daemons.values(), *clients):
            end.transport.close()
    # THEN the daemon has the simulator's bytes, none missing in between, whole frames in each datagram
    for agent, daemon in daemons.items():
        assert daemon.received in sitl.sent[agent]
        for datagram in daemon.datagrams:
            parser = mavlink.MAVLink(None)
            assert parser.parse_buffer(datagram)
            assert parser.buf_len() == 0
    # AND the simulator has theirs, and the bridge's own
    for frame in (said, *client_said):
        assert frame in sitl.received[2]
    for client in clients:
        assert client.received in sitl.sent[2]


async def test_ranges_truth_and_a_dropped_gps(tmp_path: Path) -> None:
    # GIVEN the agent of drone 1 on Zenoh, and drone 2 whose GPS is dropped from the begin
    config = bridge_config(sim={"gps_outages": [{"agent": 2, "from_s": 0.0, "to_s": 1000.0}]})
    links = vehicle_links(config)
    intake, ranges, enough = UwbIntake(1), [], asyncio.Event()

    def on_sample(_key: str, payload: bytes, arrived_s: float) -> None:
        accepted = intake.accept(payload, unix_s=time.time(), monotonic_s=arrived_s)
        if accepted is not None:
            ranges.extend(accepted[0].ranges)
        if len(ranges) >= 8:
            enough.set()

    session = await open_session(
        SessionSettings(listen=config.listen(1)), config.fleet.name, 1, config.ids, Handlers(on_sample)
    )
    session.subscribe(1, [Stream.UWB])
    progress: list[BridgeProgress] = []
    truth_file = tmp_path / "truth.npz"
    async with simulators_of(config):
        daemons = {agent: await Daemon.at(link.daemon.port) for agent, link in links.items()}
        async with running(config, truth_file=truth_file, on_progress=progress.append) as (task, stop):
            for daemon in daemons.values():
                await asyncio.wait_for(daemon.heard.wait(), WAIT_S)
                daemon.say(heartbeat())
            await asyncio.wait_for(enough.wait(), WAIT_S)
            for daemon in daemons.values():
                daemon.datagrams.clear()
            daemons[2].say(request(2, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 20.0))
            daemons[1].say(request(1, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 20.0))
            await until(lambda: "GPS_RAW_INT" in types(daemons[1]) and "ATTITUDE_QUATERNION" in types(daemons[2]))
            heard = types(daemons[2])
            stop.set()
            report = await asyncio.wait_for(task, WAIT_S)
    await session.close()
    for daemon in daemons.values():
        daemon.transport.close()
    # THEN the ranges are those between the homes, 12 m apart
    assert all(measured.other == 2 and abs(measured.range_m - 12.0) < 0.13 for measured in ranges)
    # AND drone 2's daemon has heard its autopilot, or the flight would not have ended, but no fix
    assert "GPS_RAW_INT" not in heard
    assert report.vehicles[1].gps_frames_withheld > 0
    assert report.vehicles[0].gps_frames_withheld == 0
    assert report.lost == ()
    # AND the record holds both, from a tick on
    truth = load_truth(truth_file)
    assert truth.agents == IDS
    assert abs(truth.position_m[:, 0]).max() < 0.02
    assert abs(truth.position_m[:, 1] - (0.0, 12.0, 0.0)).max() < 0.02
    assert [step.ready for step in progress] == [False, True, True]


async def test_an_autopilot_without_gps_gets_it_back_at_the_end() -> None:
    # GIVEN a run in which the GPS of drone 1's autopilot is away from the begin
    config = bridge_config((1,), sitl={"autopilot_gps": [{"agent": 1, "from_s": 0.0, "to_s": 1000.0}]})
    links = vehicle_links(config)
    async with simulators_of(config) as sitl:
        daemon = await Daemon.at(links[1].daemon.port)
        async with running(config) as (task, stop):
            await asyncio.wait_for(daemon.heard.wait(), WAIT_S)
            daemon.say(heartbeat())
            parameters = sitl.simulation.autopilots[1].state.parameters
            await until(lambda: parameters.value("SIM_GPS_USED") == 0.0)
            # WHEN the run ends THEN the simulator is as it was
            stop.set()
            await asyncio.wait_for(task, WAIT_S)
            assert parameters.value("SIM_GPS_USED") == 10.0
        daemon.transport.close()


def request(agent: int, message_id: int, rate_hz: float) -> Any:
    return mavlink.MAVLink_command_long_message(agent, 1, 511, 0, float(message_id), 1e6 / rate_hz, 0, 0, 0, 0, 0)


async def test_absent_simulators_are_named_with_their_addresses() -> None:
    config = bridge_config(sitl={"appear_timeout_s": 0.3})
    progress: list[BridgeProgress] = []
    with pytest.raises(SimulatorAbsent) as absent:
        await asyncio.wait_for(bridge(config, on_progress=progress.append), WAIT_S)
    for link in vehicle_links(config).values():
        assert f"drone {link.agent_id}: simulator at {link.simulator}: nobody there" in str(absent.value)
        assert str(link.simulator) in progress[0].missing[link.agent_id - 1]


async def test_an_autopilot_without_a_simulator_is_refused() -> None:
    # GIVEN an autopilot that refuses its truth, as one on a real vehicle does
    config = bridge_config(ids=(2,))
    simulator = vehicle_links(config)[2].simulator

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        packer = mavlink.MAVLink(None, 2, 1)
        writer.write(bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(packer)))
        parser = mavlink.MAVLink(None)
        while data := await reader.read(4096):
            for message in parser.parse_buffer(data) or ():
                if message.get_type() == "COMMAND_LONG":
                    ack = mavlink.MAVLink_command_ack_message(
                        511, 2, target_system=2, target_component=message.get_srcComponent()
                    )
                    writer.write(bytes(ack.pack(packer)))
        writer.close()

    server = await asyncio.start_server(serve, simulator.host, simulator.port)
    try:
        with pytest.raises(SimulatorAbsent, match="refuses SIM_STATE"):
            await asyncio.wait_for(bridge(config), WAIT_S)
    finally:
        server.close()


async def test_a_simulator_that_dies_ends_the_run_and_is_named() -> None:
    config = bridge_config(ids=(1, 2), sitl={"silence_s": 0.5})
    links = vehicle_links(config)
    world = SitlWorld(config, time.time() - time.monotonic())
    sitl_bridge = SitlBridge(config, world, lambda _observer, _payload: True)
    daemons = {agent: await Daemon.at(link.daemon.port) for agent, link in links.items()}
    await sitl_bridge.open()
    try:
        begun = asyncio.Event()

        def on_progress(step: BridgeProgress) -> None:
            if step.begun_unix_s is not None:
                begun.set()

        async with simulators_of(config) as sitl:
            task = asyncio.create_task(sitl_bridge.run(asyncio.Event(), on_progress))
            for daemon in daemons.values():
                await asyncio.wait_for(daemon.heard.wait(), WAIT_S)
                daemon.say(heartbeat())
            await asyncio.wait_for(begun.wait(), WAIT_S)
            sitl.simulation.autopilots[2].reboot(time.monotonic(), down_s=1e6)
            report = await asyncio.wait_for(task, WAIT_S)
    finally:
        await sitl_bridge.close()
        for daemon in daemons.values():
            daemon.transport.close()
    assert len(report.lost) == 1
    assert f"drone 2: simulator at {links[2].simulator}: no truth for 0.5 s" in report.lost[0]
    assert report.duration_s > 0.0


async def test_a_taken_client_port_is_named() -> None:
    with bound(socket.SOCK_DGRAM) as taken:
        config = bridge_config(ids=(1,), sitl={"client_port": taken})
        with pytest.raises(PortError, match=rf"127\.0\.0\.1:{taken} for MAVSDK"):
            await bridge(config)


def test_the_loopback_links_are_what_real_simulators_have() -> None:
    links = vehicle_links(bridge_config())
    assert links[1].simulator.kind is parse_endpoint("udpin:127.0.0.1:1").kind
    assert links[2].simulator.kind is parse_endpoint("tcp:127.0.0.1:1").kind
