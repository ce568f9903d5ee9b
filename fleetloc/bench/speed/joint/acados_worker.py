"""The other end of `fleetloc.bench.speed.joint.acados_client`: a program of its own, run by a Python that has acados.

``python acados_worker.py PROBLEM.npz FOLDER PLAN`` generates and compiles a solver in FOLDER and writes
``{"ready": true}``. Then each line on standard input is the number of a window to solve, and each line on standard
output its answer as JSON: CPU seconds of setting and of solving, acados' status, iterations, and the states.

States are those of the fleet, controls the accelerations; the window's first state is free, its prior is part of the
first stage's residual. Every measurement that could be there is in every stage; where none is, its weight is zero.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import sys
import time
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LIBRARIES = ("libblasfeo.so", "libhpipm.so", "libqpOASES_e.so.3.1")
PLANS = {"riccati": "PARTIAL_CONDENSING_HPIPM", "condensed": "FULL_CONDENSING_HPIPM"}


class Solver:
    """One compiled solver, and what was last set in it."""

    def __init__(self, problem: Any, folder: str, plan: str) -> None:
        acados = importlib.import_module("acados")
        os.environ.update(  # where the wheel has its parts; it was not made for other users
            ACADOS_SOURCE_DIR=acados.DIR,
            ACADOS_PYTHON_INTERFACE_PATH=acados.TEMPLATE_DIR,
            TERA_PATH=acados.TERA_PATH,
        )
        for name in LIBRARIES:  # before libacados asks for them by name
            ctypes.CDLL(os.path.join(acados.LIB_DIR, name), mode=ctypes.RTLD_GLOBAL)
        template = importlib.import_module("acados.acados_template")
        from casadi import SX, sqrt, sumsqr, vertcat

        agents, self.ticks = int(problem["agents"]), problem["accel"].shape[1]
        model, ocp = template.AcadosModel(), template.AcadosOcp()
        x, u = SX.sym("x", 6 * agents), SX.sym("u", 3 * agents)
        eps = float(problem["eps"])

        def place(agent: int) -> Any:
            return x[6 * agent : 6 * agent + 3]

        ranges = [sqrt(sumsqr(place(a) - place(b)) + eps**2) for a, b in problem["edges"].tolist()]
        rows = vertcat(x, *ranges)
        model.name = f"window_{plan}"
        model.x, model.u = x, u
        model.disc_dyn_expr = problem["transition"] @ x + problem["push"] @ u
        model.cost_y_expr_0, model.cost_y_expr, model.cost_y_expr_e = vertcat(rows, u, x), vertcat(rows, u), rows
        ocp.model = model
        ocp.dims.N = self.ticks
        ocp.solver_options.tf = float(self.ticks)  # stages of length 1: their costs are not scaled
        cost = ocp.cost
        cost.cost_type_0 = cost.cost_type = cost.cost_type_e = "NONLINEAR_LS"
        lengths = [part.shape[0] for part in (model.cost_y_expr_0, model.cost_y_expr, model.cost_y_expr_e)]
        cost.W_0, cost.W, cost.W_e = (np.eye(length) for length in lengths)
        cost.yref_0, cost.yref, cost.yref_e = (np.zeros(length) for length in lengths)
        options = ocp.solver_options
        options.qp_solver = PLANS[plan]
        options.hessian_approx = "GAUSS_NEWTON"
        options.integrator_type = "DISCRETE"
        options.nlp_solver_type = "SQP"
        options.nlp_solver_max_iter = 50
        options.nlp_solver_tol_stat = float(problem["tolerance"])
        options.nlp_solver_tol_eq = options.nlp_solver_tol_ineq = options.nlp_solver_tol_comp = 1e-10
        options.qp_tol = 1e-10
        options.print_level = 0
        ocp.code_export_directory = os.path.join(folder, plan)
        self.solver = template.AcadosOcpSolver(ocp, json_file=os.path.join(folder, f"{plan}.json"), verbose=False)
        self.weights: list[Array] = [np.zeros(0)] * (self.ticks + 1)
        self.problem = {name: problem[name] for name in problem.files}

    def answer(self, window: int) -> dict[str, Any]:
        """Set a window and solve it."""
        targets, weights, start, accel = self._stages(window)
        begun = time.process_time()
        for k in range(self.ticks + 1):
            self.solver.cost_set(k, "yref", targets[k])
            if not np.array_equal(weights[k], self.weights[k]):
                self.solver.cost_set(k, "W", weights[k])
                self.weights[k] = weights[k]
            self.solver.set(k, "x", start[k])
            if k < self.ticks:
                self.solver.set(k, "u", accel[k])
        ready = time.process_time()
        status = self.solver.solve()
        done = time.process_time()
        path = [self.solver.get(k, "x").tolist() for k in range(self.ticks + 1)]
        return {
            "set_s": ready - begun,
            "solve_s": done - ready,
            "status": int(status),
            "iterations": int(np.ravel(self.solver.get_stats("sqp_iter"))[0]),
            "path": path,
        }

    def _stages(self, window: int) -> tuple[list[Array], list[Array], Array, Array]:
        """What the residuals are to be, their weight matrices, and where the solver begins; not timed."""
        given = {name: self.problem[name][window] for name in ("value", "precision", "accel", "accel_precision")}
        mean, information = self.problem["mean"][window], self.problem["information"][window]
        targets, weights = [], []
        for k in range(self.ticks + 1):
            target, weight = given["value"][k], np.diag(given["precision"][k])
            if k < self.ticks:
                target = np.concatenate([target, given["accel"][k]])
                weight = _joined(weight, np.diag(given["accel_precision"][k]))
            if k == 0:
                target, weight = np.concatenate([target, mean]), _joined(weight, information)
            targets.append(target)
            weights.append(weight)
        return targets, weights, self.problem["start"][window], given["accel"]


def _joined(a: Array, b: Array) -> Array:
    return np.block([[a, np.zeros((len(a), len(b)))], [np.zeros((len(b), len(a))), b]])


def _answers() -> TextIO:
    """Standard output for the answers alone: what acados and its compiler print goes to standard error."""
    kept = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return kept


def main(problem: str, folder: str, plan: str) -> None:
    """See the module's docstring."""
    out = _answers()
    solver = Solver(np.load(problem), folder, plan)
    print(json.dumps({"ready": True}), file=out)
    for line in sys.stdin:
        print(json.dumps(solver.answer(int(line))), file=out)


if __name__ == "__main__":
    main(*sys.argv[1:])
