"""Rows as text: a header line, then ``time_s,kind,body,other,value,sigma`` a line.

======================================  ===========================================================================
kind                                    meaning
======================================  ===========================================================================
position_n, _e, _d, velocity_n, _e, _d  what was measured of a body, NED, m and m/s
speed                                   norm of its velocity, m/s
range, anchor_range                     to ``other``, a body or an anchor, m
truth_n, truth_e, truth_d               where a body truly was; at least once, where it began
anchor_n, anchor_e, anchor_d            where the anchor ``body`` is; its time does not matter
======================================  ===========================================================================

``sigma`` is the 1-sigma of what was measured. Bodies and anchors have any names.
"""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim_bridge.studies.imports.row_builder import RowBuilder, Start, Track
from sim_bridge.studies.study_input import StudyInput, StudyInputError
from sim_bridge.studies.study_rows import RowKind

COLUMNS = ("time_s", "kind", "body", "other", "value", "sigma")
KINDS = {kind.name.lower(): kind for kind in RowKind}
PLACES = tuple(f"{what}_{axis}" for what in ("truth", "anchor") for axis in "ned")


@dataclass(frozen=True, slots=True)
class _Line:
    """One checked line."""

    time_s: float
    kind: str
    body: str
    other: str
    value: float
    sigma: float


def study_of_csv(path: Path, period_s: float = 0.1, start: Start | None = None) -> StudyInput:
    """A study input of a file of rows; raises `StudyInputError` naming the line, `OSError`."""
    lines = _read(path)
    measured = [line for line in lines if line.kind in KINDS]
    if not measured:
        raise StudyInputError(str(path), "lines", "at least one measurement", "none")
    bodies = sorted({line.body for line in measured})
    truth = _truth(path, bodies, [line for line in lines if line.kind.startswith("truth")])
    anchors: dict[str, list[float]] = defaultdict(lambda: [math.nan] * 3)
    for line in lines:
        if line.kind.startswith("anchor_") and line.kind not in KINDS:
            anchors[line.body]["ned".index(line.kind[-1])] = line.value
    missing = [name for name, place in anchors.items() if not np.isfinite(place).all()]
    if missing:
        raise StudyInputError(str(path), f"anchor {missing[0]}", "anchor_n, anchor_e and anchor_d", "fewer")
    begin_s, end_s = min(line.time_s for line in measured), max(line.time_s for line in measured)
    places = {name: np.array(place) for name, place in anchors.items()}
    builder = RowBuilder(bodies, places, period_s, begin_s, max(1, math.ceil((end_s - begin_s) / period_s)))
    for line in measured:
        try:
            builder.add(line.time_s, KINDS[line.kind], line.body, line.value, line.sigma**2, line.other or None)
        except KeyError as error:
            raise StudyInputError(str(path), line.kind, "a body or an anchor of the file", str(error)) from None
    known = all(len(times_s) > 1 for times_s, _ in truth.values())
    return builder.study_input(truth, start or Start(), known=known)


def _truth(path: Path, bodies: list[str], lines: list[_Line]) -> dict[str, Track]:
    tracks: dict[str, Track] = {}
    for body in bodies:
        table = {
            axis: sorted((x.time_s, x.value) for x in lines if x.body == body and x.kind[-1] == axis)
            for axis in "ned"
        }
        times_s = sorted({time_s for time_s, _ in table["n"]})
        if not all(table.values()):
            raise StudyInputError(str(path), f"body {body}", "truth_n, truth_e and truth_d, once at least", "fewer")
        axes = [np.interp(times_s, *np.array(table[axis]).T) for axis in "ned"]
        tracks[body] = np.array(times_s), np.column_stack(axes)
    return tracks


def _read(path: Path) -> list[_Line]:
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        reader = csv.DictReader(file)
        header = [name.strip() for name in reader.fieldnames or ()]
        if not set(COLUMNS) <= set(header):
            raise StudyInputError(str(path), "header", ", ".join(COLUMNS), repr(", ".join(header)[:80]))
        return [_line(row, f"{path}:{number}") for number, row in enumerate(reader, 2)]


def _line(row: dict[str, str], where: str) -> _Line:
    kind, body, other = ((row[name] or "").strip() for name in ("kind", "body", "other"))
    if kind not in KINDS and kind not in PLACES:
        raise StudyInputError(where, "kind", f"one of {', '.join((*KINDS, *PLACES))}", repr(kind[:40]))
    if not body:
        raise StudyInputError(where, "body", "a name", "nothing")
    if kind in ("range", "anchor_range") and (not other or other == body):
        raise StudyInputError(where, "other", "the name of the other end", repr(other))
    numbers = {}
    for name in ("time_s", "value", "sigma"):
        text = (row[name] or "").strip()
        try:
            numbers[name] = 0.0 if not text and name == "sigma" and kind in PLACES else float(text)
        except ValueError:
            raise StudyInputError(where, name, "a number", repr(text[:40])) from None
        if not math.isfinite(numbers[name]):
            raise StudyInputError(where, name, "a finite number", repr(text[:40]))
    if kind in KINDS and numbers["sigma"] <= 0.0:
        raise StudyInputError(where, "sigma", "above 0", f"{numbers['sigma']:g}")
    return _Line(numbers["time_s"], kind, body, other, numbers["value"], numbers["sigma"])
