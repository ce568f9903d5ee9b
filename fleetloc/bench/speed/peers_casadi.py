"""The same windows for casadi's solvers: IPOPT and sequential quadratic programming with OSQP.

The nonlinear program is that of `estimators.window.least_squares` over the states of the whole window (multiple
shooting, the form that suits both solvers best: sparse exact derivatives), with the frozen gains, the prior
and the measurements as parameters. It is built once for all windows of one structure, so only the solution is
timed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Kind, Matrix, RowTable, Vector
from estimators.model.motion import input_matrix, transition_matrix
from estimators.window.problem import WindowProblem
from fleetloc.bench.speed.bounds import Bounds
from fleetloc.bench.speed.plain_numpy import PlainModel, prior_moments
from fleetloc.extras import require_extra

TOLERANCE = 1e-9

IPOPT: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": TOLERANCE,
    "ipopt.bound_relax_factor": 0.0,  # its default moves active bounds by 1e-8 and the optimum by much more
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-6,
    "ipopt.warm_start_bound_push": 1e-8,
    "ipopt.warm_start_bound_frac": 1e-8,
    "ipopt.warm_start_slack_bound_push": 1e-8,
    "ipopt.warm_start_slack_bound_frac": 1e-8,
    "ipopt.warm_start_mult_bound_push": 1e-8,
}
REFERENCE: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-11,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.max_iter": 500,
}
SQP_OSQP: dict[str, Any] = {
    "print_time": False,
    "print_header": False,
    "print_iteration": False,
    "print_status": False,
    "tol_pr": TOLERANCE,
    "tol_du": 1e-7,
    "max_iter": 30,
    "error_on_fail": False,
    "qpsol": "osqp",
    "qpsol_options": {
        "error_on_fail": False,
        "osqp": {"verbose": False, "eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 5000},
    },
}


def require_casadi() -> Any:
    """The casadi module; raises `EnvironmentFault` where it is not installed."""
    require_extra("studies", "bench speed has no solver to compare with")
    import casadi

    return casadi


@dataclass(frozen=True, slots=True)
class Instance:
    """One window in numbers.

    ``parameters`` as `WindowNlp` orders them; ``start`` the EKF's states ``(N+1, 6n)`` from the prior mean,
    where all peers begin.
    """

    parameters: Vector
    start: Matrix


def instance(problem: WindowProblem, eps: float) -> Instance:
    """Prior, gains and start of a window, computed by the plain model."""
    model = PlainModel(problem, eps)
    mean, covariance = prior_moments(problem)
    gains = model.gains(mean, covariance)
    rows = problem.rows
    parts = [mean, problem.information.ravel(), problem.accel.ravel(), rows["value"], 1.0 / rows["variance"]]
    parts += [gain.ravel() for gain in gains]
    return Instance(np.concatenate(parts), np.array(model.linearise(mean, gains).states))


class WindowNlp:
    """Symbolic model of all windows with the rows of ``problem`` (its numbers do not matter)."""

    def __init__(self, problem: WindowProblem, eps: float) -> None:
        casadi = require_casadi()
        self.casadi = casadi
        self.eps = eps
        self.rows = [problem.rows[i:j] for i, j in pairwise(problem.start)]
        self.d = len(problem.vector)
        self.period_s = problem.period_s
        sizes = [self.d, self.d**2, problem.accel.size, len(problem.rows), len(problem.rows)]
        sizes += [self.d * len(rows) for rows in self.rows[1:]]
        self.parameters = casadi.SX.sym("p", sum(sizes))
        parts = casadi.vertsplit(self.parameters, np.concatenate([[0], np.cumsum(sizes)]).tolist())
        self.mean, self.accel = parts[0], casadi.reshape(parts[2], problem.accel.shape[1], -1)
        self.information = casadi.reshape(parts[1], self.d, self.d)
        self.value, self.precision = parts[3], parts[4]
        self.gains = [
            casadi.reshape(part, len(rows), self.d).T
            for part, rows in zip(parts[5:], self.rows[1:], strict=True)
        ]
        agents = self.d // STATES_PER_AGENT
        self.a = casadi.DM(casadi.sparsify(transition_matrix(agents, problem.period_s)))
        self.b = casadi.DM(casadi.sparsify(input_matrix(agents, problem.period_s)))
        self.starts = problem.start.tolist()

    def residuals(self, tick: int, x: Any) -> Any:
        """y - h(x) of a tick, symbolic."""
        value = self.value[self.starts[tick] : self.starts[tick + 1]]
        return value - self.casadi.vertcat(*(self._predicted(row, x) for row in self.rows[tick]))

    def _predicted(self, row: RowTable, x: Any) -> Any:
        at = STATES_PER_AGENT * int(row["agent"])
        if row["kind"] == Kind.POSITION:
            return float(row["x"]) * x[at] + float(row["y"]) * x[at + 1] + float(row["z"]) * x[at + 2]
        shift = self.casadi.DM([float(row["x"]), float(row["y"]), float(row["z"])])
        if row["kind"] == Kind.SPEED:
            vector = x[at + 3 : at + 6] + shift
        else:
            other = STATES_PER_AGENT * int(row["other"])
            vector = x[at : at + 3] - x[other : other + 3] + shift
        return self.casadi.sqrt(self.casadi.sumsqr(vector) + self.eps**2)

    def advance(self, tick: int, x: Any) -> Any:
        """State of a tick from that of the tick before, corrected with the frozen gain."""
        predicted = self.a @ x + self.b @ self.accel[:, tick - 1]
        return predicted + self.gains[tick - 1] @ self.residuals(tick, predicted)

    def half_cost(self, states: Sequence[Any], residuals: Sequence[Any]) -> Any:
        """Half of (9), as a solver likes it."""
        off = states[0] - self.mean
        total = self.casadi.bilin(self.information, off, off)
        for tick, r in enumerate(residuals):
            total += self.casadi.dot(self.precision[self.starts[tick] : self.starts[tick + 1]], r**2)
        return 0.5 * total

    def gradient_function(self) -> Any:
        """(z ``(6n,)``, p) -> half cost, its gradient ``(6n,)``, states, residuals; by single shooting."""
        z = self.casadi.SX.sym("z", self.d)
        states = [z]
        for tick in range(1, len(self.rows)):
            states.append(self.advance(tick, states[-1]))
        residuals = [self.residuals(tick, x) for tick, x in enumerate(states)]
        cost = self.half_cost(states, residuals)
        outputs = [
            cost,
            self.casadi.gradient(cost, z),
            self.casadi.vertcat(*states),
            self.casadi.vertcat(*residuals),
        ]
        return self.casadi.Function("window", [z, self.parameters], outputs)

    def program(self, bounded: bool) -> dict[str, Any]:
        """Variables, cost, constraints: defects, then (bounded) residual -+ excess of rows with bounds."""
        casadi = self.casadi
        states = [casadi.SX.sym(f"x{tick}", self.d) for tick in range(len(self.rows))]
        defects = [states[k] - self.advance(k, states[k - 1]) for k in range(1, len(states))]
        residuals = [self.residuals(tick, x) for tick, x in enumerate(states)]
        cost = self.half_cost(states, residuals)
        if not bounded:
            return {
                "x": casadi.vertcat(*states),
                "p": self.parameters,
                "f": cost,
                "g": casadi.vertcat(*defects),
            }
        later = casadi.vertcat(*residuals[1:])
        excess = casadi.SX.sym("s", later.shape[0])
        price = casadi.SX.sym("price", later.shape[0])
        return {
            "x": casadi.vertcat(*states, excess),
            "p": casadi.vertcat(self.parameters, price),
            "f": cost + casadi.dot(price, excess),
            "g": casadi.vertcat(*defects, later - excess, later + excess),
        }


class CasadiSolver:
    """A solver for all windows of one structure; duals are handed on from one solution to the next.

    ``method`` is a casadi nlpsol plugin. ``warm`` False starts every solution from scratch.
    """

    def __init__(
        self, nlp: WindowNlp, method: str, options: dict[str, Any], bounded: bool, *, warm: bool = True
    ) -> None:
        self.bounded = bounded
        self.warm = warm
        self.d, self.ticks = nlp.d, len(nlp.rows)
        self.later = slice(nlp.starts[1], nlp.starts[-1])
        self.solver = nlp.casadi.nlpsol("solver", method, nlp.program(bounded), options)
        self.duals: dict[str, Any] = {}

    def arguments(self, given: Instance, problem: WindowProblem, bounds: Bounds | None) -> dict[str, Any]:
        """What the solver is called with: everything that is known before the solution starts."""
        defects = np.zeros(self.d * (self.ticks - 1))
        if bounds is None:
            return {"x0": given.start.ravel(), "p": given.parameters, "lbg": defects, "ubg": defects}
        half = problem.rows["half_width"][self.later]
        endless = np.full(len(half), np.inf)
        box = np.tile(bounds.box(self.d), self.ticks)
        return {
            "x0": np.concatenate([np.clip(given.start.ravel(), -box, box), np.zeros(len(half))]),
            "p": np.concatenate([given.parameters, bounds.penalty / 2.0 / half]),
            "lbx": np.concatenate([-box, np.zeros(len(half))]),
            "ubx": np.concatenate([box, endless]),
            "lbg": np.concatenate([defects, -endless, -half]),
            "ubg": np.concatenate([defects, half, endless]),
        }

    def solve(self, arguments: dict[str, Any]) -> Any:
        """casadi's answer."""
        answer = self.solver(**arguments, **self.duals)
        if self.warm:
            self.duals = {"lam_x0": answer["lam_x"], "lam_g0": answer["lam_g"]}
        return answer

    def succeeded(self) -> bool:
        """Whether the last solution was one."""
        return bool(self.solver.stats()["success"])

    def path(self, answer: Any) -> Matrix:
        """States ``(N+1, 6n)``."""
        return np.asarray(
            answer["x"].full().ravel()[: self.d * self.ticks].reshape(self.ticks, self.d), np.float64
        )
