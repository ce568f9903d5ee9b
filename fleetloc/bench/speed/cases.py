"""Windows with bounds: loose ones, or such that one to three of them are active at the optimum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Kind, Matrix, Vector
from fleetloc.bench.speed.bounds import HALF_WIDTHS, Bounds, CaseName
from fleetloc.bench.speed.peers_casadi import CasadiSolver, Instance, WindowNlp, instance
from fleetloc.bench.speed.windows import BenchWindow

MOST_ACTIVE = 3
ON_BOUND = 1e-6
"""Relative distance from a bound below which it counts as active."""

ATTEMPTS = 60


@dataclass(frozen=True, slots=True)
class Case:
    """A window with its bounds (None: free) and what the peers need of it.

    ``reference`` ``(N+1, 6n)`` is IPOPT's optimum at a tight tolerance; ``active`` how many bounds hold there
    with equality (an excess of a soft bound counts).
    """

    window: BenchWindow
    bounds: Bounds | None
    given: Instance
    reference: Matrix
    active: int


class CaseMaker:
    """Makes the cases of one size; ``reference`` and ``bounded_reference`` solve without and with bounds."""

    def __init__(
        self, nlp: WindowNlp, eps: float, reference: CasadiSolver, bounded_reference: CasadiSolver | None
    ) -> None:
        self.residuals = nlp.gradient_function()
        self.eps = eps
        self.reference = reference
        self.bounded_reference = bounded_reference

    def make(self, windows: Sequence[BenchWindow], name: CaseName, rng: np.random.Generator) -> list[Case]:
        """One case per window, drawn with ``rng``."""
        if name == "free":
            return [self.solved(window, None) for window in windows]
        bounded = [_with_half_widths(window, rng) for window in windows]
        if name == "loose":
            return [self.solved(window, Bounds()) for window in bounded]
        return [self._active(window, rng) for window in bounded]

    def solved(self, window: BenchWindow, bounds: Bounds | None) -> Case:
        """The case with its optimum; raises ``ArithmeticError`` where IPOPT finds none."""
        problem = window.problem(window.fused())
        given = instance(problem, self.eps)
        solver = self.reference if bounds is None else self.bounded_reference
        assert solver is not None, "a solver with bounds is given where cases with bounds are made"
        answer = solver.solve(solver.arguments(given, problem, bounds))
        if not solver.succeeded():
            raise ArithmeticError("the reference solver did not converge on a window of the study")
        path = solver.path(answer)
        return Case(window, bounds, given, path, self._count_active(window, bounds, given, path))

    def _count_active(self, window: BenchWindow, bounds: Bounds | None, given: Instance, path: Matrix) -> int:
        if bounds is None:
            return 0
        box = bounds.box(path.shape[1])
        excess = noise_excess(window, self.all_residuals(given, path[0]))
        on_box = np.abs(path) > box * (1.0 - ON_BOUND)
        return int(np.count_nonzero(on_box) + np.count_nonzero(excess > -ON_BOUND))

    def all_residuals(self, given: Instance, z: Vector) -> Vector:
        """y - h(x_k) ``(m,)`` along the trajectory from ``z`` ``(6n,)``, by casadi."""
        return np.asarray(self.residuals(z, given.parameters)[3].full().ravel(), np.float64)

    def _active(self, window: BenchWindow, rng: np.random.Generator) -> Case:
        """One row an outlier, and a box that the most distant agent just leaves, until 1 to 3 are active."""
        for attempt in range(ATTEMPTS):
            shifted = _with_outlier(window, rng, 1.0 + 0.1 * attempt)
            inner = self.solved(shifted, Bounds())
            if not 1 <= inner.active < MOST_ACTIVE:
                continue
            largest = float(np.abs(inner.reference.reshape(-1, STATES_PER_AGENT)[:, :3]).max())
            boxed = self.solved(shifted, Bounds(position_m=largest - float(rng.uniform(0.01, 0.03))))
            if inner.active < boxed.active <= MOST_ACTIVE:
                return boxed
        raise ArithmeticError(f"no window with 1 to {MOST_ACTIVE} active bounds in {ATTEMPTS} attempts")


def noise_excess(window: BenchWindow, residuals: Vector) -> Vector:
    """By how much the residuals ``(m,)`` of the rows with bounds exceed them, in half widths."""
    first = int(window.start[1])
    half = window.rows["half_width"][first:]
    return np.asarray(np.abs(residuals[first:]) / half - 1.0, np.float64)


def _with_half_widths(window: BenchWindow, rng: np.random.Generator) -> BenchWindow:
    rows = window.rows.copy()
    rows["half_width"] = rng.uniform(*HALF_WIDTHS, len(rows))
    return replace(window, rows=rows)


def _with_outlier(window: BenchWindow, rng: np.random.Generator, half_widths: float) -> BenchWindow:
    """A position or range row after the first tick off by ``half_widths`` of its own and a bit."""
    rows = window.rows.copy()
    later = np.arange(len(rows)) >= window.start[1]
    candidates = np.flatnonzero(later & np.isin(rows["kind"], (Kind.POSITION, Kind.RANGE)))
    chosen = rng.choice(candidates)
    rows["value"][chosen] += rng.choice((-1.0, 1.0)) * half_widths * rows["half_width"][chosen]
    return replace(window, rows=rows)
