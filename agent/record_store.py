"""The measurement records an agent holds: which are used, which are sent on, and none twice."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container, Sequence
from typing import Any

import numpy as np

from agent.config_tables import FleetConfig
from agent.records import input_of, rows_of
from estimators.layout import Layout
from estimators.measurements import INPUT, ROW, InputTable, RowTable
from transport.errors import EncodeError
from transport.measurement_body import AccelerationRecord, Measurements, RangeRecord, Record, as_sent, identity

_Entry = tuple[int, int, int, RowTable]
"""Tick, slot of the agent, slot of the range's other end or -1, and the rows or the input of one record."""

KEEP_TICKS = 64
"""Records older than this are forgotten; no window reaches that far."""
AHEAD_TICKS = 2
"""Records of a neighbour whose clock is ahead by more are refused."""


class Neighbourhood:
    """Who is how many hops away, and what that means for records.

    With configured edges the hops are those of the graph. Without, neighbours are who is heard: one hop for a drone
    that was heard directly of late, two for all others (a record does not say how far it came).
    """

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._settings = config.estimator
        self._size = len(config.ids)
        self._recent_ticks = math.ceil(config.transport.neighbour_timeout_s / config.fleet.period_s)
        self._heard: dict[int, int] = {}
        self._tick = 0
        self._graph = {agent_id: 0}
        """Hops along the configured edges to each agent that can be reached."""
        self._by_reach = config.fleet.edges is None
        self._agent_id = agent_id
        frontier, distance = [agent_id], 0
        while frontier:
            distance += 1
            reached = dict.fromkeys(n for one in frontier for n in config.neighbours(one))
            frontier = [n for n in reached if n not in self._graph]
            self._graph |= dict.fromkeys(frontier, distance)

    def hear(self, agent_id: int, tick: int) -> None:
        """A packet came directly from an agent."""
        self._heard[agent_id] = tick
        self._tick = max(self._tick, tick)

    def hops(self, agent_id: int) -> int | None:
        """Hops to an agent; ``None`` if no edges lead there."""
        if not self._by_reach or agent_id == self._agent_id:
            return self._graph.get(agent_id)
        heard = self._heard.get(agent_id)
        return 1 if heard is not None and self._tick - heard <= self._recent_ticks else 2

    def uses(self, record: Record) -> bool:
        """Whether this agent's estimator takes the record."""
        hops = self.hops(record.observer)
        if hops is None:
            return False
        if isinstance(record, AccelerationRecord):
            return hops <= {"none": 0, "neighbours": 1, "fleet": self._size}[self._settings.share_inputs]
        return hops <= 1 + self._settings.relay_hops

    def sends(self, record: Record) -> bool:
        """Whether this agent tells its neighbours: its own records, and others' that are relayed so far."""
        hops = self.hops(record.observer)
        if hops is None:
            return False
        if isinstance(record, AccelerationRecord):
            return hops <= {"none": -1, "neighbours": 0, "fleet": self._size}[self._settings.share_inputs]
        return hops <= self._settings.relay_hops


class RecordStore:
    """Records by tick, own and heard; ``refused`` counts those not taken, by reason."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._agent_id = agent_id
        self._layout = Layout(config.ids)
        self._history_ticks = config.transport.history_ticks
        self._hold_ticks = config.estimator.window
        self.neighbourhood = Neighbourhood(config, agent_id)
        self._seen: dict[int, set[object]] = {}
        self._held: dict[int, dict[int, Record]] = {}
        """The objects taken in, by tick and ``id``: where packets are handed over as objects, most come again."""
        self._to_send: dict[int, list[Record]] = {}
        self._rows: list[_Entry] = []
        self._inputs: list[_Entry] = []
        self.refused: Counter[str] = Counter()

    def add_own(self, record: Record) -> Record | None:
        """Take in a record of our own sensors; it comes back as the wire rounds it, ``None`` if refused."""
        try:
            rounded = as_sent(record)
        except EncodeError:
            self.refused["own: out of range"] += 1
            return None
        return rounded if self._add(rounded) else None

    def add_heard(self, record: Record, tick: int) -> bool:
        """Take in a record that a neighbour sent, while ``tick`` is the current one; false if refused."""
        if record.observer == self._agent_id:
            return False  # our own words, relayed back
        if record.tick > tick + AHEAD_TICKS:
            self.refused["heard: of the future"] += 1
            return False
        if record.tick < tick - KEEP_TICKS:
            self.refused["heard: too old"] += 1
            return False
        if not self.neighbourhood.uses(record):
            self.refused["heard: not used"] += 1
            return False
        return self._add(record)

    def take(self, tick: int, members: Sequence[int], located: Container[int]) -> tuple[RowTable, InputTable]:
        """Rows up to a tick and inputs that act before it, each handed out once; forgets what is old.

        Slots are those of ``members``. Rows wait for the agents that they name to be ``located``, inputs for theirs
        to be a member, as long as an estimator's window could still use them.
        """
        slots = np.full(self._layout.size + 1, -1, np.int32)  # the last stays for "no other end"
        usable = [False] * self._layout.size + [True]
        for slot, agent in enumerate(members):
            slots[self._layout.slot(agent)] = slot
            usable[self._layout.slot(agent)] = agent in located
        known = (slots >= 0).tolist()
        rows, self._rows = _parted(self._rows, lambda at, a, b: at <= tick and usable[a] and usable[b])
        inputs, self._inputs = _parted(self._inputs, lambda at, a, _: at < tick and known[a])
        self.forget(tick)
        joined, pushes = _joined(rows, ROW), _joined(inputs, INPUT)
        for field in ("agent", "other", "observer"):
            joined[field] = slots[joined[field]]
        pushes["agent"] = slots[pushes["agent"]]
        return joined, pushes

    def forget(self, tick: int) -> None:
        """Let go what no window that ends at a tick or later could use."""
        first = tick - self._hold_ticks
        late = sum(entry[0] < first for entry in self._rows)
        if late:
            self.refused["not located"] += late
        self._rows = [entry for entry in self._rows if entry[0] >= first]
        self._inputs = [entry for entry in self._inputs if entry[0] >= first]
        for old in [t for t in self._seen if t < tick - KEEP_TICKS]:
            del self._seen[old]
            self._held.pop(old, None)
            self._to_send.pop(old, None)

    def packet(self, tick: int) -> Measurements:
        """What neighbours get at a tick: the records of the last ticks, our own before relayed ones."""
        records: list[Record] = []
        for of_tick in range(tick, tick - self._history_ticks, -1):
            held = self._to_send.get(of_tick, [])
            records += sorted(held, key=lambda record: record.observer != self._agent_id)
        return Measurements(tick, tuple(records))

    def _add(self, record: Record) -> bool:
        held = self._held.get(record.tick)
        if held is None:
            held = self._held[record.tick] = {}
            self._seen[record.tick] = set()
        if id(record) in held:
            return False
        name, seen = identity(record), self._seen[record.tick]
        if name in seen:
            return False
        seen.add(name)
        held[id(record)] = record
        if self.neighbourhood.sends(record):
            self._to_send.setdefault(record.tick, []).append(record)
        slot = self._layout.slot(record.observer)
        if isinstance(record, AccelerationRecord):
            self._inputs.append((record.tick, slot, -1, input_of(record, self._layout)))
        else:
            rows = rows_of(record, self._layout)
            other = self._layout.slot(record.other) if isinstance(record, RangeRecord) else -1
            if len(rows):
                self._rows.append((record.tick, slot, other, rows))
        return True


def _parted(entries: list[_Entry], wanted: Callable[[int, int, int], bool]) -> tuple[list[RowTable], list[_Entry]]:
    """The tables that are wanted by their tick and the agents that they name, and the rest."""
    taken, left = [], []
    for entry in entries:
        at, agent, other, table = entry
        if wanted(at, agent, other):
            taken.append(table)
        else:
            left.append(entry)
    return taken, left


def _joined(tables: list[RowTable], dtype: np.dtype[Any]) -> RowTable:
    """The tables one after the other; numpy's concatenation promotes every field anew, slowly."""
    joined = np.empty(sum(map(len, tables)), dtype)
    at = 0
    for table in tables:
        joined[at : at + len(table)] = table
        at += len(table)
    return joined
