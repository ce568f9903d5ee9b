"""The measurement records an agent holds: which are used, which are sent on, and none twice."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from agent.config_tables import FleetConfig
from agent.records import input_of, rows_of
from estimators.layout import Layout
from estimators.measurements import INPUT, ROW, InputTable, RowTable
from transport.errors import EncodeError
from transport.measurement_body import AccelerationRecord, Measurements, Record, as_sent, identity

KEEP_TICKS = 64
"""Records older than this are forgotten; no window reaches that far."""
AHEAD_TICKS = 2
"""Records of a neighbour whose clock is ahead by more are refused."""


class Neighbourhood:
    """Who is how many hops away, and what that means for records."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._settings = config.estimator
        self.hops = {agent_id: 0}
        """Hops from this agent to each other that can be reached."""
        frontier, distance = [agent_id], 0
        while frontier:
            distance += 1
            reached = dict.fromkeys(n for one in frontier for n in config.neighbours(one))
            frontier = [n for n in reached if n not in self.hops]
            self.hops |= dict.fromkeys(frontier, distance)

    def uses(self, record: Record) -> bool:
        """Whether this agent's estimator takes the record."""
        hops = self.hops.get(record.observer)
        if hops is None:
            return False
        if isinstance(record, AccelerationRecord):
            reach = {"none": 0, "neighbours": 1, "fleet": len(self.hops)}[self._settings.share_inputs]
            return hops <= reach
        return hops <= 1 + self._settings.relay_hops

    def sends(self, record: Record) -> bool:
        """Whether this agent tells its neighbours: its own records, and others' that are relayed so far."""
        hops = self.hops[record.observer]
        if isinstance(record, AccelerationRecord):
            reach = {"none": -1, "neighbours": 0, "fleet": len(self.hops)}[self._settings.share_inputs]
            return hops <= reach
        return hops <= self._settings.relay_hops


class RecordStore:
    """Records by tick, own and heard; ``refused`` counts those not taken, by reason."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._agent_id = agent_id
        self._layout = Layout(config.ids)
        self._history_ticks = config.transport.history_ticks
        self.neighbourhood = Neighbourhood(config, agent_id)
        self._seen: dict[int, set[object]] = {}
        self._to_send: dict[int, list[Record]] = {}
        self._rows: list[tuple[int, RowTable]] = []
        self._inputs: list[tuple[int, InputTable]] = []
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

    def take(self, tick: int) -> tuple[RowTable, InputTable]:
        """Rows up to a tick and inputs that act before it, each handed out once; forgets what is old."""
        rows = [table for row_tick, table in self._rows if row_tick <= tick]
        inputs = [table for input_tick, table in self._inputs if input_tick < tick]
        self._rows = [entry for entry in self._rows if entry[0] > tick]
        self._inputs = [entry for entry in self._inputs if entry[0] >= tick]
        for old in [t for t in self._seen if t < tick - KEEP_TICKS]:
            del self._seen[old]
            self._to_send.pop(old, None)
        return _joined(rows, ROW), _joined(inputs, INPUT)

    def packet(self, tick: int) -> Measurements:
        """What neighbours get at a tick: the records of the last ticks, our own before relayed ones."""
        records: list[Record] = []
        for of_tick in range(tick, tick - self._history_ticks, -1):
            held = self._to_send.get(of_tick, [])
            records += sorted(held, key=lambda record: record.observer != self._agent_id)
        return Measurements(tick, tuple(records))

    def _add(self, record: Record) -> bool:
        seen = self._seen.setdefault(record.tick, set())
        name = identity(record)
        if name in seen:
            return False
        seen.add(name)
        if self.neighbourhood.sends(record):
            self._to_send.setdefault(record.tick, []).append(record)
        if isinstance(record, AccelerationRecord):
            self._inputs.append((record.tick, input_of(record, self._layout)))
        else:
            self._rows.append((record.tick, rows_of(record, self._layout)))
        return True


def _joined(tables: list[RowTable], dtype: np.dtype[Any]) -> RowTable:
    """The tables one after the other; numpy's concatenation promotes every field anew, slowly."""
    joined = np.empty(sum(map(len, tables)), dtype)
    at = 0
    for table in tables:
        joined[at : at + len(table)] = table
        at += len(table)
    return joined
