"""The whole step of one drone against smoothers of the whole fleet, interleaved tick by tick in one run."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix, Vector
from estimators.settings import DEFAULT_KIND, EstimatorSettings, Kind, with_kind_defaults
from fleetloc.bench.speed.fleet import smoothers
from fleetloc.bench.speed.fleet.contenders import Contender, WholeStep
from fleetloc.bench.speed.fleet.flight import (
    DEFAULT_FLEETS,
    Fleet,
    FleetFlight,
    record_drone,
    record_flight,
    transient_ticks,
)
from fleetloc.bench.speed.timing import Clock, collector_off

REFERENCE = "gtsam_batch"
"""Solves each tick's window of the whole fleet to its optimum: what distances are to."""

RIVAL = "gtsam_incremental"
"""What our whole step is measured against."""

SAME_PROBLEM = " without slow errors"
"""Goes after the name of a kind: it solves the problem that the smoothers solve, while what is flown by default also
estimates the slow errors of its sensors."""

WITHOUT_GTSAM = "gtsam is not installed (pip install 'fleetloc[studies]'): its smoothers are not in the table"


@dataclass(frozen=True, slots=True)
class FleetPlan:
    """What is measured: ``kinds`` of ours, the first of which the ratios are to."""

    seed: int = 0
    fleets: tuple[Fleet, ...] = DEFAULT_FLEETS
    kinds: tuple[Kind, ...] = (DEFAULT_KIND,)
    ticks: int = 60
    """Timed ticks of a flight, after its transient."""
    rounds: int = 5
    """Times that the flight is gone through."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """One contender over the timed ticks; lengths in m."""

    cpu_median_us: float
    cpu_p99_us: float
    over_ours: float
    """Its median CPU time over that of our first kind."""
    own_error_rms: float
    """Position of the timed drone against the truth, 3-D."""
    fleet_error_rms: float
    """Positions of all drones."""
    distance_max: float
    """Largest component difference to `REFERENCE`, m or m/s, over all states and timed ticks; nan without it."""


@dataclass(frozen=True, slots=True)
class FleetResult:
    """All contenders on the flight of one fleet; ``missing`` says who could not take part, and why."""

    agents: int
    graph: str
    lag_ticks: int
    rows_per_tick: int
    timed_steps: int
    over_incremental: dict[str, float] = field(default_factory=dict)
    """Median CPU time of each kind of ours over that of `RIVAL`."""
    missing: list[str] = field(default_factory=list)
    steps: dict[str, StepResult] = field(default_factory=dict)


def settings_of(kind: Kind) -> EstimatorSettings:
    """The settings that a configuration with this kind, and nothing else, has."""
    return msgspec.convert(with_kind_defaults({"kind": kind}), EstimatorSettings)


def run_fleets(plan: FleetPlan, progress: Callable[[str], None]) -> list[FleetResult]:
    """The study; ``progress`` hears what is being done."""
    return [_run_fleet(plan, fleet, progress) for fleet in plan.fleets]


def _run_fleet(plan: FleetPlan, fleet: Fleet, progress: Callable[[str], None]) -> FleetResult:
    progress(f"{fleet.label}: flying")
    flight = record_flight(fleet, plan.ticks, plan.seed)
    contenders: list[Contender] = []
    for kind in plan.kinds:
        progress(f"{fleet.label}: {kind} on every drone")
        settings = settings_of(kind)
        contenders.append(WholeStep(kind, flight, settings, record_drone(flight, settings)))
        if settings.systematic_errors:
            alike = msgspec.structs.replace(settings, systematic_errors=False)
            contenders.append(WholeStep(kind + SAME_PROBLEM, flight, alike, record_drone(flight, alike)))
    lag_ticks = settings_of(plan.kinds[0]).window
    missing = [] if smoothers.is_installed() else [WITHOUT_GTSAM]
    if not missing:
        contenders += smoothers.smoothers(flight, lag_ticks)
    progress(f"{fleet.label}: timing {len(contenders)} ways through the flight")
    rng = np.random.default_rng([plan.seed, fleet.agents, 12])
    cpu_s, means = time_flight(contenders, flight.ticks, transient_ticks(), plan.rounds, rng)
    steps = _results(flight, cpu_s, means)
    return FleetResult(
        agents=fleet.agents,
        graph=fleet.graph,
        lag_ticks=lag_ticks,
        rows_per_tick=sum(len(rows) for rows in flight.rows[-1]),
        timed_steps=len(cpu_s[contenders[0].name]),
        over_incremental={
            name: step.cpu_median_us / steps[RIVAL].cpu_median_us
            for name, step in steps.items()
            if RIVAL in steps and name.startswith(plan.kinds)
        },
        missing=missing,
        steps=steps,
    )


def time_flight(
    contenders: Sequence[Contender],
    ticks: int,
    untimed: int,
    rounds: int,
    rng: np.random.Generator,
    clock: Clock = time.process_time,
) -> tuple[dict[str, list[float]], dict[str, Matrix]]:
    """CPU time of every step after the first ``untimed`` ticks, in s, and the states ``(ticks, 6n)``, by name.

    In each tick all prepare first; then they step in an order that is drawn anew, so that each finds the caches as
    the others left them. Garbage is collected between rounds.
    """
    cpu_s: dict[str, list[float]] = {each.name: [] for each in contenders}
    means: dict[str, list[Vector]] = {}
    for _ in range(rounds):
        means = {each.name: [] for each in contenders}
        for each in contenders:
            each.restart()
        with collector_off():
            for tick in range(ticks):
                for each in contenders:
                    each.prepare(tick)
                for turn in rng.permutation(len(contenders)):
                    spent, mean = _timed(contenders[turn], tick, clock)
                    means[contenders[turn].name].append(mean)
                    if tick >= untimed:
                        cpu_s[contenders[turn].name].append(spent)
    return cpu_s, {name: np.array(path) for name, path in means.items()}


def _timed(contender: Contender, tick: int, clock: Clock) -> tuple[float, Vector]:
    begun = clock()
    answer: Any = contender.step(tick)
    spent = clock() - begun
    return spent, contender.mean(answer)


def _results(flight: FleetFlight, cpu_s: dict[str, list[float]], means: dict[str, Matrix]) -> dict[str, StepResult]:
    truth = flight.recording.truth
    assert truth is not None
    timed = slice(transient_ticks(), None)
    first = float(np.median(next(iter(cpu_s.values()))))
    found = {}
    for name, spent in cpu_s.items():
        path = means[name][timed].reshape(-1, flight.agents, STATES_PER_AGENT)
        square = ((path - truth[timed])[:, :, :3] ** 2).sum(axis=2)
        away = np.abs(means[name] - means[REFERENCE])[timed].max() if REFERENCE in means else np.nan
        found[name] = StepResult(
            cpu_median_us=1e6 * float(np.median(spent)),
            cpu_p99_us=1e6 * float(np.percentile(spent, 99)),
            over_ours=float(np.median(spent)) / first,
            own_error_rms=float(np.sqrt(square[:, flight.slot].mean())),
            fleet_error_rms=float(np.sqrt(square.mean())),
            distance_max=float(away),
        )
    return found
