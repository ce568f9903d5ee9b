"""Factor graphs in the text format of PyFG (``.pyfg``), planar ones: odometry, ranges, places that are known.

Lines, times in s, metres, radians::

    VERTEX_SE2 t A0 x y heading          where a robot truly was; names are a letter and a number
    VERTEX_XY L0 x y                     a landmark: an anchor of known place
    EDGE_SE2 t A0 A1 dx dy dheading C    odometry in the axes of A0; C: its covariance, upper triangle
    EDGE_RANGE t A0 B1 range variance

The plane is x, y with z up; here x is north, -y east, and nothing is below or above. Odometry becomes the mean
velocity over each tick: turned by the true heading, as a robot with a good attitude would. A body's height is pinned
to the plane.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim_bridge.studies.imports.row_builder import Floats, RowBuilder, Start, Track
from sim_bridge.studies.study_input import StudyInput, StudyInputError
from sim_bridge.studies.study_rows import RowKind

PLANE_M, PLANE_MPS = 0.01, 0.01
"""1-sigma of being in the plane, in place and speed."""
_FIELDS = {"VERTEX_SE2": 6, "VERTEX_XY": 4, "EDGE_SE2": 13, "EDGE_RANGE": 6}


@dataclass(frozen=True, slots=True)
class Vertex:
    """A true pose: s, m, radians from x to y."""

    time_s: float
    x: float
    y: float
    heading: float


@dataclass(frozen=True, slots=True)
class Edge:
    """Odometry from one vertex to the next of the same robot, in the axes of the first; m and m2."""

    begin: str
    end: str
    dx: float
    dy: float
    variance: float


@dataclass(frozen=True, slots=True)
class RangeEdge:
    """A range between two vertices, or a vertex and an anchor."""

    time_s: float
    one: str
    other: str
    range_m: float
    variance: float

    @property
    def pair(self) -> tuple[str, str]:
        """The robots or anchors, in order."""
        one, other = self.one[0], self.other[0]
        return (one, other) if one <= other else (other, one)


@dataclass(slots=True)
class FactorGraph:
    """What a file holds; robots are the letters of its vertices."""

    vertices: dict[str, Vertex] = field(default_factory=dict)
    anchors: dict[str, tuple[float, float]] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    ranges: list[RangeEdge] = field(default_factory=list)

    @property
    def robots(self) -> tuple[str, ...]:
        """Letters, sorted."""
        return tuple(sorted({name[0] for name in self.vertices}))

    def truth(self) -> dict[str, Track]:
        """Where each robot was, NED."""
        found: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
        for name, vertex in self.vertices.items():
            found[name[0]].append((vertex.time_s, vertex.x, -vertex.y))
        tracks = {}
        for robot, poses in found.items():
            table = np.array(sorted(poses))
            table = table[np.concatenate(([True], np.diff(table[:, 0]) > 0.0))]
            tracks[robot] = table[:, 0], np.column_stack((table[:, 1:], np.zeros(len(table))))
        return tracks


def read_pyfg(path: Path) -> FactorGraph:
    """Read a planar factor graph; raises `StudyInputError` naming the line, `OSError`."""
    graph = FactorGraph()
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            words = line.split()
            if words and not words[0].startswith("#"):
                _take(graph, words, f"{path}:{number}")
    if not graph.vertices or not graph.ranges:
        raise StudyInputError(str(path), "lines", "VERTEX_SE2 and EDGE_RANGE", "a file without them")
    for number, each in enumerate(graph.ranges):
        for name in (each.one, each.other):
            if name not in graph.vertices and name not in graph.anchors:
                raise StudyInputError(str(path), f"EDGE_RANGE {number}", "a vertex or landmark of the file", name)
    for edge in graph.edges:
        for name in (edge.begin, edge.end):
            if name not in graph.vertices:
                raise StudyInputError(str(path), "EDGE_SE2", "a vertex of the file", name)
    return graph


def _take(graph: FactorGraph, words: list[str], where: str) -> None:
    kind = words[0]
    if kind not in _FIELDS:
        raise StudyInputError(where, "kind", f"one of {', '.join(_FIELDS)} (planar graphs)", repr(kind[:40]))
    if len(words) != _FIELDS[kind]:
        raise StudyInputError(where, kind, f"{_FIELDS[kind]} words", f"{len(words)}")
    names = {"VERTEX_SE2": (2,), "VERTEX_XY": (1,), "EDGE_SE2": (2, 3), "EDGE_RANGE": (2, 3)}[kind]
    try:
        numbers = [float(word) for at, word in enumerate(words) if at and at not in names]
    except ValueError as error:
        raise StudyInputError(where, kind, "numbers", str(error)) from None
    if not all(map(math.isfinite, numbers)):
        raise StudyInputError(where, kind, "finite numbers", " ".join(words)[:80])
    if kind == "VERTEX_SE2":
        graph.vertices[words[2]] = Vertex(*numbers)
    elif kind == "VERTEX_XY":
        graph.anchors[words[1]] = numbers[0], numbers[1]
    elif kind == "EDGE_SE2":
        if words[2][0] != words[3][0]:
            raise StudyInputError(where, kind, "odometry of one robot", f"{words[2]} to {words[3]}")
        variance = 0.5 * (numbers[4] + numbers[7])
        graph.edges.append(Edge(words[2], words[3], numbers[1], numbers[2], variance))
    else:
        if numbers[1] <= 0.0 or numbers[2] <= 0.0:
            raise StudyInputError(where, kind, "a range and a variance above 0", " ".join(words[4:]))
        graph.ranges.append(RangeEdge(numbers[0], words[2], words[3], numbers[1], numbers[2]))


def study_of_graph(graph: FactorGraph, period_s: float = 0.1, start: Start | None = None) -> StudyInput:
    """A study input of a factor graph, from when all robots are there until one is gone."""
    truth = graph.truth()
    begin_s = max(float(times_s[0]) for times_s, _ in truth.values())
    end_s = min(float(times_s[-1]) for times_s, _ in truth.values())
    anchors_m = {name: np.array([x, -y, 0.0]) for name, (x, y) in graph.anchors.items()}
    builder = RowBuilder(graph.robots, anchors_m, period_s, begin_s, max(1, int((end_s - begin_s) / period_s)))
    for robot in graph.robots:
        _add_odometry(builder, robot, graph)
        for tick in range(builder.ticks + 1):
            time_s = begin_s + tick * period_s
            builder.add(time_s, RowKind.POSITION_D, robot, 0.0, PLANE_M**2)
            builder.add(time_s, RowKind.VELOCITY_D, robot, 0.0, PLANE_MPS**2)
    for each in graph.ranges:
        one, other = (each.other, each.one) if each.one in graph.anchors else (each.one, each.other)
        to_anchor = other in graph.anchors
        kind = RowKind.ANCHOR_RANGE if to_anchor else RowKind.RANGE
        builder.add(each.time_s, kind, one[0], each.range_m, each.variance, other if to_anchor else other[0])
    return builder.study_input(truth, start or Start())


def _add_odometry(builder: RowBuilder, robot: str, graph: FactorGraph) -> None:
    """The velocity over each tick that odometry covers, of the path that it makes in the plane."""
    time_s, place_m, variance_m2 = odometry_path(robot, graph)
    ticks_s = builder.begin_s + builder.period_s * np.arange(builder.ticks + 1)
    inside = (ticks_s >= time_s[0]) & (ticks_s <= time_s[-1])
    north, east = (np.interp(ticks_s, time_s, place_m[:, axis]) for axis in (0, 1))
    variance = np.interp(ticks_s, time_s, variance_m2)
    for k in np.flatnonzero(inside[1:] & inside[:-1]).tolist():
        spread = max(float(variance[k + 1] - variance[k]), 1e-8) / builder.period_s**2
        middle_s = float(ticks_s[k] + 0.5 * builder.period_s)
        for kind, axis in ((RowKind.VELOCITY_N, north), (RowKind.VELOCITY_E, east)):
            builder.add(middle_s, kind, robot, float(axis[k + 1] - axis[k]) / builder.period_s, spread)


def odometry_path(robot: str, graph: FactorGraph) -> tuple[Floats, Floats, Floats]:
    """Times ``(K,)``, NED path ``(K, 2)`` from zero and its variance ``(K,)`` per axis, summed up; true headings."""
    own = (each for each in graph.edges if each.begin[0] == robot)
    edges = sorted(own, key=lambda each: graph.vertices[each.end].time_s)
    if not edges:
        raise StudyInputError(robot, "EDGE_SE2", "odometry of this robot", "none")
    times_s, path, variance = [graph.vertices[edges[0].begin].time_s], [(0.0, 0.0)], [0.0]
    for edge in edges:
        heading = graph.vertices[edge.begin].heading
        cos, sin = math.cos(heading), math.sin(heading)
        x, y = cos * edge.dx - sin * edge.dy, sin * edge.dx + cos * edge.dy
        times_s.append(graph.vertices[edge.end].time_s)
        path.append((path[-1][0] + x, path[-1][1] - y))
        variance.append(variance[-1] + edge.variance)
    return np.array(times_s), np.array(path), np.array(variance)
