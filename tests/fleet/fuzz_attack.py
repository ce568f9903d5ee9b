"""The attack on a running daemon: a hostile peer, what it sends, and what it sees of the daemon's counters meanwhile.

Nothing here waits for a time to pass: the packets that the fleet itself sends say how far an attack has come.
"""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import zenoh
from numpy.random import default_rng

from agent.config.endpoints import parse_endpoint
from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from fleetloc.run import run_files
from fleetloc.run.processes import resident_mb
from tests.fleet.fuzz_traffic import (
    HEARD,
    NEIGHBOURS,
    NEVER_ARRIVE,
    REJECTED,
    REJECTED_UWB,
    TARGET,
    UNHEARD,
    Captured,
    Datagram,
    PacketMaker,
)
from tests.support.fleet_process import FleetProcess, until
from transport.link.session_settings import SessionSettings, zenoh_config
from transport.link.streams import Stream, key_expression, parse_key
from transport.messages.header import HEADER_BYTES, SIGNATURE_BYTES
from transport.messages.report_body import Diagnostics, decode_diagnostics

IN_A_ROW, ROOM_BYTES = 16, 64 * 1024
"""So many are sent at once, if less than this, a third of what Linux allows by default, waits in the socket."""
PATIENCE_S = 60.0
Counts = dict[str, int]


@dataclass(slots=True)
class Attack:
    """What was sent, and what was seen meanwhile; times are UTC in s."""

    packets: Counter[str] = field(default_factory=Counter)
    datagrams: Counter[str] = field(default_factory=Counter)
    expected: Counter[str] = field(default_factory=Counter)
    """What the daemon's counters have to have grown by, by name."""
    before: Counts = field(default_factory=dict)
    after: Counts = field(default_factory=dict)
    before_s: float = 0.0
    begin_s: float = 0.0
    end_s: float = 0.0
    after_s: float = 0.0
    resident_mb: list[float] = field(default_factory=list)
    """Of the daemon: before the attack, about once a second, after it."""
    socket_drops: int = 0
    """Datagrams that the kernel dropped because the daemon's socket was full."""
    unheard_matched: bool = False
    """Whether anybody had subscribed to the streams that no daemon listens to."""


class HostilePeer:
    """A Zenoh session that anyone can open where links are not secured: it hears all, and puts on every key."""

    def __init__(self, config: FleetConfig) -> None:
        self._config = config
        self.captured = Captured()
        self._reports: list[Diagnostics] = []
        endpoints = tuple(endpoint for agent_id in config.ids for endpoint in config.listen(agent_id))
        settings = SessionSettings(connect=endpoints)
        self.session = zenoh.open(zenoh_config(settings, config.fleet.name, None, config.ids))
        keys = [self._key(agent_id, stream) for agent_id in NEIGHBOURS for stream in HEARD]
        remote = zenoh.Locality.REMOTE  # what this peer puts itself is nothing captured
        self._declared = [
            self.session.declare_subscriber(key, self._on_sample, allowed_origin=remote)
            for key in (*keys, self._key(TARGET, Stream.DIAG))
        ]

    def _key(self, agent_id: int, stream: Stream) -> str:
        return key_expression(self._config.fleet.name, agent_id, stream)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        parsed, packet = parse_key(str(sample.key_expr)), sample.payload.to_bytes()
        assert parsed is not None
        if parsed[2] is Stream.DIAG:
            self._reports.append(decode_diagnostics(packet[HEADER_BYTES:-SIGNATURE_BYTES]))
        else:
            self.captured.add(parsed[1], parsed[2], packet)

    def counters(self) -> Counts:
        """What the daemon counted, in a report that is made after this call."""
        heard = len(self._reports)
        until(lambda: len(self._reports) > heard, "diagnostics of the fuzzed daemon", PATIENCE_S)
        return dict(self._reports[-1].counters)

    def counters_of_all(self, before: Counts, expected: Counter[str]) -> Counts:
        """What the daemon counted once it has worked off what was sent, or does not go on with it."""
        names = [name for name in expected if name not in NEVER_ARRIVE]

        def progress(counts: Counts) -> list[int]:
            grown = growth(before, counts)
            return [min(grown[name], expected[name]) for name in names]

        last = self.counters()
        while progress(newer := self.counters()) != progress(last):
            last = newer
        return newer

    def put(self, key: str, payload: bytes) -> None:
        """Put, waiting where the link is congested: whatever is missing later, it was not dropped here."""
        if key == self._key(TARGET, Stream.CLOCK):
            self.session.get(key, lambda _reply: None, payload=payload, timeout=1.0)
        else:
            blocking = zenoh.CongestionControl.BLOCK
            self.session.put(key, payload, congestion_control=blocking, express=True)

    def unheard_matched(self) -> bool:
        """Whether a put on the streams that no daemon listens to would leave this process."""
        keys = (self._key(agent_id, stream) for agent_id in NEIGHBOURS for stream in UNHEARD)
        statuses = [self.session.declare_publisher(key).matching_status for key in keys]
        return any(bool(getattr(status, "matching", status)) for status in statuses)

    def close(self) -> None:
        """Leave."""
        self.session.close()  # type: ignore[no-untyped-call]


def growth(before: Counts, after: Counts) -> Counter[str]:
    """By how much counters grew, the rejected packets also summed."""
    delta = Counter({name: n - before.get(name, 0) for name, n in after.items()})
    delta[REJECTED_UWB] = sum(n for name, n in delta.items() if name.startswith("rejected uwb "))
    rejected = (n for name, n in delta.items() if name.startswith("rejected ") and not name.startswith(REJECTED_UWB))
    delta[REJECTED] = sum(rejected)
    return delta


def socket_of(port: int) -> tuple[int, int]:
    """Of the UDP socket bound to a port of this machine: bytes that wait in it, datagrams dropped so far."""
    for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]:
        fields = line.split()
        if int(fields[1].rpartition(":")[2], 16) == port:
            return int(fields[4].rpartition(":")[2], 16), int(fields[-1])
    raise AssertionError(f"no UDP socket on port {port}")


@contextmanager
def sampled_memory(pid: int, samples: list[float]) -> Iterator[None]:
    """Note a process's resident memory before, once a second meanwhile, and after."""
    done = threading.Event()

    def note() -> None:
        samples.append(resident_mb(pid) or float("nan"))

    def watch() -> None:
        while not done.wait(1.0):
            note()

    note()
    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
        note()
    finally:
        done.set()
        thread.join()


def send_all(
    peer: HostilePeer, config: FleetConfig, packets: int, datagrams: list[Datagram], duration_s: float, seed: int
) -> Attack:
    """Send everything, evenly over the time, some with each packet of the fleet; a daemon that lags is waited for.

    A datagram that finds the socket full is lost before the daemon could count it, and nothing is learned from it.
    """
    attack, endpoint = Attack(begin_s=time.time()), parse_endpoint(config.agent(TARGET).mavlink)
    maker = PacketMaker(config.fleet.name, peer.captured, default_rng(seed))
    shots, waiting = maker.make(packets), iter(datagrams)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        while (sent := attack.packets.total() + attack.datagrams.total()) < packets + len(datagrams):
            share = min((time.time() - attack.begin_s) / duration_s, 1.0)
            put = round(share * packets) - attack.packets.total()
            for name, (key, payload) in (next(shots) for _ in range(min(put, IN_A_ROW))):
                peer.put(key, payload)
                attack.packets[name] += 1
            until(lambda: socket_of(endpoint.port)[0] < ROOM_BYTES, "a daemon that reads its socket", PATIENCE_S)
            due = round(share * len(datagrams)) - attack.datagrams.total()
            for datagram in (next(waiting) for _ in range(min(due, IN_A_ROW))):
                udp.sendto(datagram.data, (endpoint.host, endpoint.port))
                attack.datagrams[datagram.kind] += 1
                attack.expected.update(datagram.counts)
            if sent == attack.packets.total() + attack.datagrams.total():
                peer.captured.wait_for_one(PATIENCE_S)
    attack.end_s = time.time()
    attack.expected.update(maker.expected(attack.packets))
    return attack


def attack_fleet(
    fleet: FleetProcess, packets: int, datagrams: list[Datagram], duration_s: float, seed: int
) -> Attack:
    """Wait until the fleet flies well, attack, wait until the daemon has worked off everything."""
    until(fleet.flying, "flight")
    until(lambda: f"agent {TARGET}: ok" in fleet.log(TARGET), "the daemon is aligned")
    config = load_config(fleet.out / run_files.CONFIG)
    peer, memory_mb = HostilePeer(config), list[float]()
    port = parse_endpoint(config.agent(TARGET).mavlink).port
    try:
        until(peer.captured.enough, "packets to send again", PATIENCE_S)
        with sampled_memory(fleet.pid_of(TARGET), memory_mb):
            before_s, before, (_, drops) = time.time(), peer.counters(), socket_of(port)
            attack = send_all(peer, config, packets, datagrams, duration_s, seed)
            attack.before_s, attack.before = before_s, before
            attack.after, attack.after_s = peer.counters_of_all(before, attack.expected), time.time()
            attack.socket_drops = socket_of(port)[1] - drops
            attack.unheard_matched = peer.unheard_matched()
        attack.resident_mb = memory_mb
    finally:
        peer.close()
    return attack
