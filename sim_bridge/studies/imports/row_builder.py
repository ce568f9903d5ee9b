"""Puts measurements with times of their own, of bodies with names, into a study input of version 2."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_rows import RowKind, StudyRows

Floats = NDArray[np.float64]
Track = tuple[Floats, Floats]
"""Times ``(K,)`` s, rising, and NED positions ``(K, 3)``."""


@dataclass(frozen=True, slots=True)
class Start:
    """1-sigma of the first estimate, m and m/s, and of an acceleration that nobody measured, m/s2 per axis."""

    position_m: float = 0.1
    velocity_mps: float = 0.3
    accel_mps2: float = 0.5


@dataclass(slots=True)
class RowBuilder:
    """Collects rows; ``bodies`` are names in the order of their blocks, ``anchors_m`` places by name, NED."""

    bodies: Sequence[str]
    anchors_m: Mapping[str, Floats]
    period_s: float
    begin_s: float
    ticks: int
    """After the first."""
    left_out: int = 0
    """Rows before the first tick or after the last."""
    _columns: list[tuple[int, float, int, float, float, int, int]] = field(default_factory=list)

    def add(
        self, time_s: float, kind: RowKind, body: str, value: float, variance: float, other: str | None = None
    ) -> None:
        """A row at its instant; raises `KeyError` for an unknown body or anchor."""
        tick = math.floor((time_s - self.begin_s) / self.period_s + 0.5)
        if not 0 <= tick <= self.ticks:
            self.left_out += 1
            return
        offset_s = time_s - self.begin_s - tick * self.period_s
        far = -1
        if kind is RowKind.RANGE and other is not None:
            far = _place(self.bodies, other)
        elif kind is RowKind.ANCHOR_RANGE and other is not None:
            far = _place(list(self.anchors_m), other)
        self._columns.append((tick, offset_s, int(kind), value, variance, _place(self.bodies, body), far))

    def study_input(self, truth: Mapping[str, Track], start: Start, *, known: bool = True) -> StudyInput:
        """The file's content; it begins where ``truth`` has the bodies.

        Without ``known`` that is all that is known of where they were. Raises `KeyError` for one without truth.
        """
        n, count = len(self.bodies), self.ticks + 1
        times_s = self.begin_s + self.period_s * np.arange(count)
        states = np.zeros((count, n, 6))
        for slot, name in enumerate(self.bodies):
            at_s, position_m = truth[name]
            for axis in range(3):
                states[:, slot, axis] = np.interp(times_s, at_s, position_m[:, axis])
        states[:, :, 3:] = np.gradient(states[:, :, :3], self.period_s, axis=0)
        columns = list(zip(*self._columns, strict=True)) if self._columns else [()] * 7
        variances = np.repeat([start.position_m**2, start.velocity_mps**2], 3)
        return StudyInput(
            period_s=self.period_s,
            agents=np.arange(1, n + 1),
            edges=np.array([(a, b) for a in range(n) for b in range(a + 1, n)], np.int64).reshape(-1, 2),
            accel=np.zeros((self.ticks, n, 3)),
            gps=np.full((count, n, 4), np.nan),
            ranges=np.full((count, n, n), np.nan),
            gps_half_width=np.ones(4),
            range_half_width=1.0,
            accel_half_width=math.sqrt(3.0) * start.accel_mps2,
            x0=np.tile(states[0].ravel(), (n, 1)),
            P0=np.diag(np.tile(variances, n)),
            received=np.ones((count, n, n), np.bool_),
            delay_ticks=np.zeros((count, n, n), np.int64),
            truth=states if known else None,
            rows=StudyRows(
                tick=np.array(columns[0], np.int64),
                offset_s=np.array(columns[1], float),
                kind=np.array(columns[2], np.int64),
                value=np.array(columns[3], float),
                variance=np.array(columns[4], float),
                body=np.array(columns[5], np.int64),
                other=np.array(columns[6], np.int64),
                tag=np.zeros((len(self._columns), 2), np.int64),
                anchors_m=np.array(list(self.anchors_m.values()), float).reshape(-1, 3),
            ),
        )


def _place(names: Sequence[str], name: str) -> int:
    if name not in names:
        raise KeyError(name)
    return list(names).index(name)
