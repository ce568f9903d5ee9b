"""``fleetloc bench speed``: our step against other solvers of the same windows, interleaved in one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from estimators.estimator import Status
from estimators.model.measurements import Matrix, Vector
from estimators.settings import EstimatorSettings
from fleetloc.bench.speed.bounds import CASES, CaseName
from fleetloc.bench.speed.cases import Case, CaseMaker, noise_excess
from fleetloc.bench.speed.own import filter_step, our_step, our_step_with_covariance
from fleetloc.bench.speed.peers_casadi import IPOPT, REFERENCE, SQP_OSQP, CasadiSolver, WindowNlp
from fleetloc.bench.speed.peers_scipy import MOST_VARIABLES, SlsqpSolver
from fleetloc.bench.speed.plain_numpy import PlainModel, PlainStep, prior_moments
from fleetloc.bench.speed.timing import Method, Timing, time_interleaved
from fleetloc.bench.speed.windows import DEFAULT_SIZES, Size, capture_windows

TIGHT_TOLERANCE = 1e-9

OURS, OURS_DEFAULT = "ours_1e-9", "ours_default"
"""Numerators of all ratios are other methods, denominators these two."""

Ends = tuple[Vector, Vector]
"""First and last state ``(6n,)`` of a window."""


@dataclass(frozen=True, slots=True)
class SpeedPlan:
    """What is measured."""

    seed: int = 0
    repeats: int = 30
    windows: int = 8
    sizes: tuple[Size, ...] = DEFAULT_SIZES
    cases: tuple[CaseName, ...] = CASES
    limit_s: float = 3.0
    """CPU time one method may take in one case; slow ones then do fewer repeats."""


@dataclass(frozen=True, slots=True)
class MethodResult:
    """Times of one method, and how far its answers are from our optimum (nan: it solves another problem)."""

    cpu_median_us: float
    cpu_p99_us: float
    timed_solves: int
    not_converged: int
    first_state_distance_max: float
    """Largest component difference at t-N over the windows, m or m/s."""
    last_state_distance_max: float


@dataclass(frozen=True, slots=True)
class Optimality:
    """Our 1e-9 answer judged by casadi's derivatives and costs, none of our kernels; worst of the windows."""

    gradient_max: float
    """Largest component of the gradient of half the cost at our point, 1/m or s/m (free windows)."""
    newton_step_max: float
    """What is left to the stationary point, m or m/s: Gauss-Newton step with that gradient (free windows)."""
    cost_excess_relative_max: float
    """Cost at our point over that at IPOPT's optimum (tolerance 1e-11), minus 1."""
    box_violation_max: float
    """m or m/s, zero where the box holds."""


@dataclass(frozen=True, slots=True)
class CaseResult:
    """All methods on the windows of one size with one kind of bounds."""

    name: CaseName
    active_bounds: list[int]
    optimality: Optimality
    methods: dict[str, MethodResult]
    ratios: dict[str, float]


@dataclass(frozen=True, slots=True)
class SizeResult:
    """All cases of one size."""

    agents: int
    window_ticks: int
    graph: str
    regional_agents: int
    rows_per_window: int
    cases: list[CaseResult] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Contender:
    """A method with what makes its answer comparable: both ends of the window, and whether it converged."""

    method: Method
    ends: Callable[[Any], Ends | None]
    converged: Callable[[Any], bool]


def run_speed(plan: SpeedPlan, progress: Callable[[str], None]) -> list[SizeResult]:
    """The whole study; ``progress`` hears what is being done. Raises `EnvironmentFault` without casadi."""
    return [_run_size(plan, size, progress) for size in plan.sizes]


def _run_size(plan: SpeedPlan, size: Size, progress: Callable[[str], None]) -> SizeResult:
    label = f"n={size.agents}, N={size.window}"
    progress(f"{label}: flying the fleet")
    windows = capture_windows(size, plan.windows, plan.seed)
    settings = EstimatorSettings(window=size.window)
    eps = settings.norm_smoothing_m
    progress(f"{label}: building casadi's solvers")
    nlp = WindowNlp(windows[0].problem(windows[0].fused()), eps)
    any_bounded = any(name != "free" for name in plan.cases)
    reference = CasadiSolver(nlp, "ipopt", REFERENCE, False, warm=False)
    bounded_reference = CasadiSolver(nlp, "ipopt", REFERENCE, True, warm=False) if any_bounded else None
    maker = CaseMaker(nlp, eps, reference, bounded_reference)
    rows = len(windows[0].rows)
    result = SizeResult(size.agents, size.window, size.graph, windows[0].regional_agents(), rows)
    for place, name in enumerate(CASES):
        if name not in plan.cases:
            continue
        progress(f"{label}: {name} windows")
        cases = maker.make(windows, name, np.random.default_rng([plan.seed, size.agents, size.window, place]))
        contenders = _contenders(cases, name, settings, nlp)
        progress(f"{label}: timing {len(contenders)} methods on {name} windows")
        methods = [contender.method for contender in contenders]
        rng = np.random.default_rng([plan.seed, place])
        timings = time_interleaved(methods, plan.repeats, plan.limit_s, rng)
        result.cases.append(_case_result(name, cases, contenders, timings, maker))
    return result


def _contenders(
    cases: Sequence[Case], name: CaseName, settings: EstimatorSettings, nlp: WindowNlp
) -> list[_Contender]:
    bounded = name != "free"
    found = [*_own_contenders(cases, name, settings)]
    for label, plugin, options in (("ipopt_warm", "ipopt", IPOPT), ("sqp_osqp", "sqpmethod", SQP_OSQP)):
        found.append(_casadi_contender(label, cases, CasadiSolver(nlp, plugin, options, bounded)))
    eps = settings.norm_smoothing_m
    if SlsqpSolver.variables(cases[0]) <= MOST_VARIABLES:
        solvers = [SlsqpSolver(case, eps) for case in cases]
        slsqp = Method("scipy_slsqp", [solver.run for solver in solvers])
        found.append(_Contender(slsqp, lambda answer: answer[:2], lambda answer: bool(answer[2])))
    plain = [PlainStep(case.window, eps, case.bounds) for case in cases]
    label = "plain_numpy_osqp" if bounded else "plain_numpy"
    found.append(_Contender(Method(label, [step.run for step in plain]), lambda answer: answer[:2], _always))
    return found


def _own_contenders(cases: Sequence[Case], name: CaseName, base: EstimatorSettings) -> list[_Contender]:
    def bounded(case: Case, settings: EstimatorSettings) -> EstimatorSettings:
        return settings if case.bounds is None else case.bounds.settings(settings)

    def step(label: str, settings: EstimatorSettings, run: Any = our_step) -> _Contender:
        calls = [_call(run, case.window, bounded(case, settings)) for case in cases]
        return _Contender(
            Method(label, calls),
            lambda solution: (solution.path[0], solution.path[-1]),
            lambda solution: bool(solution.status == Status.OK),
        )

    tight = msgspec.structs.replace(base, tolerance=TIGHT_TOLERANCE)
    found = [step(OURS, tight), step(OURS_DEFAULT, base)]
    if name == "active":
        found.append(step(f"{OURS}_daqp", msgspec.structs.replace(tight, qp="daqp")))
        found.append(step(f"{OURS_DEFAULT}_daqp", msgspec.structs.replace(base, qp="daqp")))
    else:
        found.append(step("ours_default_and_covariance", base, our_step_with_covariance))
    calls = [_call(filter_step, case.window, base) for case in cases]
    found.append(_Contender(Method("dekf_ci", calls), _no_ends, _always))
    return found


def _no_ends(answer: Any) -> Ends | None:  # noqa: ARG001 - the answer is to another problem
    return None


def _always(answer: Any) -> bool:  # noqa: ARG001 - a method that does not say whether it converged
    return True


def _call(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    return lambda: function(*arguments)


def _casadi_contender(label: str, cases: Sequence[Case], solver: CasadiSolver) -> _Contender:
    def call(case: Case) -> Callable[[], Any]:
        problem = case.window.problem(case.window.fused())
        arguments = solver.arguments(case.given, problem, case.bounds)
        return lambda: (solver.solve(arguments), solver.succeeded())

    def ends(answer: Any) -> Ends:
        path = solver.path(answer[0])
        return path[0], path[-1]

    return _Contender(Method(label, [call(case) for case in cases]), ends, lambda answer: bool(answer[1]))


def _case_result(
    name: CaseName,
    cases: Sequence[Case],
    contenders: Sequence[_Contender],
    timings: dict[str, Timing],
    maker: CaseMaker,
) -> CaseResult:
    ours = [solution.path for solution in timings[OURS].answers]
    methods = {
        contender.method.name: _method_result(contender, timings[contender.method.name], ours)
        for contender in contenders
    }
    judged = [_judge(case, path, maker) for case, path in zip(cases, ours, strict=True)]
    return CaseResult(
        name=name,
        active_bounds=[case.active for case in cases],
        optimality=Optimality(*(float(worst) for worst in np.max(judged, axis=0))),
        methods=methods,
        ratios=_ratios(methods),
    )


def _ratios(methods: dict[str, MethodResult]) -> dict[str, float]:
    """Medians over ours at both tolerances, and ours over DEKF-CI."""
    ratios = {
        f"{name}/{ours}": methods[name].cpu_median_us / methods[ours].cpu_median_us
        for name in methods
        if not name.startswith("ours") and name != "dekf_ci"
        for ours in (OURS, OURS_DEFAULT, f"{OURS}_daqp")
        if ours in methods
    }
    for ours in (OURS, OURS_DEFAULT):
        ratios[f"{ours}/dekf_ci"] = methods[ours].cpu_median_us / methods["dekf_ci"].cpu_median_us
    return ratios


def _method_result(contender: _Contender, timing: Timing, ours: Sequence[Matrix]) -> MethodResult:
    first, last = [], []
    for answer, path in zip(timing.answers, ours, strict=True):
        ends = contender.ends(answer)
        first.append(np.nan if ends is None else float(np.abs(ends[0] - path[0]).max()))
        last.append(np.nan if ends is None else float(np.abs(ends[1] - path[-1]).max()))
    return MethodResult(
        cpu_median_us=1e6 * timing.median_s,
        cpu_p99_us=1e6 * timing.p99_s,
        timed_solves=len(timing.cpu_s),
        not_converged=sum(not contender.converged(answer) for answer in timing.answers),
        first_state_distance_max=float(np.max(first)),
        last_state_distance_max=float(np.max(last)),
    )


def _judge(case: Case, path: Matrix, maker: CaseMaker) -> tuple[float, float, float, float]:
    """The figures of `Optimality` for one window."""
    problem = case.window.problem(case.window.fused())
    cost, gradient, *_ = (
        np.asarray(part.full()).ravel() for part in maker.residuals(path[0], case.given.parameters)
    )
    best, *_ = (
        np.asarray(part.full()).ravel() for part in maker.residuals(case.reference[0], case.given.parameters)
    )
    if case.bounds is None:
        model = PlainModel(problem, maker.eps)
        mean, covariance = prior_moments(problem)
        along = model.linearise(path[0], model.gains(mean, covariance))
        hessian, _ = model.quadratic(path[0], along, mean, problem.information)
        step = np.abs(np.linalg.solve(hessian, gradient)).max()
        return float(np.abs(gradient).max()), float(step), float(cost[0] / best[0] - 1.0), 0.0
    price = case.bounds.penalty / 2.0
    costs = [
        value[0]
        + price * np.maximum(noise_excess(case.window, maker.all_residuals(case.given, z)), 0.0).sum()
        for value, z in ((cost, path[0]), (best, case.reference[0]))
    ]
    violation = np.maximum(np.abs(path) - case.bounds.box(path.shape[1]), 0.0).max()
    return np.nan, np.nan, float(costs[0] / costs[1] - 1.0), float(violation)
