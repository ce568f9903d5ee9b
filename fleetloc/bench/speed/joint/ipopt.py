"""Staged windows for IPOPT through casadi: one program for all windows of a structure, numbers as parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from estimators.model.measurements import Matrix, Vector
from estimators.model.motion import input_matrix, transition_matrix
from fleetloc.bench.speed.joint.windows import Edges, StagedWindow
from fleetloc.bench.speed.peers_casadi import require_casadi


class StagedNlp:
    """States of all ticks and accelerations are variables, the motion a constraint (multiple shooting)."""

    def __init__(
        self, shape: StagedWindow, edges: Edges, period_s: float, eps: float, options: dict[str, Any]
    ) -> None:
        self.casadi = casadi = require_casadi()
        self.shape, self.edges, self.eps = shape.start.shape, edges, eps
        ticks, d = shape.accel.shape[0], len(shape.mean)
        move = casadi.DM(casadi.sparsify(transition_matrix(d // 6, period_s)))
        push = casadi.DM(casadi.sparsify(input_matrix(d // 6, period_s)))
        parts = [casadi.SX.sym(f"p{i}", *part.T.shape) for i, part in enumerate(self._parts(shape))]
        value, precision, accel, accel_precision, mean, information = parts
        states = [casadi.SX.sym(f"x{k}", d) for k in range(ticks + 1)]
        inputs = [casadi.SX.sym(f"u{k}", d // 2) for k in range(ticks)]
        off = states[0] - mean.T
        cost = casadi.bilin(information, off, off)
        for k, x in enumerate(states):
            cost += casadi.dot(precision[:, k], (value[:, k] - self._measured(x)) ** 2)
        for k, u in enumerate(inputs):
            cost += casadi.dot(accel_precision[:, k], (accel[:, k] - u) ** 2)
        defects = [states[k + 1] - move @ states[k] - push @ inputs[k] for k in range(ticks)]
        program = {
            "x": casadi.vertcat(*states, *inputs),
            "p": casadi.vertcat(*(casadi.vec(part) for part in parts)),
            "f": 0.5 * cost,
            "g": casadi.vertcat(*defects),
        }
        self.solver = casadi.nlpsol("joint", "ipopt", program, options)

    @staticmethod
    def _parts(window: StagedWindow) -> list[Matrix]:
        given = [window.value, window.precision, window.accel, window.accel_precision]
        return [*given, window.mean[:, None], window.information]

    def _measured(self, x: Any) -> Any:
        """All measurements that could be there, in their places."""
        ranges = []
        for a, b in self.edges:
            between = x[6 * a : 6 * a + 3] - x[6 * b : 6 * b + 3]
            ranges.append(self.casadi.sqrt(self.casadi.sumsqr(between) + self.eps**2))
        return self.casadi.vertcat(x, *ranges)

    def arguments(self, window: StagedWindow) -> dict[str, Vector]:
        """What the solver is called with."""
        parameters = np.concatenate([part.ravel() for part in self._parts(window)])
        start = np.concatenate([window.start.ravel(), window.accel.ravel()])
        return {"x0": start, "p": parameters, "lbg": np.zeros(1), "ubg": np.zeros(1)}

    def solve(self, arguments: dict[str, Vector]) -> tuple[Matrix, bool]:
        """States ``(N+1, 6n)``, and whether it converged."""
        answer = self.solver(**arguments)
        count = self.shape[0] * self.shape[1]
        path = np.asarray(answer["x"].full().ravel()[:count], np.float64).reshape(self.shape)
        return path, bool(self.solver.stats()["success"])
