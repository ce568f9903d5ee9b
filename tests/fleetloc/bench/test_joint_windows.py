"""The joint windows of ``fleetloc bench speed``: IPOPT and acados solve the problem that we solve."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from estimators.model.measurements import Kind
from estimators.window.problem import WindowProblem
from fleetloc.bench.speed.fleet.flight import Fleet, record_drone, record_flight, transient_ticks
from fleetloc.bench.speed.fleet.study import settings_of
from fleetloc.bench.speed.joint.acados_client import AcadosClient, AcadosMissingError
from fleetloc.bench.speed.joint.study import ACADOS_PLANS, JointPlan, JointResult, run_joint
from fleetloc.bench.speed.joint.windows import StagedWindow, capture_joint_windows, staged

LINE = Fleet(3, "line")
COUNT = 2
EDGES = [(0, 1), (1, 0), (1, 2), (2, 1)]
ACADOS = os.environ.get("FLEETLOC_TEST_ACADOS")
needs_casadi = pytest.mark.skipif(
    importlib.util.find_spec("casadi") is None,
    reason="NOT TESTED: casadi is missing (pip install 'fleetloc[studies]'), IPOPT checks no joint window",
)
needs_acados = pytest.mark.skipif(
    ACADOS is None,
    reason="NOT TESTED: acados (FLEETLOC_TEST_ACADOS is the Python of an environment with comma-deps-acados)",
)


def study(acados: str | None) -> JointResult:
    (found,) = run_joint(JointPlan(3, (LINE,), COUNT, 1, acados=acados), lambda what: None)
    return found


@needs_casadi
def test_ipopt_finds_our_optimum_and_the_table_says_that_acados_is_missing() -> None:
    found = study(None)
    assert list(found.methods) == ["ours_1e-9", "ours_default", "ipopt"]
    assert all(method.not_converged == 0 for method in found.methods.values())
    assert found.methods["ipopt"].distance_max < 1e-7
    assert found.methods["ours_default"].distance_max < 1e-4
    assert found.methods["ours_1e-9"].over_ours == 1.0
    (sentence,) = found.missing
    assert "pip install comma-deps-acados" in sentence


@needs_casadi
@needs_acados
def test_acados_finds_our_optimum() -> None:
    found = study(ACADOS)
    assert not found.missing
    for plan in ACADOS_PLANS:
        method = found.methods[f"acados_{plan}"]
        assert method.not_converged == 0
        assert method.distance_max < 1e-7
        assert method.cpu_median_us > 0


@pytest.fixture(scope="module")
def windows() -> list[StagedWindow]:
    return [staged(problem, EDGES) for problem in problems()]


def problems() -> list[WindowProblem]:
    flight, settings = record_flight(LINE, COUNT, 3), settings_of("dmhe_shared")
    ticks = range(transient_ticks(), transient_ticks() + COUNT)
    return capture_joint_windows(flight, settings, record_drone(flight, settings), ticks)


@pytest.mark.parametrize(
    ("python", "expected"), [("/no/such/python", "cannot be started"), (sys.executable, "No module named 'acados'")]
)
def test_a_python_without_acados_is_one_line(
    python: str, expected: str, windows: list[StagedWindow], tmp_path: Path
) -> None:
    if python == sys.executable and importlib.util.find_spec("acados") is not None:
        pytest.fail("acados is in the environment of the tests: it overwrites casadi there")
    with pytest.raises(AcadosMissingError, match=expected) as found:
        AcadosClient(python, "riccati", windows, EDGES, 0.1, 1e-3, 1e-7, tmp_path)
    assert "\n" not in str(found.value)


def test_staged_rows_stand_where_they_were_measured(windows: list[StagedWindow]) -> None:
    for problem, window in zip(problems(), windows, strict=True):
        assert np.count_nonzero(window.precision) == len(problem.rows)
        assert np.isclose(window.precision.sum(), (1.0 / problem.rows["variance"]).sum(), rtol=1e-12)
        assert np.allclose(window.information @ window.mean, problem.vector)
        for row in problem.rows[problem.rows["kind"] == Kind.RANGE]:
            place = 18 + EDGES.index((int(row["agent"]), int(row["other"])))
            tick = int(row["tick"] - problem.rows["tick"][0])
            assert window.value[tick, place] == row["value"]


def test_rows_without_a_place_are_refused() -> None:
    problem = problems()[0]
    late, twice, speed = (problem.rows.copy() for _ in range(3))
    late["offset_s"] = 0.01
    twice[1] = twice[0]
    speed["kind"][0] = Kind.SPEED
    speed["x"][0] = speed["y"][0] = speed["z"][0] = 0.0  # of an antenna that is where the IMU is
    for rows, expected in ((late, "instant"), (twice, "two measurements"), (speed, "NED axes")):
        with pytest.raises(ValueError, match=expected):
            staged(problem._replace(rows=rows), EDGES)
