"""The daemon on loopback: real sockets, real Zenoh sessions, real signals; every wait has an end."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from agent.config.reading import dump
from agent.daemon import Daemon, Periods
from agent.exit_codes import ExitCode
from agent.log.estimate_log import read_entries
from agent.log.flight_log import FlightLog
from agent.mavlink.codec import Encoder, mavlink
from agent.outputs import ClockStepped
from agent.watch.observers import DaemonState, Observer
from estimators.estimator import Status
from estimators.factory import make_estimator
from tests.support.awaiting import until
from tests.support.ports import HOST
from transport.link.session import Handlers, open_session
from transport.link.session_settings import SessionSettings
from transport.link.streams import Stream
from transport.messages.estimate_body import FleetEstimate
from transport.messages.report_body import Diagnostics
from transport.security.auth import UNSIGNED
from transport.security.keys import init_keys
from transport.security.opening import Opener

PATIENCE_S = 30.0


class UdpAutopilot(asyncio.DatagramProtocol):
    """A virtual autopilot that streams to a daemon in real time until it is cancelled."""

    def __init__(self, virtual: Any, remote: str) -> None:
        self.virtual = virtual
        host, port = remote.removeprefix("udpin:").split(":")
        self.remote = (host, int(port))

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self.virtual.receive(data, time.monotonic())

    async def fly(self) -> None:
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(lambda: self, remote_addr=self.remote)
        try:
            while True:
                for frame in self.virtual.step(time.monotonic()):
                    transport.sendto(frame)
                await asyncio.sleep(0.005)  # the autopilot's own pace, not a wait of the test
        finally:
            transport.close()


async def test_two_daemons_find_their_autopilots_and_each_other(
    config_of: Any, virtual_autopilot: type[Any], tmp_path: Path
) -> None:
    init_keys(tmp_path / "keys", (1, 2))
    config = config_of(2, "security.mode=signed")
    daemons = [Daemon(config, i, make_estimator, tmp_path) for i in (1, 2)]
    flown = [
        UdpAutopilot(virtual_autopilot(system_id=i, boot_s=time.monotonic() - 50), config.agent(i).mavlink)
        for i in (1, 2)
    ]
    flights = [asyncio.create_task(autopilot.fly()) for autopilot in flown]
    runs = [asyncio.create_task(daemon.run()) for daemon in daemons]
    await until(lambda: all(d.core.health.health.state == "ok" for d in daemons), "both ok")
    await until(lambda: all(d.core.counters["information: kept"] > 5 for d in daemons), "rounds of both")
    await until(lambda: bool(daemons[0].onboard.opener.peers[2].clock.round_trip_s), "a clock answer")
    daemons[1].stop()
    await asyncio.wait_for(runs[1], PATIENCE_S)
    await until(lambda: "not heard: 2" in str(daemons[0].core.health.health), "2 has left")
    flights[0].cancel()  # the autopilot is gone; the daemon goes on
    ticks = daemons[0].core.counters["ticks"]
    await until(lambda: daemons[0].onboard.link_state == "lost", "the lost autopilot")
    assert daemons[0].core.counters["ticks"] > ticks
    daemons[0].stop()
    await asyncio.wait_for(runs[0], PATIENCE_S)
    for flight in flights:
        flight.cancel()
    await asyncio.gather(*flights, return_exceptions=True)
    check_records(tmp_path / "rec")


async def test_a_lost_autopilot_ends_the_daemon_only_where_that_is_asked_for(
    config_of: Any, virtual_autopilot: type[Any], tmp_path: Path
) -> None:
    # GIVEN a daemon that is to end with its simulated flight, WHEN its autopilot falls silent
    config = config_of(
        1, "security.mode=unsigned", "mavlink.heartbeat_timeout_s=1.5", "mavlink.end_after_lost_s=0.2"
    )
    daemon = Daemon(config, 1, make_estimator, tmp_path)
    autopilot = UdpAutopilot(virtual_autopilot(system_id=1, boot_s=time.monotonic() - 50), config.agent(1).mavlink)
    running, flight = asyncio.create_task(daemon.run()), asyncio.create_task(autopilot.fly())
    await until(lambda: daemon.core.counters["ticks"] > 5, "a flight")
    assert not running.done()
    flight.cancel()
    # THEN it ends by itself, as if it had been told to, and its record is whole
    await asyncio.wait_for(running, PATIENCE_S)
    await asyncio.gather(flight, return_exceptions=True)
    assert daemon.onboard.link_state == "lost"
    assert len(read_entries(tmp_path / "rec" / "agent_001.estimates")[1]) == daemon.core.counters["ticks"]


async def test_a_stranger_on_the_mavlink_port_gets_none_of_the_autopilots_frames(config_of: Any) -> None:
    # GIVEN a daemon, WHEN a vehicle of another system id sends it sound frames
    config = config_of(1, "security.mode=unsigned")
    daemon = Daemon(config, 1, make_estimator, Path())
    running = asyncio.create_task(daemon.run())
    await until(lambda: daemon.state().counters["mavlink opened"] == 1, "the open link")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setblocking(False)
        beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
        address = config.agent(1).mavlink.removeprefix("udpin:").split(":")
        stranger.sendto(Encoder(77, 1).encode(beat), (address[0], int(address[1])))
        await until(lambda: daemon.state().counters.get("mavlink ignored heartbeat: other system") == 1, "it")
        sent = daemon.state().counters["mavlink tx dropped"]
        # THEN our heartbeats still are for nobody, until the autopilot speaks
        await until(lambda: daemon.state().counters["mavlink tx dropped"] > sent, "a heartbeat for nobody")
        with pytest.raises(BlockingIOError):
            stranger.recv(512)
    daemon.stop()
    await asyncio.wait_for(running, PATIENCE_S)


async def test_a_connection_on_which_the_autopilot_falls_silent_is_made_anew(
    config_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its end may have vanished without a word: a connection does not tell."""
    monkeypatch.setattr("agent.mavlink.link.REOPEN_S", 0.02)
    open_ends: list[asyncio.StreamWriter] = []
    # GIVEN an autopilot behind TCP that says one thing on the first two connections, and then nothing
    beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        open_ends.append(writer)
        if len(open_ends) <= 2:
            writer.write(Encoder(1, 1).encode(beat))

    server = await asyncio.start_server(serve, HOST, 0)
    port = server.sockets[0].getsockname()[1]
    link = f"agents.1.mavlink=tcpout:{HOST}:{port}"
    config = config_of(1, "security.mode=unsigned", link, "mavlink.heartbeat_timeout_s=1.5")
    often = Periods(housekeeping_s=0.05, renew_link_s=0.1)
    daemon = Daemon(config, 1, make_estimator, Path(), periods=often)
    running = asyncio.create_task(daemon.run())
    # WHEN it is lost THEN it is dialled again; is it still lost, once more after a while
    await until(lambda: daemon.onboard.link_state == "lost", "the silence")
    await until(lambda: daemon.onboard.link_state == "connected", "a second connection")
    await until(lambda: len(open_ends) >= 4, "a third and a fourth")
    daemon.stop()
    await asyncio.wait_for(running, PATIENCE_S)
    server.close()
    for writer in open_ends:
        writer.transport.abort()


async def test_a_fault_of_the_core_ends_no_task_wherever_it_is_called_from(
    config_of: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # GIVEN a daemon whose clock questions are answered at once, from within its housekeeping
    asked = 0
    config, often = config_of(1, "security.mode=unsigned"), Periods(housekeeping_s=0.05)
    daemon = Daemon(config, 1, make_estimator, Path(), periods=often)

    async def ask_clocks() -> None:
        nonlocal asked
        asked += 1
        daemon._on_packet("cl/v1/test/agent/002/clock", b"", time.monotonic(), 0)

    daemon.radio.ask_clocks = ask_clocks  # type: ignore[method-assign]
    running = asyncio.create_task(daemon.run())
    await until(lambda: daemon.core.counters["ticks"] > 2, "a tick")
    # WHEN the core fails at whatever it is asked, and the system's clock steps every time
    core = daemon.onboard

    def fails(*_: Any, **__: Any) -> Any:
        raise RuntimeError("a bug in the core")

    with monkeypatch.context() as broken:
        for name in ("advance", "on_packet", "on_gone", "on_uwb", "on_mavlink"):
            broken.setattr(core, name, fails)
        broken.setattr(core, "keep_house", lambda **_: [ClockStepped()])
        asked = 0
        daemon._on_packet("cl/v1/test/agent/002/meas", b"", 0.0, 0)
        daemon._on_gone(2)
        daemon._on_uwb(b"", 0.0)
        assert not daemon._on_mavlink(b"")
        await until(lambda: asked > 3, "housekeeping that goes on")
        assert not running.done()
    # THEN all of it is counted, each kind said once, and the flight goes on as soon as the core does
    ticks, faults = daemon.core.counters["ticks"], daemon.state().counters["program faults"]
    assert faults > 10
    assert len([record for record in caplog.records if record.exc_info]) == 1
    await until(lambda: daemon.core.counters["ticks"] > ticks + 2, "further ticks")
    daemon.stop()
    await asyncio.wait_for(running, PATIENCE_S)
    assert daemon.state().counters["program faults"] == faults


@pytest.mark.parametrize("broken", ["radio", "_link", "state"])
async def test_the_record_gets_its_end_whatever_fails_before_it(
    config_of: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture, broken: str
) -> None:
    # GIVEN a daemon with a record
    ending = Watching(False)
    daemon = Daemon(config_of(1, "security.mode=unsigned"), 1, make_estimator, Path(), (ending,))
    running = asyncio.create_task(daemon.run())
    await until(lambda: ending.estimates > 2, "estimates")

    # WHEN a part of it fails to close (it is closed all the same, for the sake of this test)
    def fails() -> Any:
        raise TimeoutError(110, "Connection timed out")

    if broken == "state":
        daemon.state = fails  # type: ignore[method-assign]
    else:
        part = getattr(daemon, broken)
        close = part.close

        async def close_and_fail() -> None:
            await close()
            fails()

        part.close = close_and_fail
    daemon.stop()
    await asyncio.wait_for(running, PATIENCE_S)
    # THEN that is said, and the observers and the record came to their end
    assert ending.ended
    assert "Connection timed out" in caplog.text
    summary = json.loads((tmp_path / "rec" / "agent_001.json").read_text())
    assert summary["counters"]["program faults"] >= 1
    assert len(read_entries(tmp_path / "rec" / "agent_001.estimates")[1]) > 2


class Watching(Observer):
    """Counts what it is told; raises at every estimate if it is to."""

    def __init__(self, fails: bool) -> None:
        self.fails, self.estimates, self.ended = fails, 0, False
        self.states: list[DaemonState] = []

    def on_estimate(self, ready: Any, published_s: float, tick_time_s: float) -> None:
        self.estimates += 1
        if self.fails:
            raise RuntimeError("no metrics today")

    def on_second(self, state: DaemonState) -> None:
        self.states.append(state)

    async def close(self, state: DaemonState) -> None:
        self.ended = True
        if self.fails:
            raise RuntimeError("no end either")


@pytest.mark.parametrize("cause", ["folder", "disk", "threads", "given"])
async def test_without_a_record_a_daemon_flies_and_says_so(
    config_of: Any, caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cause: str
) -> None:
    # GIVEN a folder, a disk or a system that takes no record, or one that could not be put aside
    (tmp_path / "file").write_text("")
    folder = tmp_path / ("file" if cause == "folder" else "rec")
    if cause == "disk":
        monkeypatch.setattr("agent.log.run_logs.too_little_left", lambda *_: "the disk has 12 MB left")
    if cause == "threads":
        monkeypatch.setattr(FlightLog, "_start_thread", _no_threads)
    config = config_of(1, "security.mode=unsigned", f'record.directory="{folder}"')
    words = {"given": "earlier record in the way", "threads": "no thread", "disk": "12 MB", "folder": "cannot be"}
    with caplog.at_level(logging.ERROR, "fleetloc.agent"):
        given = words["given"] if cause == "given" else ""
        daemon = Daemon(config, 1, make_estimator, Path(), unrecorded=given)
    running = asyncio.create_task(daemon.run())
    # THEN ticks come, and health and log say why there is no record
    await until(lambda: daemon.core.counters["ticks"] > 5, "ticks")
    await until(lambda: "not recorded: " in str(daemon.core.health.health), "the reason")
    assert words[cause] in str(daemon.core.health.health)
    daemon.stop()
    await asyncio.wait_for(running, PATIENCE_S)
    (line,) = [record.getMessage() for record in caplog.records if "flying without a record" in record.getMessage()]
    assert words[cause] in line
    assert not list(tmp_path.glob("rec/*.json"))


async def test_a_disk_that_fills_up_in_flight_is_told_and_flown_on_with(config_of: Any, tmp_path: Path) -> None:
    free = [1e9]
    config = config_of(1, "security.mode=unsigned", f'record.directory="{tmp_path / "rec"}"')
    daemon = Daemon(config, 1, make_estimator, Path())
    daemon._record._free = lambda _: free[0]  # type: ignore[union-attr,assignment,return-value]
    running = asyncio.create_task(daemon.run())
    await until(lambda: daemon.core.counters["ticks"] > 5, "ticks")
    free[0] = 1e7
    await until(lambda: "not recorded: the disk has 10 MB left" in str(daemon.core.health.health), "the reason")
    ticks = daemon.core.counters["ticks"]
    await until(lambda: daemon.core.counters["ticks"] > ticks + 5, "more ticks")
    daemon.stop()
    await asyncio.wait_for(running, PATIENCE_S)
    _, entries = read_entries(tmp_path / "rec" / "agent_001.estimates")
    assert 5 < len(entries) < daemon.core.counters["ticks"]


def _no_threads(_log: FlightLog) -> None:
    raise RuntimeError("can't start new thread")


async def test_observers_are_told_and_cannot_hurt(config_of: Any, caplog: pytest.LogCaptureFixture) -> None:
    # GIVEN a daemon with an observer that fails and one that does not
    failing, good = Watching(True), Watching(False)
    config = config_of(1, "security.mode=unsigned")
    daemon = Daemon(config, 1, make_estimator, Path(), (failing, good))
    running = asyncio.create_task(daemon.run())
    await until(lambda: good.estimates > 5 and len(good.states) > 0, "estimates and a second")
    daemon.stop()
    await asyncio.wait_for(running, PATIENCE_S)
    # THEN both were told, the fault is counted and said, and the daemon went on to its end
    assert abs(failing.estimates - good.estimates) <= 1
    assert good.ended
    assert good.states[-1].counters["program faults"] > 0
    assert "no metrics today" in caplog.text
    assert "no end either" in caplog.text
    summary = json.loads(next(Path(str(config.record.directory)).glob("*.json")).read_text())
    assert summary["counters"]["record entries"] > 0


async def test_estimates_and_diagnostics_are_there_for_a_monitor(config_of: Any) -> None:
    config = config_of(1, "security.mode=unsigned")
    daemon = Daemon(config, 1, make_estimator, Path())
    running = asyncio.create_task(daemon.run())
    opener, seen = Opener(config.fleet.name, config.ids, UNSIGNED), set()

    def on_sample(key: str, payload: bytes, arrived_s: float) -> None:
        received = opener.open(key, payload, now=arrived_s, unix_ns=time.time_ns())
        assert received is not None
        seen.add(type(received.message))

    settings = SessionSettings(connect=config.listen(1))
    session = await open_session(settings, config.fleet.name, None, config.ids, Handlers(on_sample))
    session.subscribe(1, (Stream.EST, Stream.DIAG))
    session.announce()
    await until(lambda: seen == {FleetEstimate, Diagnostics}, "both streams")
    await session.close()
    daemon.stop()
    await asyncio.wait_for(running, PATIENCE_S)


def check_records(directory: Path) -> None:
    for agent_id in (1, 2):
        header, entries = read_entries(directory / f"agent_{agent_id:03d}.estimates")
        assert (header.agent, header.agents) == (agent_id, (1, 2))
        assert (entries["tick"][1:] - entries["tick"][:-1] == 1).all()
        assert (entries["status"] == Status.OK).any()
        summary = json.loads((directory / f"agent_{agent_id:03d}.json").read_text())
        assert summary["counters"]["packets received"] > 10
        assert summary["counters"]["program faults"] == 0
        assert 0 < summary["gauges"]["rss_mb"] < 1000
        assert summary["gauges"]["tick_time_p50_s"] < 0.1


SCRIPT = """
import sys
from agent.config.reading import load_config
from agent.daemon import run
from agent.watch.log_lines import configure_logging
from estimators.factory import make_estimator
configure_logging(1)
sys.exit(run(load_config(sys.argv[1]), 1, make_estimator))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_a_signal_ends_the_process_cleanly(config_of: Any, tmp_path: Path, number: int) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text(dump(config_of(1)))
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        SCRIPT,
        str(path),
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert process.stderr is not None
    first = await asyncio.wait_for(process.stderr.readline(), PATIENCE_S)
    assert b"listening on udpin:127.0.0.1" in first
    await asyncio.wait_for(process.stderr.readline(), PATIENCE_S)  # its first state: it runs
    process.send_signal(number)
    _, rest = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert process.returncode == ExitCode.OK
    assert b"Traceback" not in rest
    assert (tmp_path / "rec" / "agent_001.json").exists()
