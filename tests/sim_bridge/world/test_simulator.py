"""The simulator process: sockets, real time, Zenoh, truth on disk, clean ends."""

from __future__ import annotations

import asyncio
import logging
import math
import signal
import socket
import time
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from agent.config.endpoints import parse_endpoint
from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from sim_bridge.autopilot.udp_autopilot import MAX_DATAGRAM_BYTES, PortError, open_port
from sim_bridge.world.range_sessions import range_session_settings
from sim_bridge.world.scenario import ScenarioError, Vehicle
from sim_bridge.world.simulation import Simulation
from sim_bridge.world.simulator import Simulator, simulate, stop_signals
from sim_bridge.world.truth import load_truth
from tests.support.ports import free_port
from transport.link.session import Handlers, open_session
from transport.link.session_settings import SessionSettings
from transport.link.streams import Stream
from transport.messages.uwb_body import UwbIntake

WAIT_S = 10.0


class Daemon(asyncio.DatagramProtocol):
    """The other end: keeps what it hears."""

    def __init__(self) -> None:
        self.heard: asyncio.Queue[tuple[bytes, Any]] = asyncio.Queue()

    def connection_made(self, transport: Any) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self.heard.put_nowait((data, addr))

    @classmethod
    async def at(cls, port: int = 0) -> Daemon:
        loop = asyncio.get_running_loop()
        _, daemon = await loop.create_datagram_endpoint(cls, local_addr=("127.0.0.1", port))
        return daemon

    @property
    def port(self) -> int:
        return int(self.transport.get_extra_info("sockname")[1])

    async def next(self) -> tuple[bytes, Any]:
        return await asyncio.wait_for(self.heard.get(), WAIT_S)


async def test_opposite_to_udpin_it_sends_first_and_follows_the_last_valid_sender():
    first, second = await Daemon.at(), await Daemon.at()
    port = await open_port(
        parse_endpoint(f"udpin:127.0.0.1:{first.port}"), lambda data: ([b"echo " + data], data == b"good")
    )
    try:
        port.send([b"hello"])
        data, address = await first.next()
        assert data == b"hello"
        # a datagram without a valid frame does not move it
        second.transport.sendto(b"bad", address)
        assert (await first.next())[0] == b"echo bad"
        second.transport.sendto(b"good", address)
        assert (await second.next())[0] == b"echo good"
        assert port.remote == ("127.0.0.1", second.port)
    finally:
        port.close()
        first.transport.close()
        second.transport.close()


async def test_opposite_to_udpout_it_waits_to_be_spoken_to():
    own = free_port()
    port = await open_port(parse_endpoint(f"udpout:127.0.0.1:{own}"), lambda _data: ([b"here"], True))
    daemon = await Daemon.at()
    try:
        port.send([b"to nobody", b"either"])
        assert port.unsent == 2
        daemon.transport.sendto(b"ping", ("127.0.0.1", own))
        assert (await daemon.next())[0] == b"here"
        assert port.local == ("127.0.0.1", own)
    finally:
        port.close()
        daemon.transport.close()
    port.send([b"after closing"])
    assert port.unsent == 2


async def test_frames_share_datagrams_up_to_a_size():
    daemon = await Daemon.at()
    port = await open_port(parse_endpoint(f"udpin:127.0.0.1:{daemon.port}"), lambda _data: ([], False))
    try:
        frames = [bytes([k]) * 300 for k in range(10)]
        port.send(frames)
        datagrams = [(await daemon.next())[0] for _ in range(3)]
        assert b"".join(datagrams) == b"".join(frames)
        assert max(len(datagram) for datagram in datagrams) <= MAX_DATAGRAM_BYTES
    finally:
        port.close()
        daemon.transport.close()


async def test_a_taken_port_and_a_foreign_link_are_named():
    daemon = await Daemon.at()
    try:
        with pytest.raises(PortError, match=rf"cannot open UDP 127\.0\.0\.1:{daemon.port}"):
            await open_port(parse_endpoint(f"udpout:127.0.0.1:{daemon.port}"), lambda _data: ([], False))
    finally:
        daemon.transport.close()
    with pytest.raises(PortError, match="expected a daemon link udpin"):
        await open_port(parse_endpoint("serial:/dev/ttyS0:57600"), lambda _data: ([], False))


async def test_a_daemon_that_is_not_there_yet_stops_nothing(make_scenario):
    port = free_port()
    simulation = Simulation(make_scenario(), time.monotonic())
    simulator = Simulator(simulation, lambda _observer, _payload: True)
    async with simulator.serve({1: parse_endpoint(f"udpin:127.0.0.1:{port}")}):
        report = await simulator.run(0.3, asyncio.Event())
        assert report.duration_s == pytest.approx(0.3, abs=0.006)
        assert report.send_errors == 0
        # WHEN it comes THEN it hears the autopilot
        daemon = await Daemon.at(port)
        running = asyncio.create_task(simulator.run(0.6, asyncio.Event()))
        data, _ = await daemon.next()
        daemon.transport.close()
        await running
    assert mavlink.MAVLink(None).parse_buffer(data)


async def test_ranges_that_cannot_be_published_are_counted(make_scenario):
    pair = (Vehicle(1, system_id=1), Vehicle(2, system_id=2))
    simulation = Simulation(make_scenario(*pair), time.monotonic())
    simulator = Simulator(simulation, lambda observer, _payload: observer == 1)
    links = {agent: parse_endpoint(f"udpin:127.0.0.1:{free_port()}") for agent in (1, 2)}
    async with simulator.serve(links):
        report = await simulator.run(0.5, asyncio.Event())
    assert (report.ranges_published, report.ranges_failed) == (5, 5)


async def test_falling_behind_is_said_once_and_caught_up(make_scenario, caplog):
    # GIVEN a world whose start was two seconds ago
    simulation = Simulation(make_scenario(), time.monotonic() - 2.0)
    simulator = Simulator(simulation, lambda _observer, _payload: True)
    with caplog.at_level(logging.WARNING, logger="sim_bridge.world.simulator"):
        async with simulator.serve({1: parse_endpoint(f"udpin:127.0.0.1:{free_port()}")}):
            report = await simulator.run(2.5, asyncio.Event())
    assert report.duration_s == pytest.approx(2.5, abs=0.006)
    assert report.max_behind_s >= 1.9
    assert sum("behind the clock" in record.message for record in caplog.records) >= 1


async def test_a_signal_ends_a_run(make_scenario):
    simulation = Simulation(make_scenario(), time.monotonic())
    simulator = Simulator(simulation, lambda _observer, _payload: True)
    stop = asyncio.Event()
    async with simulator.serve({1: parse_endpoint(f"udpin:127.0.0.1:{free_port()}")}):
        with stop_signals(stop):
            running = asyncio.create_task(simulator.run(math.inf, stop))
            await asyncio.sleep(0)
            signal.raise_signal(signal.SIGTERM)
            report = await asyncio.wait_for(running, WAIT_S)
    assert report.duration_s < WAIT_S


def fleet_config(**sim: Any) -> FleetConfig:
    zenoh_port = free_port(socket.SOCK_STREAM)
    return config_from(
        {
            "fleet": {"name": "simtest", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 500.0}},
            "agents": [
                {
                    "id": agent,
                    "mavlink": f"udpin:127.0.0.1:{free_port()}",
                    "listen": [f"tcp/127.0.0.1:{zenoh_port}"] if agent == 1 else [],
                }
                for agent in (1, 2)
            ],
            "sim": sim,
        },
        "test",
    )


async def test_the_whole_simulator_publishes_ranges_and_leaves_the_truth(tmp_path):
    # GIVEN the agent of drone 1, listening on Zenoh for its UWB module
    config = fleet_config(seed=3, duration_s=600.0)
    intake, ranges, enough = UwbIntake(1), [], asyncio.Event()

    def on_sample(_key: str, payload: bytes, arrived_s: float) -> None:
        accepted = intake.accept(payload, unix_s=time.time(), monotonic_s=arrived_s)
        if accepted is not None:
            ranges.append((accepted[0].t_ns * 1e-9, accepted[0].ranges[0]))
        if len(ranges) >= 5:
            enough.set()

    agent = await open_session(
        SessionSettings(listen=config.listen(1)), config.fleet.name, 1, config.ids, Handlers(on_sample)
    )
    agent.subscribe(1, [Stream.UWB])
    stop, truth_file = asyncio.Event(), tmp_path / "truth.npz"
    unix_minus_mono_s = time.time() - time.monotonic()
    # WHEN the simulator runs until enough has come
    running = asyncio.create_task(simulate(config, truth_file=truth_file, stop=stop))
    try:
        await asyncio.wait_for(enough.wait(), WAIT_S)
    finally:
        stop.set()
        report = await asyncio.wait_for(running, WAIT_S)
        await agent.close()
    # THEN the ranges are those of the truth, which starts on a tick
    assert report.ranges_published >= 10
    assert intake.rejections.total == intake.skipped == 0
    truth = load_truth(truth_file)
    assert truth.agents == (1, 2)
    tick = truth.time_unix_s[0] / 0.1
    assert tick == pytest.approx(round(tick), abs=1e-3)
    for taken_s, measured in ranges:
        # the two clocks were read a moment apart: the last range may lie microseconds after the last sample
        state = truth.at(min(taken_s + unix_minus_mono_s, truth.time_unix_s[-1]))
        assert measured.other == 2
        assert measured.range_m == pytest.approx(math.dist(state[0, :3], state[1, :3]), abs=0.11)


async def test_a_scenario_that_cannot_be_flown_ends_before_anything_is_opened():
    steep = {"agent": 1, "kind": "circle", "center_m": [0.0, 0.0, -5.0], "radius_m": 50.0, "lap_s": 10.0}
    with pytest.raises(ScenarioError, match="agent 1: path"):
        await simulate(fleet_config(paths=[steep]))


def test_the_drivers_dial_every_agent_and_listen_nowhere():
    config = fleet_config()
    settings = range_session_settings(config)
    assert settings.connect == config.listen(1)
    assert settings.listen == ()
