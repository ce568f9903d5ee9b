"""The bounded window over everything that is unknown in it, for an interior-point solver: IPOPT, by casadi's symbols.

Variables are those of `tests.support.joint_reference`, and a slack for every row with a soft bound. It shares nothing
with the kernels but the rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.model.limits import StateLimits
from estimators.model.measurements import Kind
from tests.support.joint_reference import JointWindow

Array = NDArray[np.float64]


def interior_point(joint: JointWindow, limits: StateLimits, half: Array, start: Array) -> tuple[Array, Array, float]:
    """The optimum within limits, from the variables ``start``: path, slow errors, and the cost with its price.

    ``half`` ``(m,)`` are the rows' half widths, soft where the limits price them.
    """
    import casadi

    soft = np.flatnonzero(np.isfinite(half)) if limits.noise_price > 0.0 else np.zeros(0, np.int64)
    z, slack = casadi.SX.sym("z", joint.size), casadi.SX.sym("t", len(soft))
    bounded, low, high = [], [], []

    def bound(what: Any, lowest: float, highest: float) -> None:
        if np.isfinite(lowest) or np.isfinite(highest):
            bounded.append(what)
            low.append(lowest)
            high.append(highest)

    cut = joint.d + joint.q
    away = casadi.mtimes(casadi.DM(joint.root), z[:cut] - joint.belief.mean)
    cost = casadi.sumsqr(away) + casadi.sum1(z[cut:] ** 2 / joint.accel_variance.ravel())
    path = [casadi.mtimes(casadi.DM(m), z) + o for m, o in zip(joint.moves, joint.offsets, strict=True)]
    for k, x in enumerate(path):
        for r in range(joint.start[k], joint.start[k + 1]):
            residual = joint.rows[r]["value"] - _predicted(casadi, joint.rows[r], x, joint.eps)
            residual -= casadi.dot(casadi.DM(joint.coupling[r]), z[joint.d : cut]) if joint.q else 0.0
            cost += residual**2 / joint.variance[r]
            if r in soft:
                over = slack[int(np.flatnonzero(soft == r)[0])]
                cost += limits.noise_price / half[r] * over
                bound(over, 0.0, np.inf)
                bound(residual - over, -np.inf, half[r])
                bound(residual + over, -half[r], np.inf)
        for i in range(joint.d):
            bound(x[i], limits.low[i], limits.high[i])
        for a in range(0, joint.d, 6):
            bound(casadi.sumsqr(x[a + 3 : a + 6]), -np.inf, limits.speed_mps**2)
    variables = casadi.vertcat(z, slack)
    quiet = {"print_level": 0, "tol": 1e-10, "sb": "yes", "max_iter": 500, "bound_relax_factor": 0.0}
    program = {"x": variables, "f": 0.5 * cost, "g": casadi.vertcat(*bounded)}
    solver = casadi.nlpsol("reference", "ipopt", program, {"ipopt": quiet, "print_time": False})
    answer = solver(x0=np.concatenate([start, np.zeros(len(soft))]), lbg=low, ubg=high)
    assert solver.stats()["success"], solver.stats()["return_status"]
    found = np.array(answer["x"]).ravel()[: joint.size]
    return joint.path(found), found[joint.d : cut], 2.0 * float(answer["f"])


def _predicted(casadi: Any, row: np.void, x: Any, eps: float) -> Any:
    """h of one row at a fleet state."""
    a, o = 6 * int(row["agent"]), float(row["offset_s"])
    direction = casadi.DM([float(row["x"]), float(row["y"]), float(row["z"])])
    place, velocity = x[a : a + 3] + o * x[a + 3 : a + 6], x[a + 3 : a + 6]
    match Kind(int(row["kind"])):
        case Kind.POSITION:
            return casadi.dot(direction, place)
        case Kind.HEIGHT:
            return place[2]
        case Kind.VELOCITY | Kind.ODOMETRY:
            return casadi.dot(direction, velocity)
        case Kind.SPEED:
            return casadi.sqrt(casadi.sumsqr(velocity) + eps**2)
        case Kind.RELATIVE:
            b = 6 * int(row["other"])
            return casadi.dot(direction, place - x[b : b + 3] - o * x[b + 3 : b + 6])
        case Kind.RANGE:
            b = 6 * int(row["other"])
            away = place - x[b : b + 3] - o * x[b + 3 : b + 6]
        case _:
            away = place - direction
    return casadi.sqrt(casadi.sumsqr(away) + eps**2)
