"""What is known of each neighbour's link: received, lost, refused, age, clock offset; sans-I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from transport.errors import Reason, RejectionCounter
from transport.messages.clock_body import ClockAnswer
from transport.messages.header import Header, PacketKind

CLOCK_SAMPLES = 30
CLOCK_BEST_SHARE = 0.2
TWIN_NS = 2_000_000_000
"""Packets of an earlier start so long after the present one began, and no older than that, are of a second daemon."""


class ClockFilter:
    """Offset of a neighbour's clock from four times, after the samples with the shortest round trips.

    Queues only ever lengthen a round trip, and mostly one way; the fastest fifth of the last 30 questions
    is close to symmetric.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque(maxlen=CLOCK_SAMPLES)

    def add(self, answer: ClockAnswer, returned_ns: int) -> None:
        """Note an answer that came back at ``returned_ns`` on our clock; an impossible one is ignored."""
        away = answer.answered_ns - answer.received_ns
        round_trip_ns = returned_ns - answer.asked_ns - away
        if round_trip_ns < 0:
            return  # our clock was set back while we waited
        offset_ns = ((answer.received_ns - answer.asked_ns) + (answer.answered_ns - returned_ns)) / 2
        self._samples.append((round_trip_ns * 1e-9, offset_ns * 1e-9))

    def _best(self) -> list[tuple[float, float]]:
        return sorted(self._samples)[: max(1, round(CLOCK_BEST_SHARE * len(self._samples)))]

    @property
    def offset_s(self) -> float | None:
        """Neighbour's clock minus ours; ``None`` before the first answer."""
        best = self._best()
        return sum(offset for _, offset in best) / len(best) if best else None

    @property
    def round_trip_s(self) -> float | None:
        """Mean of the shortest round trips; ``None`` before the first answer."""
        best = self._best()
        return sum(trip for trip, _ in best) / len(best) if best else None


@dataclass(slots=True)
class _Numbers:
    """Sequence numbers of one kind since the sender's start."""

    first: int
    newest: int
    received: int

    @property
    def lost(self) -> int:
        return self.newest - self.first + 1 - self.received


class Peer:
    """Counters of one neighbour. ``clock`` is fed by the agent."""

    def __init__(self) -> None:
        self.received = 0
        self.restarts = 0
        self.rejections = RejectionCounter()
        self.clock = ClockFilter()
        self.last_received_s: float | None = None
        self.disagreed_s: float | None = None
        """When it last said, well signed, that it shares something else with the fleet than we do."""
        self.version: tuple[int, float] | None = None
        """Another version of the packets under its key, and when; no signature was looked at."""
        self.twin_s: float | None = None
        """When it last turned out that two daemons send under its id."""
        self._begun_ns = self._newest_ns = 0
        """Sending time of the first packet since its start, and of the newest."""
        self._boot: int | None = None
        self._numbers: dict[PacketKind, _Numbers] = {}
        self._lost_before = 0

    @property
    def lost(self) -> int:
        """Packets missing in the sequence numbers so far; one that is only late is no longer counted then."""
        return self._lost_before + sum(numbers.lost for numbers in self._numbers.values())

    def age_s(self, now: float) -> float | None:
        """Time since the last packet accepted; ``None`` if there was none."""
        return None if self.last_received_s is None else max(0.0, now - self.last_received_s)

    def accepted(self, header: Header, now: float) -> None:
        """Note a packet that was accepted at ``now``; boots never go back (`transport.replay`)."""
        if self._boot is None or header.boot > self._boot:
            self.restarts += self._boot is not None
            self._boot = header.boot
            self._lost_before = self.lost
            self._numbers.clear()
            self._begun_ns = header.t_ns
        self.received += 1
        self.last_received_s = now
        self._newest_ns = max(self._newest_ns, header.t_ns)
        if header.kind is PacketKind.CLOCK:
            return  # answers go to whoever asked: the numbers between are other neighbours', not lost
        numbers = self._numbers.setdefault(header.kind, _Numbers(header.seq, header.seq, 0))
        numbers.received += 1
        numbers.first = min(numbers.first, header.seq)
        numbers.newest = max(numbers.newest, header.seq)

    def of_earlier_start(self, header: Header, now: float) -> None:
        """Note an authentic packet of a start before the present one.

        The present start began later than any packet of an earlier one was sent, unless both are there: then what the
        earlier one sends is as new as what comes of the present one. Packets that are played back are not.
        """
        after_begin_ns, behind_ns = header.t_ns - self._begun_ns, self._newest_ns - header.t_ns
        if self._boot is not None and after_begin_ns > TWIN_NS and behind_ns < TWIN_NS:
            self.twin_s = now

    def as_dict(self, now: float) -> dict[str, float]:
        """Gauges and counters for a report; what is not known is left out."""
        gauges = {
            "age_s": self.age_s(now),
            "clock_offset_s": self.clock.offset_s,
            "round_trip_s": self.clock.round_trip_s,
        }
        counters = {
            "received": self.received,
            "lost": self.lost,
            "restarts": self.restarts,
            "rejected": self.rejections.total,
        }
        return {**counters, **{name: value for name, value in gauges.items() if value is not None}}


class PeerTable:
    """All neighbours that may be heard, and the packets that no neighbour can be named for."""

    def __init__(self, agent_ids: Iterable[int]) -> None:
        self._peers = {agent_id: Peer() for agent_id in sorted(agent_ids)}
        self.unattributed = RejectionCounter()
        """Refused packets whose key names nobody we know."""

    def __getitem__(self, agent_id: int) -> Peer:
        return self._peers[agent_id]

    def __contains__(self, agent_id: int) -> bool:
        return agent_id in self._peers

    def items(self) -> Iterable[tuple[int, Peer]]:
        """Ids and peers, by id."""
        return self._peers.items()

    def accepted(self, header: Header, now: float) -> None:
        """Note a packet that was accepted at ``now``; its sender is in the table."""
        self._peers[header.sender].accepted(header, now)

    def of_earlier_start(self, header: Header, now: float) -> None:
        """Note an authentic packet of a start before the present one; its sender is in the table."""
        self._peers[header.sender].of_earlier_start(header, now)

    def disagrees(self, agent_id: int, now: float) -> None:
        """Note that an agent shares something else with the fleet than we do."""
        self._peers[agent_id].disagreed_s = now

    def speaks_version(self, agent_id: int, version: int, now: float) -> None:
        """Note a packet of another version under an agent's key."""
        if agent_id in self._peers:
            self._peers[agent_id].version = version, now

    def rejected(self, agent_id: int | None, reason: Reason, times: int = 1) -> None:
        """Note packets refused under an agent's key (whoever really sent them)."""
        peer = None if agent_id is None else self._peers.get(agent_id)
        (self.unattributed if peer is None else peer.rejections).count(reason, times)

    def rejections(self) -> dict[str, int]:
        """All refused packets by reason."""
        total = RejectionCounter()
        for counter in (self.unattributed, *(peer.rejections for peer in self._peers.values())):
            for reason, times in counter.as_dict().items():
                total.count(Reason(reason), times)
        return total.as_dict()
