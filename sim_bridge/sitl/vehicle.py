"""One simulated autopilot's links: its bytes go on to the daemon and to clients as they came, and theirs to it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from agent.config.endpoints import LinkKind
from agent.config.tables import FleetConfig
from agent.mavlink.codec import Decoder, mavlink
from agent.mavlink.link import create_link
from sim_bridge.autopilot.udp_autopilot import AutopilotPort, open_port
from sim_bridge.sitl.frames import FrameSplitter, message_id, split_datagram
from sim_bridge.sitl.ports import ClientPort, open_client_port
from sim_bridge.sitl.session import SitlSession, TimedTruth, describe
from sim_bridge.sitl.setup import LOCAL_HOST, VehicleLinks

GPS_MESSAGES = frozenset({mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_GPS2_RAW})
"""What a daemon does not get while its GPS is out; the autopilot itself keeps it, and flies on."""

NOBODY = "nobody there"


@dataclass(frozen=True, slots=True)
class VehicleReport:
    """How the relay of one vehicle went."""

    id: int
    simulator: str
    autopilot: str | None
    truths: int
    truths_ignored: dict[str, int]
    max_truth_gap_s: float
    reboots: int
    clock_rtt_s: float | None
    bytes_from_simulator: int
    bytes_from_daemon: int
    bytes_from_clients: int
    frames_bad: dict[str, int]
    frames_lost: int
    gps_frames_withheld: int
    send_errors: int


class SitlVehicle:
    """The links of one vehicle; open it once, close it once.

    ``on_truth(agent, truth)`` takes what its simulator says; ``gps_out(agent)`` says whether its daemon gets no GPS.
    """

    def __init__(
        self,
        config: FleetConfig,
        links: VehicleLinks,
        on_truth: Callable[[int, TimedTruth], None],
        gps_out: Callable[[int], bool],
    ) -> None:
        self.links = links
        self.agent_id = links.agent_id
        datagrams = links.simulator.kind in (LinkKind.UDP_IN, LinkKind.UDP_OUT)
        self.session = SitlSession(config, links.agent_id, datagrams=datagrams)
        self._system = config.system_id(links.agent_id)
        self._link = create_link(links.simulator, self._on_simulator)
        self._splitter = None if datagrams else FrameSplitter()
        self._opened = 0
        self._on_truth, self._gps_out = on_truth, gps_out
        self._from_daemon = Decoder(datagrams=True)
        self._daemon: AutopilotPort | None = None
        self._clients: ClientPort | None = None
        self._received_bytes = self._daemon_bytes = self._client_bytes = 0
        self._withheld = 0

    @property
    def daemon_there(self) -> bool:
        """Whether the daemon has sent a frame."""
        return self._from_daemon.received > 0

    async def open(self) -> None:
        """Open all links; raises `PortError` or `LinkError` for one that cannot be had."""
        gcs = self.links.gcs
        listeners = () if gcs is None else ((gcs.host, gcs.port),)
        self._daemon = await open_port(self.links.daemon, self._on_daemon)
        self._clients = await open_client_port(LOCAL_HOST, self.links.client_port, self._on_client, listeners)
        await self._link.open()

    async def close(self) -> None:
        """Close what is open."""
        for port in (self._daemon, self._clients):
            if port is not None:
                port.close()
        await self._link.close()

    def serve(self, now_s: float) -> None:
        """Send the bridge's own frames that are due."""
        for frame in self.session.to_send(now_s):
            self._link.send(frame)

    def has_gps_off(self) -> bool:
        """Whether its autopilot's GPS is switched off by us."""
        return self.session.receiver is not None and self.session.receiver.is_off

    def missing(self) -> str | None:
        """What this simulator still owes, for people; ``None`` once it has told a truth."""
        session = self.session
        if session.truths:
            return None
        if session.flavour is not None:
            why = ", ".join(session.tap.ignored)
            return f"{self.links.name}: no ground truth yet" + (f" ({why})" if why else "")
        if self._received_bytes:
            heard = describe(session.ignored)
            return f"{self.links.name}: expected heartbeats of system id {self._system}, heard {heard}"
        return f"{self.links.name}: {'connected, but silent' if self._link.peer else NOBODY}"

    def _on_simulator(self, data: bytes) -> bool:
        now_s = time.monotonic()
        self._received_bytes += len(data)
        if self._splitter is not None and self._link.opened != self._opened:
            self._opened = self._link.opened
            self._splitter.reset()  # the connection was dialled again in the middle of a frame
            self.session.reconnected(now_s)
        before = self.session.decoder.received
        for truth in self.session.receive(data, now_s):
            self._on_truth(self.agent_id, truth)
        chunks = split_datagram(data) if self._splitter is None else self._splitter.feed(data)
        self._pass_on(chunks)
        return self.session.decoder.received > before

    def _pass_on(self, chunks: list[bytes]) -> None:
        assert self._daemon is not None
        assert self._clients is not None
        self._clients.send(chunks)
        if self._gps_out(self.agent_id):
            passed = [chunk for chunk in chunks if message_id(chunk) not in GPS_MESSAGES]
            self._withheld += len(chunks) - len(passed)
            chunks = passed
        self._daemon.send(chunks)

    def _on_daemon(self, data: bytes) -> tuple[list[bytes], bool]:
        self._daemon_bytes += len(data)
        self._link.send(data)
        return [], bool(self._from_daemon.feed(data))

    def _on_client(self, data: bytes) -> None:
        self._client_bytes += len(data)
        self._link.send(data)

    def report(self, max_truth_gap_s: float) -> VehicleReport:
        """How it went so far."""
        session = self.session
        ports = [port for port in (self._daemon, self._clients) if port is not None]
        return VehicleReport(
            id=self.agent_id,
            simulator=str(self.links.simulator),
            autopilot=session.flavour,
            truths=session.truths,
            truths_ignored=dict(session.tap.ignored),
            max_truth_gap_s=max_truth_gap_s,
            reboots=session.reboots,
            clock_rtt_s=session.clock.rtt_s,
            bytes_from_simulator=self._received_bytes,
            bytes_from_daemon=self._daemon_bytes,
            bytes_from_clients=self._client_bytes,
            frames_bad=dict(session.decoder.bad),
            frames_lost=session.decoder.lost,
            gps_frames_withheld=self._withheld,
            send_errors=self._link.dropped + sum(port.send_errors for port in ports),
        )
