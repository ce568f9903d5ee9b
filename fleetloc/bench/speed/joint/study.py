"""Our window against acados and IPOPT on the same windows, whose first state and accelerations are free."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from estimators.estimator import Status
from estimators.model.measurements import Matrix
from estimators.settings import DEFAULT_KIND, EstimatorSettings
from estimators.window.problem import WindowProblem, WindowSolution
from estimators.window.solving import solve_window
from fleetloc.bench.speed.fleet.flight import (
    DEFAULT_FLEETS,
    Fleet,
    FleetFlight,
    record_drone,
    record_flight,
    transient_ticks,
)
from fleetloc.bench.speed.fleet.study import settings_of
from fleetloc.bench.speed.joint.acados_client import AcadosAnswer, AcadosClient, AcadosMissingError
from fleetloc.bench.speed.joint.ipopt import StagedNlp
from fleetloc.bench.speed.joint.windows import Edges, StagedWindow, capture_joint_windows, staged
from fleetloc.bench.speed.peers_casadi import IPOPT
from fleetloc.bench.speed.timing import Method, Timing, time_interleaved
from fleetloc.bench.speed.windows import TICKS_BETWEEN_WINDOWS

OURS, OURS_DEFAULT = "ours_1e-9", "ours_default"
TIGHT_TOLERANCE = 1e-9
ACADOS_TOLERANCE = 1e-7
"""Of the gradient; it then is within 1e-9 m of the optimum."""
ACADOS_PLANS = ("riccati", "condensed")

WITHOUT_ACADOS = (
    "acados is not compared: --acados names the Python of an environment of its own, made with "
    "pip install comma-deps-acados (and a C compiler)"
)


@dataclass(frozen=True, slots=True)
class JointPlan:
    """What is measured; ``acados``: a Python that has it, or None."""

    seed: int = 0
    fleets: tuple[Fleet, ...] = DEFAULT_FLEETS
    windows: int = 8
    repeats: int = 30
    limit_s: float = 3.0
    acados: str | None = None


@dataclass(frozen=True, slots=True)
class JointMethod:
    """Times of one method, and how far its states are from `OURS`, m or m/s."""

    cpu_median_us: float
    cpu_p99_us: float
    timed_solves: int
    not_converged: int
    over_ours: float
    distance_max: float


@dataclass(frozen=True, slots=True)
class JointResult:
    """All methods on the windows of one fleet."""

    agents: int
    graph: str
    window_ticks: int
    rows_per_window: int
    missing: list[str] = field(default_factory=list)
    methods: dict[str, JointMethod] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Entrant:
    """A method, and how its answer is read: the states ``(N+1, 6n)``, and whether it converged."""

    method: Method
    read: Callable[[Any], tuple[Matrix, bool]]


@dataclass(frozen=True, slots=True)
class _Windows:
    problems: list[WindowProblem]
    stages: list[StagedWindow]
    edges: Edges
    period_s: float
    settings: EstimatorSettings


def run_joint(plan: JointPlan, progress: Callable[[str], None]) -> list[JointResult]:
    """The study; ``progress`` hears what is being done. Raises `EnvironmentFault` without casadi."""
    return [_run_fleet(plan, fleet, progress) for fleet in plan.fleets]


def _run_fleet(plan: JointPlan, fleet: Fleet, progress: Callable[[str], None]) -> JointResult:
    progress(f"{fleet.label}: flying for windows")
    windows = _capture(record_flight(fleet, TICKS_BETWEEN_WINDOWS * (plan.windows - 1), plan.seed), plan.windows)
    entrants, missing = [*_ours(windows), _ipopt(windows)], []
    with ExitStack() as stack:
        progress(f"{fleet.label}: compiling acados")
        folder = Path(stack.enter_context(TemporaryDirectory()))
        try:
            entrants += _acados(plan.acados, windows, folder, stack)
        except AcadosMissingError as error:
            missing.append(str(error))
        progress(f"{fleet.label}: timing {len(entrants)} methods")
        rng = np.random.default_rng([plan.seed, fleet.agents, 13])
        methods = [entrant.method for entrant in entrants]
        timings = time_interleaved(methods, plan.repeats, plan.limit_s, rng)
    problem = windows.problems[0]
    rows = len(problem.rows)
    return JointResult(
        fleet.agents, fleet.graph, len(problem.accel), rows, missing, _results(entrants, timings)
    )


def _capture(flight: FleetFlight, count: int) -> _Windows:
    settings = settings_of(DEFAULT_KIND)
    ticks = range(transient_ticks(), transient_ticks() + TICKS_BETWEEN_WINDOWS * count, TICKS_BETWEEN_WINDOWS)
    problems = capture_joint_windows(flight, settings, record_drone(flight, settings), ticks)
    edges = [(a, b) for edge in flight.recording.edges.tolist() for a, b in (edge, edge[::-1])]
    stages = [staged(problem, edges) for problem in problems]
    return _Windows(problems, stages, edges, flight.recording.period_s, settings)


def _ours(windows: _Windows) -> list[_Entrant]:
    def read(answer: WindowSolution) -> tuple[Matrix, bool]:
        return answer.path, answer.status is Status.OK

    def entrant(name: str, settings: EstimatorSettings) -> _Entrant:
        calls = [lambda problem=problem: solve_window(problem, settings) for problem in windows.problems]
        return _Entrant(Method(name, calls), read)

    tight = msgspec.structs.replace(windows.settings, tolerance=TIGHT_TOLERANCE)
    return [entrant(OURS, tight), entrant(OURS_DEFAULT, windows.settings)]


def _ipopt(windows: _Windows) -> _Entrant:
    # no duals are handed on: without inequalities there is no multiplier that a window would keep
    options = {name: value for name, value in IPOPT.items() if "warm_start" not in name}
    eps = windows.settings.norm_smoothing_m
    nlp = StagedNlp(windows.stages[0], windows.edges, windows.period_s, eps, options)
    arguments = [nlp.arguments(stages) for stages in windows.stages]
    calls = [lambda given=given: nlp.solve(given) for given in arguments]
    return _Entrant(Method("ipopt", calls), lambda answer: answer)


def _acados(python: str | None, windows: _Windows, folder: Path, stack: ExitStack) -> list[_Entrant]:
    if python is None:
        raise AcadosMissingError(WITHOUT_ACADOS)

    def entrant(plan: str) -> _Entrant:
        eps = windows.settings.norm_smoothing_m
        given = windows.stages, windows.edges, windows.period_s, eps, ACADOS_TOLERANCE, folder
        client = stack.enter_context(AcadosClient(python, plan, *given))
        calls = [lambda window=window: client.solve(window) for window in range(len(windows.stages))]
        return _Entrant(Method(f"acados_{plan}", calls, elsewhere=_set_and_solve_s), _read_acados)

    return [entrant(plan) for plan in ACADOS_PLANS]


def _set_and_solve_s(answer: AcadosAnswer) -> float:
    return answer.set_s + answer.solve_s


def _read_acados(answer: AcadosAnswer) -> tuple[Matrix, bool]:
    return answer.path, answer.status == 0


def _results(entrants: Sequence[_Entrant], timings: dict[str, Timing]) -> dict[str, JointMethod]:
    optimum = [solution.path for solution in timings[OURS].answers]
    found = {}
    for entrant in entrants:
        timing = timings[entrant.method.name]
        read = [entrant.read(answer) for answer in timing.answers]
        away = [np.abs(path - best).max() for (path, _), best in zip(read, optimum, strict=True)]
        found[entrant.method.name] = JointMethod(
            cpu_median_us=1e6 * timing.median_s,
            cpu_p99_us=1e6 * timing.p99_s,
            timed_solves=len(timing.cpu_s),
            not_converged=sum(not converged for _, converged in read),
            over_ours=timing.median_s / timings[OURS].median_s,
            distance_max=float(np.max(away)),
        )
    return found
