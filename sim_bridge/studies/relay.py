"""How measurement records travel between estimators that run tick by tick: who has whose records, and when.

This is a model of the exchange for study inputs that say which packets arrive (`fleetloc estimate`, Table I,
the frozen cases). What daemons exchange is flown in `sim_bridge.studies.flown`.

A packet carries records of an agent's own and, with ``relay_hops``, of others, newest first, cut at what fits
into one datagram. Within a tick packets are exchanged as often as there are consensus rounds, so that a record
moves as many hops in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.settings import EstimatorSettings
from sim_bridge.studies.study_input import StudyInput
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES

BODY_BYTES = MAX_DATAGRAM_BODY_BYTES
"""What a signed packet of 1200 bytes leaves for records."""

POSITION_BYTES, SPEED_BYTES, RANGE_BYTES, ACCEL_BYTES = 32, 16, 18, 22
"""Sizes of records with bounds in `transport.messages.measurement_body`; a test holds them to it."""

AgentTick = tuple[int, int]
"""Slot whose records they are, and the tick they belong to."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """Records of one agent-tick that are new to a receiver."""

    slot: int
    tick: int
    hops: int
    """Links they have travelled: 0 own, 1 from a neighbour's own."""


class MeasurementRelay:
    """The exchange of records of one run."""

    def __init__(self, recording: StudyInput, settings: EstimatorSettings) -> None:
        self._n = len(recording.agents)
        self._reached = recording.received & adjacency(recording)
        self._delay = recording.delay_ticks
        self._hops = settings.relay_hops
        self._exchanges = max(1, settings.rounds) if self._hops else 1
        self._memory = settings.window + 1 if self._hops else 1
        self._bytes = _record_bytes(recording)
        self._known: list[dict[AgentTick, int]] = [{} for _ in range(self._n)]
        self._fresh: list[list[Arrival]] = [[] for _ in range(self._n)]
        self._under_way: dict[tuple[int, int], list[dict[AgentTick, int]]] = {}

    def exchange(self, tick: int) -> list[list[Arrival]]:
        """Run the exchanges of a tick; returns what is new to each agent, its own records included."""
        for slot in range(self._n):
            self._learn(slot, {(slot, tick): 0})
            for packet in self._under_way.pop((tick, slot), []):
                self._learn(slot, packet)
        for _ in range(self._exchanges):
            packets = [self._packet(slot, tick) for slot in range(self._n)]
            for receiver, sender in np.argwhere(self._reached[tick]).tolist():
                late = int(self._delay[tick, receiver, sender])
                if late:
                    self._under_way.setdefault((tick + late, receiver), []).append(packets[sender])
                else:
                    self._learn(receiver, packets[sender])
        fresh, self._fresh = self._fresh, [[] for _ in range(self._n)]
        return fresh

    def _learn(self, slot: int, packet: dict[AgentTick, int]) -> None:
        for (whose, tick), hops in packet.items():
            if (whose, tick) not in self._known[slot]:
                self._known[slot][whose, tick] = hops
                self._fresh[slot].append(Arrival(whose, tick, hops))

    def _packet(self, slot: int, tick: int) -> dict[AgentTick, int]:
        """What an agent sends: the newest records that have not travelled too far, one hop further each."""
        recent = [
            (when, whose, hops)
            for (whose, when), hops in self._known[slot].items()
            if when > tick - self._memory and hops <= self._hops
        ]
        packet: dict[AgentTick, int] = {}
        left = BODY_BYTES
        for when, whose, hops in sorted(recent, key=lambda item: (-item[0], item[2], item[1])):
            left -= int(self._bytes[when, whose])
            if left < 0:
                break
            packet[whose, when] = hops + 1
        return packet


def adjacency(recording: StudyInput) -> NDArray[np.bool_]:
    """Who is whose neighbour, ``(n, n)``."""
    adjacent = np.zeros((len(recording.agents),) * 2, bool)
    for a, b in recording.edges.tolist():
        adjacent[a, b] = adjacent[b, a] = True
    return adjacent


def _record_bytes(recording: StudyInput) -> NDArray[np.int64]:
    """Bytes ``(T+1, n)`` that the records of one agent and tick take in a packet."""
    fixes = np.isfinite(recording.gps[:, :, :3]).all(axis=-1)
    speeds = np.isfinite(recording.gps[:, :, 3])
    ranges = np.isfinite(recording.ranges).sum(axis=-1)
    more = 0 if recording.rows is None else recording.rows.bytes(*fixes.shape)
    return np.asarray(
        ACCEL_BYTES + POSITION_BYTES * fixes + SPEED_BYTES * speeds + RANGE_BYTES * ranges + more, np.int64
    )
