"""gtsam's fixed-lag smoothers over the whole fleet, with gtsam's own factors; nothing of it calls back into Python.

Every drone has a position and a velocity per tick (Point3 each). GPS and velocity are PriorFactorPoint3, ranges
RangeFactor3, the acceleration a BetweenFactorPoint3 of the velocities. That a position is the integral of its
velocity is a linear factor over four variables; gtsam's smoothers want noise on it: `INTEGRAL_SIGMA_M`. A smoother
gets what the whole fleet measured as it is measured, without any link between drones.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimators.model.layout import position, velocity
from estimators.model.measurements import InputTable, Kind, RowTable, Vector, is_shifted
from fleetloc.bench.speed.fleet.flight import FleetFlight

INTEGRAL_SIGMA_M = 1e-4
"""Moves the flights' estimates by less than 1e-6 m; with a third of it the Cholesky factorisations begin to fail."""

RELINEARIZE_ABOVE = 1e-4
"""Of the incremental smoother that is to come near the optimum: m and m/s."""


def is_installed() -> bool:
    """Whether gtsam is there; imports nothing."""
    return importlib.util.find_spec("gtsam") is not None


@dataclass(frozen=True, slots=True)
class TickGraph:
    """What a tick adds to a smoother: factors, first guesses, and the times of the new variables."""

    factors: Any
    guesses: Any
    times: dict[int, float]


class GraphMaker:
    """Turns the flight's tables into gtsam's factors."""

    def __init__(self, flight: FleetFlight) -> None:
        self.gtsam: Any = importlib.import_module("gtsam")
        self.flight = flight
        self.period_s = flight.recording.period_s

    def position_key(self, tick: int, slot: int) -> int:
        """Name of a drone's position."""
        return int(self.gtsam.symbol("p", tick * self.flight.agents + slot))

    def velocity_key(self, tick: int, slot: int) -> int:
        """Name of a drone's velocity."""
        return int(self.gtsam.symbol("v", tick * self.flight.agents + slot))

    def keys(self, tick: int) -> list[int]:
        """All variables of a tick: positions and velocities in turn."""
        slots = range(self.flight.agents)
        return [key for slot in slots for key in (self.position_key(tick, slot), self.velocity_key(tick, slot))]

    def tick(self, tick: int, before: Vector | None) -> TickGraph:
        """What the fleet measured at a tick; ``before`` ``(6n,)`` is the estimate of the tick before, None at 0."""
        flight, factors = self.flight, self.gtsam.NonlinearFactorGraph()
        mean = flight.prior_mean if before is None else before.copy()
        for slot in range(flight.agents):
            if before is None:
                self._add_prior(factors, slot)
            else:
                accel = self._add_motion(factors, tick, slot, flight.inputs[tick][slot])
                mean[position(slot)] += self.period_s * (mean[velocity(slot)] + 0.5 * self.period_s * accel)
                mean[velocity(slot)] += self.period_s * accel
            self._add_rows(factors, tick, flight.rows[tick][slot])
        guesses = self.gtsam.Values()
        for key, guess in zip(self.keys(tick), mean.reshape(-1, 3), strict=True):
            guesses.insertPoint3(key, guess)
        return TickGraph(factors, guesses, dict.fromkeys(self.keys(tick), tick * self.period_s))

    def _add_prior(self, factors: Any, slot: int) -> None:
        sigma = np.sqrt(np.diag(self.flight.recording.P0))
        mean = self.flight.prior_mean
        for key, part in ((self.position_key, position(slot)), (self.velocity_key, velocity(slot))):
            noise = self.gtsam.noiseModel.Diagonal.Sigmas(sigma[part])
            factors.add(self.gtsam.PriorFactorPoint3(key(0, slot), mean[part], noise))

    def _add_motion(self, factors: Any, tick: int, slot: int, known: InputTable) -> Vector:
        """The input over the tick that ends at ``tick``; gives it ``(3,)``, m/s2."""
        (accel,), (variance,) = known["accel"], known["variance"]
        noise = self.gtsam.noiseModel.Diagonal.Sigmas(self.period_s * np.sqrt(variance))
        last, now = self.velocity_key(tick - 1, slot), self.velocity_key(tick, slot)
        factors.add(self.gtsam.BetweenFactorPoint3(last, now, self.period_s * accel, noise))
        factors.add(self._integral(self.position_key(tick - 1, slot), last, self.position_key(tick, slot), now))
        return np.asarray(accel, np.float64)

    def _integral(self, p0: int, v0: int, p1: int, v1: int) -> Any:
        """p1 - p0 - dt/2 (v0 + v1) = 0, with gtsam's own elimination.

        Its wrapper makes linear factors of three variables at most: a fourth, the way s, is put between
        (s = p1 - p0, s = dt/2 (v0 + v1)) and eliminated.
        """
        gtsam, one, way = self.gtsam, np.eye(3), self.gtsam.symbol("s", 0)
        noise = gtsam.noiseModel.Isotropic.Sigma(3, INTEGRAL_SIGMA_M / np.sqrt(2.0))
        half = -0.5 * self.period_s * one
        graph = gtsam.GaussianFactorGraph()
        graph.add(gtsam.JacobianFactor(way, one, p0, one, p1, -one, np.zeros(3), noise))
        graph.add(gtsam.JacobianFactor(way, one, v0, half, v1, half, np.zeros(3), noise))
        ordering = gtsam.Ordering()
        ordering.push_back(way)
        _, rest = graph.eliminatePartialSequential(ordering)
        zero = gtsam.Values()  # without a point the container would hold its factor for steps, not for states
        for key in (p0, v0, p1, v1):
            zero.insertPoint3(key, np.zeros(3))
        return gtsam.LinearContainerFactor(gtsam.JacobianFactor(rest.at(0)), zero)

    def _add_rows(self, factors: Any, tick: int, rows: RowTable) -> None:
        if rows["offset_s"].any() or is_shifted(rows):
            raise ValueError("gtsam: expected rows at the tick's instant, without lever arms")
        keys: dict[int, Callable[[int, int], int]] = {
            Kind.POSITION: self.position_key,
            Kind.VELOCITY: self.velocity_key,
        }
        for kind, key in keys.items():
            for vector in _vectors(rows[rows["kind"] == kind]):
                noise = self.gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(vector["variance"]))
                where = key(tick, int(vector["agent"][0]))
                factors.add(self.gtsam.PriorFactorPoint3(where, vector["value"], noise))
        ranges = rows[rows["kind"] == Kind.RANGE]
        for agent, other, value, variance in ranges[["agent", "other", "value", "variance"]].tolist():
            ends = self.position_key(tick, agent), self.position_key(tick, other)
            noise = self.gtsam.noiseModel.Isotropic.Sigma(1, variance**0.5)
            factors.add(self.gtsam.RangeFactor3(*ends, value, noise))


def _vectors(rows: RowTable) -> Iterable[RowTable]:
    """Rows in threes, one vector each; raises ``ValueError`` where they are not along the NED axes."""
    for first in range(0, len(rows), 3):
        vector = rows[first : first + 3]
        if len(vector) != 3 or not np.array_equal([vector["x"], vector["y"], vector["z"]], np.eye(3)):
            raise ValueError("gtsam: expected positions and velocities along the NED axes, in threes")
        yield vector


@dataclass(slots=True)
class Smoother:
    """One of gtsam's fixed-lag smoothers: ``make`` gives a fresh one.

    Its step is the update and the newest estimate of the whole fleet, with ``covariances`` also the covariance of
    each position and each velocity (3, 3). Making the graph of a tick is not timed.
    """

    name: str
    maker: GraphMaker
    make: Callable[[], Any]
    covariances: bool = False
    _smoother: Any = field(init=False)
    _newest: Vector | None = field(init=False)
    _graph: TickGraph = field(init=False)

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """An empty smoother."""
        self._smoother = self.make()
        self._newest = None

    def prepare(self, tick: int) -> None:
        """Make the factors of the tick."""
        self._graph = self.maker.tick(tick, self._newest)

    def step(self, tick: int) -> tuple[list[Vector], list[Any]]:
        """Update; positions and velocities in turn, and their covariances where wanted."""
        graph, smoother = self._graph, self._smoother
        smoother.update(graph.factors, graph.guesses, graph.times)
        means = [smoother.calculateEstimatePoint3(key) for key in graph.times]
        covariances = [smoother.marginalCovariance(key) for key in graph.times] if self.covariances else []
        self._newest = np.concatenate(means)
        return means, covariances

    def mean(self, answer: tuple[list[Vector], list[Any]]) -> Vector:
        """The fleet's state."""
        return np.concatenate(answer[0])

    def path(self, tick: int, ticks: int) -> list[Vector]:
        """The newest ``ticks`` states of the fleet ``(6n,)`` in the smoother after the step of ``tick``."""
        ways = [self.maker.keys(each) for each in range(tick - ticks + 1, tick + 1)]
        return [np.concatenate([self._smoother.calculateEstimatePoint3(key) for key in keys]) for keys in ways]


def smoothers(flight: FleetFlight, lag_ticks: int) -> list[Smoother]:
    """All of gtsam's that take part; they keep the states of ``lag_ticks`` ticks before the newest, as our window."""
    maker = GraphMaker(flight)
    gtsam = maker.gtsam
    lag_s = (lag_ticks + 0.5) * maker.period_s  # half a tick: no rounding decides what is marginalised

    def incremental(near_optimum: bool) -> Callable[[], Any]:
        parameters = gtsam.ISAM2Params()
        if near_optimum:
            parameters.setRelinearizeThreshold(RELINEARIZE_ABOVE)
            parameters.relinearizeSkip = 1
        return lambda: gtsam.IncrementalFixedLagSmoother(lag_s, parameters)

    return [
        Smoother("gtsam_incremental", maker, incremental(False)),
        Smoother("gtsam_incremental_covariances", maker, incremental(False), covariances=True),
        Smoother("gtsam_incremental_relinearised", maker, incremental(True)),
        Smoother("gtsam_batch", maker, lambda: gtsam.BatchFixedLagSmoother(lag_s)),
    ]

