"""Rows of a study input (version 2): what any sensor said at any instant, one scalar a row.

The arrays of a file have the names of the fields with ``row_`` before them, K long; ``anchors_m`` stands beside them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimators.model.measurements import ROW, Kind, RowTable, empty_rows

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class RowKind(IntEnum):
    """What a row measures, NED, m and m/s."""

    POSITION_N = 0
    POSITION_E = 1
    POSITION_D = 2
    VELOCITY_N = 3
    VELOCITY_E = 4
    VELOCITY_D = 5
    SPEED = 6
    RANGE = 7
    """To another body."""
    ANCHOR_RANGE = 8
    """To an anchor."""


_ESTIMATED = {
    **dict.fromkeys((RowKind.POSITION_N, RowKind.POSITION_E, RowKind.POSITION_D), Kind.POSITION),
    **dict.fromkeys((RowKind.VELOCITY_N, RowKind.VELOCITY_E, RowKind.VELOCITY_D), Kind.VELOCITY),
    RowKind.SPEED: Kind.SPEED,
    RowKind.RANGE: Kind.RANGE,
    RowKind.ANCHOR_RANGE: Kind.ANCHOR_RANGE,
}
BYTES = {Kind.POSITION: 11, Kind.VELOCITY: 11, Kind.SPEED: 16, Kind.RANGE: 18, Kind.ANCHOR_RANGE: 28}
"""What a row takes in a packet; a third of a vector's."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyRows:
    """K rows; ``body`` is the 0-based place of the agent that was measured, and that measured."""

    tick: Ints
    offset_s: Floats
    """Instant minus the tick's time."""
    kind: Ints
    value: Floats
    variance: Floats
    body: Ints
    other: Ints
    """Place of the range's other end among the agents or the anchors; -1 where there is none."""
    tag: Ints
    """``(K, 2)``: antenna of the body and of the other end; lever arms are not part of a study input yet."""
    anchors_m: Floats
    """``(m, 3)`` NED."""

    def table(self) -> RowTable:
        """As estimators take them."""
        table = np.zeros(len(self.tick), ROW)
        kinds = np.array([_ESTIMATED[RowKind(kind)] for kind in self.kind.tolist()], np.int32)
        table["tick"], table["offset_s"] = self.tick, self.offset_s
        table["value"], table["variance"], table["half_width"] = self.value, self.variance, np.inf
        table["kind"], table["agent"], table["observer"] = kinds, self.body, self.body
        table["other"] = np.where(kinds == Kind.RANGE, self.other, -1)
        for axis, name in enumerate("xyz"):
            along = np.isin(kinds, (Kind.POSITION, Kind.VELOCITY)) & (self.kind % 3 == axis)
            table[name][along] = 1.0
            anchored = kinds == Kind.ANCHOR_RANGE
            table[name][anchored] = self.anchors_m[self.other[anchored], axis]
        return table

    @cached_property
    def _groups(self) -> dict[tuple[int, int], RowTable]:
        """By tick and body."""
        table = self.table()
        table = table[np.lexsort((table["agent"], table["tick"]))]
        begins = np.flatnonzero(np.diff(table["tick"], prepend=-1) | np.diff(table["agent"], prepend=-1))
        groups = np.split(table, begins[1:]) if len(table) else []
        return {(int(each["tick"][0]), int(each["agent"][0])): each for each in groups}

    def of(self, tick: int, slot: int) -> RowTable:
        """What an agent measured in a tick."""
        return self._groups.get((tick, slot), empty_rows())

    def bytes(self, count: int, agents: int) -> Ints:
        """``(count, n)``: what they take in packets, of so many ticks."""
        sizes = np.zeros((count, agents), np.int64)
        table = self.table()
        np.add.at(sizes, (table["tick"], table["agent"]), [BYTES[Kind(kind)] for kind in table["kind"].tolist()])
        return sizes
