"""A hostile peer against a running daemon: what is refused and counted, and what it costs; see docs/results.md.

``python -m tests.fleet.fuzz_daemon --packets 100000 --datagrams 100000 --seed 0`` from the root of the repository
flies line3, its third drone on a circle, with signed packets on free loopback ports and fuzzes agent 2, in the
middle of the line, over a real Zenoh session and over its MAVLink port. Everything sent has to be found again in the
daemon's own counters, and no drone's position may be further off than its covariance says.
"""

from __future__ import annotations

import argparse
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

from agent.config.endpoints import parse_endpoint
from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from fleetloc.output import print_table, write_json
from fleetloc.report.fleet_results import load_results
from fleetloc.run import run_files
from fleetloc.run.processes import resident_mb
from tests.fleet.fuzz_traffic import (
    CAPTURED_FOR_S,
    HEARD,
    NEIGHBOURS,
    NEVER_ARRIVE,
    REJECTED,
    REJECTED_UWB,
    TARGET,
    UNHEARD,
    Captured,
    Datagram,
    DatagramMaker,
    PacketMaker,
)
from tests.support.fleet_process import FleetProcess, on_free_ports, until, with_overrides
from tests.support.own_error import SMOOTH_PATHS, own_nees, own_position_complaints
from transport.link.session_settings import SessionSettings, zenoh_config
from transport.link.streams import Stream, key_expression, parse_key
from transport.messages.header import HEADER_BYTES, SIGNATURE_BYTES
from transport.messages.report_body import Diagnostics, decode_diagnostics
from transport.security.keys import init_keys

BURST_S, ROOM_BYTES = 0.005, 64 * 1024
"""More is sent while less than this, a third of what Linux allows by default, waits in the daemon's socket."""
SETTLE_S, DRAIN_S = 2 * CAPTURED_FOR_S, 3.0
MAX_GROWTH_MB, MIN_ON_TIME = 8.0, 0.95
SHARED = "timesync rejected"
"""The autopilot's own answers are counted here too, if they take long on a busy machine: one question a second."""
STALE_UWB = "rejected uwb stale"
AGES = ("uwb unusable", "skipped uwb not a neighbour")
"""What is wrong with these range frames is seen only if they arrive while they are fresh."""
FLIGHT_S = 240.0
"""Longer than any attack: the fleet is interrupted when it has been measured."""


@dataclass(slots=True)
class Attack:
    """What was sent, and what was seen meanwhile; times are UTC in s."""

    packets: Counter[str] = field(default_factory=Counter)
    datagrams: Counter[str] = field(default_factory=Counter)
    expected: Counter[str] = field(default_factory=Counter)
    """What the daemon's counters have to have grown by, by name."""
    before: dict[str, int] = field(default_factory=dict)
    after: dict[str, int] = field(default_factory=dict)
    begin_s: float = 0.0
    end_s: float = 0.0
    resident_mb: list[float] = field(default_factory=list)
    """Of the daemon, about once a second, from before the attack to after it."""
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

    def counters(self) -> dict[str, int]:
        """What the daemon counted, in a report that is made after this call."""
        heard = len(self._reports)
        until(lambda: len(self._reports) > heard, "diagnostics of the fuzzed daemon", 30.0)
        return dict(self._reports[-1].counters)

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


def socket_of(port: int) -> tuple[int, int]:
    """Of the UDP socket bound to a port of this machine: bytes that wait in it, datagrams dropped so far."""
    for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]:
        fields = line.split()
        if int(fields[1].rpartition(":")[2], 16) == port:
            return int(fields[4].rpartition(":")[2], 16), int(fields[-1])
    raise AssertionError(f"no UDP socket on port {port}")


@contextmanager
def sampled_memory(pid: int, samples: list[float]) -> Iterator[None]:
    """Note a process's resident memory once a second meanwhile."""
    done = threading.Event()

    def watch() -> None:
        while not done.wait(1.0):
            samples.append(resident_mb(pid) or float("nan"))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def send_all(
    peer: HostilePeer, config: FleetConfig, packets: int, datagrams: list[Datagram], duration_s: float, seed: int
) -> Attack:
    """Send everything, evenly over the time, in small bursts; a daemon that lags is waited for.

    A datagram that finds the socket full is lost before the daemon could count it, and nothing is learned from it.
    """
    attack, endpoint = Attack(), parse_endpoint(config.agent(TARGET).mavlink)
    maker = PacketMaker(config.fleet.name, peer.captured, np.random.default_rng(seed))
    shots = maker.make(packets)
    bursts = max(round(duration_s / BURST_S), 1)
    begin_s, sent_packets, sent_datagrams = time.monotonic(), 0, 0
    attack.begin_s = time.time()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        for burst in range(1, bursts + 1):
            while sent_packets < packets * burst // bursts:
                name, (key, payload) = next(shots)
                peer.put(key, payload)
                attack.packets[name] += 1
                sent_packets += 1
            until(lambda: socket_of(endpoint.port)[0] < ROOM_BYTES, "a daemon that reads its socket", 60.0)
            while sent_datagrams < len(datagrams) * burst // bursts:
                datagram = datagrams[sent_datagrams]
                udp.sendto(datagram.data, (endpoint.host, endpoint.port))
                attack.datagrams[datagram.kind] += 1
                attack.expected.update(datagram.counts)
                sent_datagrams += 1
            time.sleep(max(begin_s + burst * duration_s / bursts - time.monotonic(), 0.0))
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
        with sampled_memory(fleet.pid_of(TARGET), memory_mb):
            time.sleep(SETTLE_S)
            before, (_, drops) = peer.counters(), socket_of(port)
            attack = send_all(peer, config, packets, datagrams, duration_s, seed)
            time.sleep(DRAIN_S)
            attack.before, attack.after = before, peer.counters()
            attack.socket_drops = socket_of(port)[1] - drops
            attack.unheard_matched = peer.unheard_matched()
        attack.resident_mb = memory_mb
    finally:
        peer.close()
    return attack


# --- what has to hold ---------------------------------------------------------------------------------------


def grown(attack: Attack) -> Counter[str]:
    """By how much the daemon's counters grew, the rejected packets also summed."""
    delta = Counter({name: n - attack.before.get(name, 0) for name, n in attack.after.items()})
    delta[REJECTED_UWB] = sum(n for name, n in delta.items() if name.startswith("rejected uwb "))
    rejected = (n for name, n in delta.items() if name.startswith("rejected ") and not name.startswith(REJECTED_UWB))
    delta[REJECTED] = sum(rejected)
    return delta


def figures(config: FleetConfig, fleet: FleetProcess, attack: Attack) -> dict[str, Any]:
    """What the run's files and counters tell, machine-readable."""
    results = load_results(config, fleet.out)
    begin_s, end_s = (t - results.start_unix_s for t in (attack.begin_s, attack.end_s))
    agents = []
    for track in results.tracks:
        inside = (track.time_s >= begin_s) & (track.time_s < end_s)
        error_m = np.linalg.norm(track.own_error_m[inside & track.known], axis=1)
        squared = own_nees(config, fleet.out, track.agent_id, attack.begin_s, attack.end_s)
        expected = int((end_s - begin_s) / results.period_s)
        agents.append(
            {
                "id": track.agent_id,
                "ticks_expected": expected,
                "ticks_made": int(np.count_nonzero(inside)),
                "ticks_on_time": int(np.count_nonzero(track.on_time & inside)),
                "ticks_without_estimate": int(np.count_nonzero(~track.known & inside)),
                "late_packets": late_packets(fleet, track.agent_id),
                "all_finite": bool(np.isfinite(track.full_error).all() and np.isfinite(track.own_sigma_m).all()),
                "position_rmse_m": float(np.sqrt(np.mean(error_m**2))),
                "own_nees_mean": float(squared.mean()),
                "own_nees_worst": float(squared.max()),
                "own_position_complaints": own_position_complaints(f"agent {track.agent_id}", squared),
                "log_has_traceback": "Traceback" in fleet.log(track.agent_id),
            }
        )
    delta, mb = grown(attack), attack.resident_mb
    return {
        "duration_s": attack.end_s - attack.begin_s,
        "packets": {"sent": attack.packets.total(), "by_class": dict(attack.packets)},
        "datagrams": {"sent": attack.datagrams.total(), "by_class": dict(attack.datagrams)},
        "counters": {name: {"expected": n, "found": delta[name]} for name, n in sorted(attack.expected.items())},
        "rejected_by_reason": {n: v for n, v in sorted(delta.items()) if n.startswith("rejected ") and v},
        "packets_shed": delta["packets shed"],
        "packets_lost_of_neighbours": delta["packets lost"],
        "program_faults": delta["program faults"],
        "reboots": delta["mavlink reboots"],
        "socket_drops": attack.socket_drops,
        "unheard_streams_matched": attack.unheard_matched,
        "resident_mb_before": mb[int(SETTLE_S) - 2],
        "resident_mb_after": mb[-1],
        "resident_mb": mb,
        "agents": agents,
    }


def late_packets(fleet: FleetProcess, agent_id: int) -> int:
    """Of neighbours, in the whole run: too late for their tick, so used for a later one or not at all."""
    summary = run_files.record_path(fleet.out, agent_id).with_suffix(run_files.SUMMARY_SUFFIX)
    counters = msgspec.json.decode(summary.read_bytes())["counters"]
    return sum(int(counters.get(f"{kind}: late", 0)) for kind in ("measurements", "information"))


def complaints(result: dict[str, Any]) -> list[str]:
    """What does not hold; empty for a daemon that withstood."""
    found = []
    counted = {name: dict(counts) for name, counts in result["counters"].items()}
    found += settle_aged(counted, result["rejected_by_reason"].get(STALE_UWB, 0))
    for name, counts in counted.items():
        excess = counts["found"] - counts["expected"]
        may_exceed = 2.0 * result["duration_s"] + 20 if name == SHARED else 0
        if name not in NEVER_ARRIVE and not 0 <= excess <= may_exceed:
            found.append(f"{name}: expected {counts['expected']}, counted {counts['found']}")
    for name in ("packets_shed", "packets_lost_of_neighbours", "program_faults", "reboots", "socket_drops"):
        if result[name]:
            found.append(f"{name}: {result[name]}")
    if result["unheard_streams_matched"]:
        found.append("a stream that no daemon should listen to has a subscriber")
    growth_mb = result["resident_mb_after"] - result["resident_mb_before"]
    if growth_mb > MAX_GROWTH_MB:
        found.append(f"resident memory grew by {growth_mb:.1f} MB, at most {MAX_GROWTH_MB:g} allowed")
    for agent in result["agents"]:
        who = f"agent {agent['id']}"
        if not agent["all_finite"] or agent["ticks_without_estimate"]:
            found.append(f"{who}: estimates missing or not finite")
        found += agent["own_position_complaints"]
        if agent["ticks_made"] < agent["ticks_expected"] - 1:
            found.append(f"{who}: {agent['ticks_made']} of {agent['ticks_expected']} ticks made")
        if agent["log_has_traceback"]:
            found.append(f"{who}: a traceback in its log")
    return found


def settle_aged(counted: dict[str, dict[str, int]], stale: int) -> list[str]:
    """Count the fresh range frames that grew stale on their way to a busy daemon as what they were sent as.

    Such a frame is refused for its age before what is wrong with it is seen: as many are missing from the counters
    of `AGES` as there are too many among the refused, and each of those was counted as stale.
    """
    aged = counted[REJECTED_UWB]["found"] - counted[REJECTED_UWB]["expected"]
    missing = {name: counted[name]["expected"] - counted[name]["found"] for name in AGES if name in counted}
    if aged == sum(missing.values()) and min(missing.values(), default=0) >= 0 and aged <= stale:
        for name in (REJECTED_UWB, *missing):
            counted[name]["found"] = counted[name]["expected"]
        return []
    return [f"range frames: {aged} too many refused, {stale} of all for their age, missing elsewhere: {missing}"]


def lateness(result: dict[str, Any]) -> list[str]:
    """Who was not on time: says something on a machine that does nothing else."""
    return [
        f"agent {agent['id']}: {agent['ticks_on_time']} of {agent['ticks_expected']} ticks on time"
        for agent in result["agents"]
        if agent["ticks_on_time"] < MIN_ON_TIME * agent["ticks_expected"]
    ]


def fuzz(folder: Path, packets: int, datagrams: int, duration_s: float, seed: int) -> dict[str, Any]:
    """One whole run in an empty folder; the figures, with ``complaints``."""
    made = list(DatagramMaker(np.random.default_rng((seed, 1))).make(datagrams))
    init_keys(folder / "keys", (1, 2, 3))
    overrides = [*on_free_ports(3), *SMOOTH_PATHS, "security.mode=signed", f"security.keys={folder / 'keys'}"]
    options = ("--duration", str(FLIGHT_S), "--seed", "1")
    fleet = FleetProcess(folder / "run", *with_overrides(overrides), *options)
    try:
        attack = attack_fleet(fleet, packets, made, duration_s, seed)
        fleet.interrupt()
        code, _, stderr = fleet.finish()
        config = load_config(fleet.out / run_files.CONFIG)
        result = figures(config, fleet, attack)
    finally:
        fleet.clean_up()
    result["exit_code"] = code
    result["complaints"] = complaints(result) + ([f"fleet ended with {code}: {stderr}"] if code else [])
    return result


def show(result: dict[str, Any]) -> None:
    """Tables for people."""
    for what in ("packets", "datagrams"):
        rows = [[name, str(n)] for name, n in result[what]["by_class"].items()]
        print_table([what, "sent"], [*sorted(rows), ["all", str(result[what]["sent"])]])
    rows = [[name, str(c["expected"]), str(c["found"])] for name, c in result["counters"].items()]
    print_table(["counter of the daemon", "expected", "found"], rows)
    print_table(["refused", "packets"], [[name, str(n)] for name, n in result["rejected_by_reason"].items()])
    columns = ["agent", "ticks on time", "RMSE m", "NEES mean", "NEES worst", "late packets"]
    rows = [
        [str(a["id"]), f"{a['ticks_on_time']}/{a['ticks_expected']}", f"{a['position_rmse_m']:.3f}",
         f"{a['own_nees_mean']:.2f}", f"{a['own_nees_worst']:.1f}", str(a["late_packets"])]
        for a in result["agents"]
    ]  # fmt: skip
    print_table(columns, rows)
    rest = ("packets_shed", "packets_lost_of_neighbours", "socket_drops", "program_faults", "reboots",
            "resident_mb_before", "resident_mb_after", "duration_s")  # fmt: skip
    print_table(["", ""], [[name, f"{result[name]:.1f}".removesuffix(".0")] for name in rest])


def main() -> int:
    """The command; the exit code says whether the daemon withstood."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packets", type=int, default=100_000)
    parser.add_argument("--datagrams", type=int, default=100_000)
    parser.add_argument("--duration", type=float, default=60.0, help="seconds that the attack takes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = fuzz(Path(folder), options.packets, options.datagrams, options.duration, options.seed)
    show(result)
    if options.json is not None:
        write_json(options.json, result)
    result["complaints"] += lateness(result)
    for complaint in result["complaints"]:
        sys.stderr.write(f"fuzz_daemon: {complaint}\n")
    return 1 if result["complaints"] else 0


if __name__ == "__main__":
    sys.exit(main())
