"""The measurement records an agent holds: which are used, which are sent on, and none twice."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from agent.config.tables import FleetConfig
from agent.fleet.lever_arms import LeverArms
from agent.fleet.measurements import inputs_of, rows_of
from agent.fleet.neighbourhood import Neighbourhood
from estimators.model.measurements import InputTable, RowTable
from transport.errors import EncodeError
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    GroundHeightMeasurement,
    HeightMeasurement,
    Measurement,
    Measurements,
    OrientationMeasurement,
    RangeMeasurement,
    SightingMeasurement,
    as_sent,
    fitting,
)
from transport.messages.proofs import Proof, acknowledged_by, by_origin, origin

KEEP_TICKS = 64
"""Records older than this are forgotten; no window reaches that far."""
ECHOES_REMEMBERED = 64
ATTITUDE_TICKS = 3
"""So long a range waits to hear how its ends lay, if their antennas are off their bodies; then it counts for less."""
AHEAD_TICKS = 2
"""Records of a neighbour whose clock is ahead by more are refused."""


@dataclass(slots=True)
class _Kept:
    """A record that was taken in; ``held_by`` are neighbours known to have it: it was in their packets."""

    record: Measurement
    held_by: set[int] = field(default_factory=set)
    sent: int = 0
    """Packets that carried it, counted where that is limited."""
    proof: Proof | None = None
    """Of its origin, where it is to be relayed with one."""
    most: int | None = None
    """After so many it is sent no more; ``None``: never mind how many."""

    def is_done(self, neighbours: frozenset[int]) -> bool:
        """Whether all ``neighbours`` are known to have it, or it was sent as often as it is to be."""
        return self.held_by >= neighbours or (self.most is not None and self.sent >= self.most)


@dataclass(slots=True)
class _OnItsWay:
    """What is sent of one tick: our own records and those that we relay, each in the order in which they came."""

    own: list[_Kept] = field(default_factory=list)
    relayed: list[_Kept] = field(default_factory=list)
    _held_by: frozenset[int] = frozenset()
    """Neighbours that were found to have all of them."""

    def add(self, kept: _Kept, *, is_own: bool) -> None:
        """One more is sent."""
        (self.own if is_own else self.relayed).append(kept)
        self._held_by = frozenset()

    def is_held_by(self, neighbours: frozenset[int]) -> bool:
        """Whether all ``neighbours`` are known to have all of it."""
        if neighbours <= self._held_by:
            return True
        for kept in (*self.own, *self.relayed):
            if not kept.is_done(neighbours):
                return False
        self._held_by = neighbours
        return True


class MeasurementStore:
    """Records by tick, own and heard; ``refused`` counts those not taken, by reason.

    A packet brings first what some neighbour may lack: a record that was in a neighbour's packet is one that it has.
    So that neighbours know it of us, what came in since the last packet goes out again behind that, as an echo.
    """

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._agent_id = agent_id
        self._history_ticks = config.transport.history_ticks
        self._hold_ticks = config.estimator.window
        self.neighbourhood = Neighbourhood(config, agent_id)
        self.arms = LeverArms(config)
        """The antennas of all drones, and how the drones lay of late."""
        self._acked: dict[int, dict[bytes, _Kept]] = {}
        """By tick, what is kept by what acknowledges it."""
        self._kept: dict[int, dict[bytes, _Kept]] = {}
        """The records taken in, by tick and identity."""
        self._to_send: dict[int, _OnItsWay] = {}
        """Own and relayed records by tick."""
        self._echoed_after: deque[int] = deque(maxlen=ECHOES_REMEMBERED)
        """How many ticks after theirs our own records were said back, of late."""
        self._echoes: dict[bytes, Measurement] = {}
        """What was heard since the last packet, by its identity."""
        self._rows: list[Measurement] = []
        self._inputs: list[AccelerationMeasurement] = []
        self._takes_drift = config.estimator.systematic_errors
        self._proven = False
        """Whether neighbours prove the origin of what they relay: in signed fleets."""
        self.refused: Counter[str] = Counter()
        self.unturned = 0
        """Ranges that were used without knowing where their antennas pointed."""
        self.unused_ranges = 0
        """Own ranges that waited in vain for both ends to be located."""

    def add_own(self, record: Measurement) -> Measurement | None:
        """Take in a record of our own sensors; it comes back as the wire rounds it, ``None`` if refused."""
        try:
            rounded = as_sent(record)
        except EncodeError:
            self.refused["own: out of range"] += 1
            return None
        if self._kept_of(rounded) is not None:
            return None
        self._add(rounded)
        return rounded

    def add_heard(
        self,
        sender: int,
        records: Iterable[Measurement],
        tick: int,
        proofs: tuple[Proof, ...] | None = None,
        acks: Iterable[bytes] = (),
    ) -> list[Measurement]:
        """Take in the records of a neighbour's packet, while ``tick`` is the current one; those taken come back.

        With ``proofs``, if only of none, what is new and somebody else's has to be among what they cover. ``acks``
        acknowledge what was sent.
        """
        self._proven = self._proven or proofs is not None
        proof_of = by_origin(proofs or ())
        taken = []
        for record in records:
            kept = self._kept_of(record)  # mostly it is there already: neighbours say back what they heard
            proof = proof_of.get(origin(record)) if proof_of else None
            if record.observer != self._agent_id and (kept is not None or self._wanted(record, tick)):
                if kept is None:
                    if proof is None and proofs is not None and record.observer != sender:
                        self.refused[f"heard: not proven, of {sender}"] += 1
                        continue
                    kept = self._add(record)
                    taken.append(record)
                if self._echoes_back(record, sender):
                    self._echoes[record.identity] = kept.record
                if proof is not None and (kept.proof is None or record.observer == sender):
                    kept.proof = proof
            if kept is not None and sender not in kept.held_by:
                self._note_held(kept, sender, tick)
        for ack in acks:
            for of_tick in self._acked.values():
                if ack in of_tick and sender not in of_tick[ack].held_by:
                    self._note_held(of_tick[ack], sender, tick)
        return taken

    def _note_held(self, kept: _Kept, sender: int, tick: int) -> None:
        """A neighbour has said for the first time, at a tick, that it has a record."""
        kept.held_by.add(sender)
        if kept.record.observer == self._agent_id:
            self._echoed_after.append(max(tick - kept.record.tick, 0))

    def take(self, tick: int, members: Sequence[int], located: Container[int]) -> tuple[RowTable, InputTable]:
        """Rows up to a tick and inputs that act before it, each handed out once; forgets what is old.

        Slots are those of ``members``. Rows wait for the agents that they name to be ``located`` members, inputs for
        theirs to be a member, as long as an estimator's window could still use them.
        """
        slots = {agent: slot for slot, agent in enumerate(members)}
        usable = {agent for agent in members if agent in located}
        rows: list[Measurement] = []
        inputs: list[AccelerationMeasurement] = []
        later: list[Measurement] = []
        for record in self._rows:
            end = _far_end(record)
            ready = record.tick <= tick and record.observer in usable and end in usable
            (rows if ready and self._is_turned(record, tick) else later).append(record)
        later_inputs: list[AccelerationMeasurement] = []
        for push in self._inputs:
            (inputs if push.tick < tick and push.observer in slots else later_inputs).append(push)
        self._rows, self._inputs = later, later_inputs
        table = rows_of(rows, slots, self.arms)
        self.forget(tick)
        return table, inputs_of(inputs, slots)

    def _is_turned(self, record: Measurement, tick: int) -> bool:
        """Whether it is known how the ends of a range lay, or it has waited for that long enough."""
        if not isinstance(record, RangeMeasurement) or isinstance(record, SightingMeasurement):
            return True
        if self.arms.knows(record):
            return True
        waited = tick - record.tick >= min(ATTITUDE_TICKS, self._hold_ticks)
        self.unturned += waited
        return waited

    def let_go_beyond(self, wanted: Container[int]) -> None:
        """Let go what names somebody who is not wanted in the joint state: it would wait in vain."""
        rows = [record for record in self._rows if record.observer in wanted and _far_end(record) in wanted]
        inputs = [record for record in self._inputs if record.observer in wanted]
        self.refused["beyond the joint state"] += len(self._rows) + len(self._inputs) - len(rows) - len(inputs)
        if len(rows) < len(self._rows):
            kept = set(map(id, rows))
            self._count_ranges(record for record in self._rows if id(record) not in kept)
        self._rows, self._inputs = rows, inputs

    def forget(self, tick: int) -> None:
        """Let go what no window that ends at a tick or later could use."""
        first = tick - self._hold_ticks
        waiting = [record for record in self._rows if record.tick >= first]
        if len(waiting) < len(self._rows):
            self.refused["not located"] += len(self._rows) - len(waiting)
            self._count_ranges(record for record in self._rows if record.tick < first)
        self._rows = waiting
        self._inputs = [record for record in self._inputs if record.tick >= first]
        self.arms.forget(first)
        for old in [t for t in self._kept if t < tick - KEEP_TICKS]:
            self._kept.pop(old)
            self._acked.pop(old, None)
            self._to_send.pop(old, None)

    def _count_ranges(self, let_go: Iterable[Measurement]) -> None:
        """Count the own ranges among what is let go unused."""
        for record in let_go:
            ranged = isinstance(record, RangeMeasurement) and not isinstance(record, SightingMeasurement)
            self.unused_ranges += ranged and record.observer == self._agent_id

    def packet(self, tick: int, exchange: int, neighbours: frozenset[int]) -> Measurements:
        """What ``neighbours`` get in an exchange: what one of them may lack, newest first, then echoes.

        While nobody is heard all of the last ticks goes out.
        """
        if self.neighbourhood.relays_times is not None:
            records = self._counted(tick, exchange, neighbours)
        else:
            lacking = list(self._lacking(tick, neighbours))
            if self._proven and exchange == 1:  # nobody can have said back yet what went out first
                lacking.sort(key=self._went_out_in(tick))
            records = {kept.record.identity: kept.record for kept in lacking}
            if not self._proven:
                records.update((name, record) for name, record in self._newest_echoes() if name not in records)
        told = tuple(records.values())
        proofs = acks = None
        if self._proven:
            proofs = self._proofs_of(told)
            acks = tuple(acknowledged_by(echo.digest) for name, echo in self._newest_echoes() if name not in records)
        self._echoes = {}
        return Measurements(tick, told, exchange, proofs, acks or ())

    def _went_out_in(self, tick: int) -> Callable[[_Kept], bool]:
        return lambda kept: kept.record.tick == tick and kept.record.observer == self._agent_id

    def _proofs_of(self, records: Iterable[Measurement]) -> tuple[Proof, ...]:
        """The proofs of others' records that are to be relayed; an echo needs none."""
        proofs: dict[Proof, None] = {}
        for record in records:
            kept = self._kept_of(record)
            if kept is not None and kept.proof is not None and self.neighbourhood.sends(record):
                proofs[kept.proof] = None
        return tuple(proofs)

    def _lacking(self, tick: int, neighbours: frozenset[int]) -> Iterator[_Kept]:
        """What some neighbour may lack, of the newest tick first."""
        for on_its_way in self._last_ticks(tick, tick):
            if neighbours and on_its_way.is_held_by(neighbours):
                continue
            for kept in (*on_its_way.own, *on_its_way.relayed):
                if not neighbours or not kept.is_done(neighbours):
                    yield kept

    def _newest_echoes(self) -> list[tuple[bytes, Measurement]]:
        return sorted(self._echoes.items(), key=lambda item: -item[1].tick)

    def _counted(self, tick: int, exchange: int, neighbours: frozenset[int]) -> dict[bytes, Measurement]:
        """The records of a packet where it is counted what goes out how often: new ones, echoes, repeated ones."""
        lacking = [
            kept
            for kept in self._lacking(tick, neighbours)
            if not (kept.sent and exchange == 1 and kept.record.tick == tick)  # nobody can have said it back yet
        ]
        new = {kept.record.identity: kept.record for kept in lacking if not kept.sent}
        records = new if self._proven else new | dict(self._newest_echoes())
        records |= {kept.record.identity: kept.record for kept in lacking}
        owner = self._agent_id if self._proven else None
        told = list(records.items())
        proofs = self._proofs_of(records.values()) if self._proven else ()
        records = dict(told[: fitting([record for _, record in told], proofs, owner)])
        for kept in lacking:
            kept.sent += kept.record.identity in records
        return records

    def lacked(self, tick: int, neighbours: frozenset[int]) -> bool:
        """Whether one of ``neighbours`` may lack a record of a tick before this one that it is to get.

        Where links are slow no echo can be back yet of the last ticks' records: these are not asked for.
        """
        newest = tick - 1 - min(self._echoed_after, default=0)
        if self.neighbourhood.relays_times is not None:  # only owners see to it that all have their records
            own = (kept for on_its_way in self._last_ticks(newest, tick) for kept in on_its_way.own)
            return not all(kept.is_done(neighbours) for kept in own)
        return not all(on_its_way.is_held_by(neighbours) for on_its_way in self._last_ticks(newest, tick))

    def _last_ticks(self, newest: int, tick: int) -> Iterator[_OnItsWay]:
        """What is sent of the ticks from ``newest`` back to the oldest that is sent at a tick."""
        for of_tick in range(newest, tick - self._history_ticks, -1):
            if of_tick in self._to_send:
                yield self._to_send[of_tick]

    def _wanted(self, record: Measurement, tick: int) -> bool:
        """Whether a record that a neighbour sent, of another drone and not held yet, is one to take in."""
        if record.tick > tick + AHEAD_TICKS:
            self.refused["heard: of the future"] += 1
            return False
        if record.tick < tick - KEEP_TICKS:
            self.refused["heard: too old"] += 1
            return False
        drifts = isinstance(record, HeightMeasurement) and not isinstance(record, GroundHeightMeasurement)
        if not self.neighbourhood.uses(record) or (drifts and not self._takes_drift):
            self.refused["heard: not used"] += 1
            return False
        return True

    def _echoes_back(self, record: Measurement, sender: int) -> bool:
        """Whether a record is said back, so that neighbours know that it is here.

        Where relayed records are counted only owners repeat theirs, so only they are told.
        """
        return self.neighbourhood.relays_times is None or sender == record.observer

    def _kept_of(self, record: Measurement) -> _Kept | None:
        """What is kept of a record, if it was taken in."""
        of_tick = self._kept.get(record.tick)
        return None if of_tick is None else of_tick.get(record.identity)

    def _add(self, record: Measurement) -> _Kept:
        """Take in a record that is not there yet."""
        kept = self._kept.setdefault(record.tick, {})[record.identity] = _Kept(record)
        self._acked.setdefault(record.tick, {})[acknowledged_by(record.digest)] = kept
        is_own = record.observer == self._agent_id
        kept.most = None if is_own else self.neighbourhood.relays_times
        self.neighbourhood.note(record)
        if self.neighbourhood.sends(record):
            on_its_way = self._to_send.setdefault(record.tick, _OnItsWay())
            on_its_way.add(kept, is_own=is_own)
        if isinstance(record, AccelerationMeasurement):
            self._inputs.append(record)
        elif isinstance(record, OrientationMeasurement):
            self.arms.note(record)
        else:
            self._rows.append(record)
        return kept


def _far_end(record: Measurement) -> int:
    """The other agent of a range; of other records their own."""
    return record.other if isinstance(record, RangeMeasurement) else record.observer
