"""What of the daemons' packets reached whom and how late, out of their flight logs (one machine, one clock)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from agent.errors import LogFileError
from agent.inputs import PacketIn
from agent.log.flight_reader import FlightReader, RecordedInput
from fleetloc.run import run_files
from transport.link.streams import Stream, parse_key
from transport.messages.header import Header, PacketKind, fleet_hash, unpack_header

KIND_OF = {Stream.MEAS: PacketKind.MEAS, Stream.INFO: PacketKind.INFO}
MCAP = ".mcap"


@dataclass(slots=True)
class Pair:
    """One directed pair: packets heard, their ages at arrival, and when the first came."""

    seen: set[tuple[PacketKind, int]] = field(default_factory=set)
    ages_s: list[float] = field(default_factory=list)
    sent_s: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Delivery:
    """Of all directed pairs, in a span of UTC seconds; ``share`` by (sender, receiver)."""

    share: dict[tuple[int, int], float]
    ages_s: list[float]
    sent_s: list[float]
    """When the packets of these ages were sent, UTC."""
    first_s: dict[tuple[int, int], float]
    """When the first packet of a pair came, s since the begin of the span; infinite = never."""

    @property
    def dead(self) -> int:
        """Pairs that never got anything."""
        return sum(share == 0.0 for share in self.share.values())

    @property
    def mean(self) -> float:
        return float(np.mean(list(self.share.values())))

    def age_s(self, percent: float) -> float:
        return float(np.percentile(self.ages_s, percent)) if self.ages_s else np.inf


def delivery(directory: Path, pairs: list[tuple[int, int]], begin_s: float, end_s: float) -> Delivery:
    """Measurement and information packets that were sent from ``begin_s`` to ``end_s``.

    How many were sent follows from the sequence numbers: the rate of a sender is what its receivers saw of it.
    """
    heard = {pair: Pair() for pair in pairs}
    for receiver in {receiver for _, receiver in pairs}:
        for header, age_s in _packets(directory, receiver):
            pair = heard.get((header.sender, receiver))
            if pair is None or not begin_s <= header.t_ns * 1e-9 < end_s:
                continue
            number = (header.kind, header.seq)
            if number not in pair.seen:
                pair.seen.add(number)
                pair.ages_s.append(age_s)
                pair.sent_s.append(header.t_ns * 1e-9)
    sent = {sender: _numbers_sent(heard, sender) for sender in {sender for sender, _ in pairs}}
    share = {
        pair: len(found.seen & sent[pair[0]]) / len(sent[pair[0]]) if sent[pair[0]] else 0.0
        for pair, found in heard.items()
    }
    first_s = {
        pair: min((t + age for t, age in zip(found.sent_s, found.ages_s, strict=True)), default=np.inf) - begin_s
        for pair, found in heard.items()
    }
    ages_s = [age for found in heard.values() for age in found.ages_s]
    sent_s = [t for found in heard.values() for t in found.sent_s]
    return Delivery(share, ages_s, sent_s, first_s)


def heard_so_far(directory: Path, receiver: int) -> set[int]:
    """Whom a running daemon has heard, by what of its flight log is on the disk."""
    try:
        return {header.sender for header, _ in _packets(directory, receiver)}
    except LogFileError:  # its head is not there yet
        return set()


def _numbers_sent(heard: dict[tuple[int, int], Pair], sender: int) -> set[tuple[PacketKind, int]]:
    """All numbers between the first and the last that anybody heard of a sender."""
    numbers: set[tuple[PacketKind, int]] = set()
    for kind in PacketKind:
        seen = [seq for (who, _), pair in heard.items() if who == sender for k, seq in pair.seen if k is kind]
        numbers |= {(kind, seq) for seq in range(min(seen, default=0), max(seen, default=-1) + 1)}
    return numbers


def _packets(directory: Path, agent_id: int) -> list[tuple[Header, float]]:
    """Header and age at arrival of what an agent got of its neighbours, unsigned."""
    found = []
    for entry in FlightReader(run_files.record_path(directory, agent_id).with_suffix(MCAP)):
        if not isinstance(entry, RecordedInput) or not isinstance(entry.event, PacketIn):
            continue
        event, parsed = entry.event, parse_key(entry.event.key)
        if parsed is None or parsed[2] not in KIND_OF:
            continue
        header = unpack_header(event.data, fleet=fleet_hash(parsed[0]), signed=False)
        arrived_s = event.unix_ns * 1e-9 - (event.host_s - event.arrived_s)
        found.append((header, arrived_s - header.t_ns * 1e-9))
    return found
