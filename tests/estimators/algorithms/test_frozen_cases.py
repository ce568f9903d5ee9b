"""Frozen cases: inputs and expected outputs of an independent reference (IPOPT, crosschecked by numpy).

Two of them, cut short, are kept in ``tests/data/dmhe``; all of them lie in ``shared/cases/dmhe`` beside the
repository, and are skipped, visibly, where that folder is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from estimators.integrity.observability import observability_rank
from estimators.model.layout import Layout
from estimators.settings import EstimatorSettings
from estimators.window.history import MeasurementWindow
from estimators.window.problem import WindowProblem
from estimators.window.solving import pre_estimation, solve_window
from sim_bridge.studies.lockstep import Links, own_input, own_rows, run_lockstep
from sim_bridge.studies.study_input import StudyInput, study_input_from_arrays
from tests.support import dense_reference as dense
from tests.support import frozen_cases

KEPT = Path(__file__).parents[2] / "data" / "dmhe"
SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "cases" / "dmhe"

NOT_SUPPORTED = {"c11_pre_gain_func": "differentiates through the gains; here they are frozen along the pre-estimate"}

SAME_POINT_M = 1e-4
"""Two solvers that stop at the same minimum: the reference's own two agree to about this (spec of the cases)."""
COST_ROUNDING = 1e-7
"""Relative, on the optimal cost: flat to second order, so far better determined than the point."""


def every_case() -> list[Any]:
    paths = [*sorted(KEPT.glob("c*.npz")), *sorted(SHARED.glob("c*.npz"))]
    cases = []
    for path in paths:
        reason = NOT_SUPPORTED.get(path.stem)
        where = "kept" if path.parent == KEPT else "shared"
        marks = [pytest.mark.skip(reason=f"{path.stem} {reason}")] if reason else []
        cases.append(pytest.param(path, id=f"{where}-{path.stem}", marks=marks))
    if not SHARED.is_dir():
        missing = pytest.mark.skip(reason="shared/cases/dmhe is not beside the repository: only the kept cases run")
        cases.append(pytest.param(None, id="shared", marks=[missing]))
    return cases


@dataclass(frozen=True)
class Case:
    arrays: dict[str, Any]
    options: dict[str, Any]
    recording: StudyInput
    settings: EstimatorSettings

    @classmethod
    def load(cls, path: Path) -> Case:
        arrays, options = frozen_cases.load_case(path)
        recording = study_input_from_arrays(frozen_cases.case_recording(arrays, options), path.name)
        table = msgspec.convert(frozen_cases.case_settings(options), EstimatorSettings)
        return cls(arrays, options, recording, table)

    @property
    def ticks(self) -> int:
        return self.recording.ticks


def test_cases_are_kept() -> None:
    # the parametrised tests below must not run over an empty folder
    assert {path.stem for path in KEPT.glob("c*.npz")} == {"c09_pre_loss30_drop", "c12_ring4_dt02_N3_L2"}


@pytest.mark.parametrize("path", every_case())
def test_closed_loop(path: Path) -> None:
    # GIVEN a case as a recording
    case = Case.load(path)
    # WHEN the fleet runs over it in lockstep
    result = run_lockstep(case.recording, case.settings)
    # THEN every estimate is the reference's, wherever the reference is unique
    difference = np.abs(result.mean - case.arrays["x_hat"]).max(axis=(1, 2))
    tolerance = case.arrays["tol_t"]
    compared = np.isfinite(tolerance)
    assert compared[1:].sum() > 0.4 * case.ticks
    worst = int(np.argmax(np.where(compared, difference / tolerance, 0.0)))
    assert (difference[compared] <= tolerance[compared]).all(), f"tick {worst}: {difference[worst]}"
    if case.options["kind"] in ("dekf", "central_ekf"):
        expected = np.diagonal(case.arrays["cov"], axis1=-2, axis2=-1)
        np.testing.assert_allclose(result.cov_diag[compared], expected[compared], rtol=1e-6)


def window_of(case: Case, links: Links, t: int, agent: int) -> WindowProblem:
    """The window of one agent at one tick, from the prior that the case holds."""
    n = len(case.recording.agents)
    ticks = min(t, case.options["N"])
    layout = Layout(tuple(case.recording.agents.tolist()))
    window = MeasurementWindow(layout, ticks, other_accel_variance=case.options["q_other"])
    window.advance(t)
    for k in range(t - ticks, t + 1):
        heard = [agent, *links.heard(k, agent)]
        for sender in heard:
            window.insert(own_rows(case.recording, k, sender), own_input(case.recording, k, agent))
    rows, start = window.rows()
    accel, variance = window.inputs()
    np.testing.assert_allclose(variance[-1], case.arrays["Qdiag"][agent], rtol=1e-9)
    information = np.linalg.inv(case.arrays["Pi_prior"][t, agent])
    information = np.ascontiguousarray(0.5 * (information + information.T))
    return WindowProblem(
        rows=rows,
        start=start,
        accel=accel,
        accel_variance=variance,
        information=information,
        vector=information @ case.arrays["x_prior"][t, agent],
        keep=np.array([agent % n], np.int64),
        period_s=case.recording.period_s,
        with_gains=case.options["kind"] == "pre",
    )


@pytest.mark.parametrize("path", every_case())
def test_single_steps(path: Path) -> None:
    # GIVEN the reference's own prior at every tick of every agent
    case = Case.load(path)
    if "x_prior" not in case.arrays:
        pytest.skip(f"{path.stem} is a filter: it has no windows")
    links = Links(case.recording)
    same = steps = 0
    for t in range(1, case.ticks + 1):
        for agent in range(len(case.recording.agents)):
            # WHEN one window is solved
            problem = window_of(case, links, t, agent)
            solution = solve_window(problem, case.settings)
            # THEN it is at the reference's optimum, or at a better one
            expected = case.arrays["window"][t, agent, : len(problem.accel) + 1]
            cost = float(case.arrays["cost"][t, agent])
            steps += 1
            assert solution.report.cost <= cost * (1 + COST_ROUNDING) + COST_ROUNDING, (t, agent)
            if solution.report.cost > cost * (1 - COST_ROUNDING) - COST_ROUNDING:
                same += np.abs(solution.path - expected).max() < SAME_POINT_M
            # and the pre-estimation has the reference's covariance
            if problem.with_gains:
                found = pre_estimation(problem, case.settings.norm_smoothing_m)[1]
                np.testing.assert_allclose(found, case.arrays["Pi_pre"][t, agent], rtol=0, atol=1e-6)
    assert same >= 0.9 * steps, f"{same} of {steps} windows ended at the reference's point"


@pytest.mark.parametrize("path", every_case())
def test_ranks(path: Path) -> None:
    # GIVEN the estimates of a case, the rank (25) of the reference follows from the rows and the dense matrices
    case = Case.load(path)
    if "window" not in case.arrays:
        pytest.skip(f"{path.stem} has no windows")
    links, recording = Links(case.recording), case.recording
    for t in range(2, case.ticks + 1, 3):
        for agent in range(len(recording.agents)):
            problem = window_of(case, links, t, agent)
            rows = [problem.rows[a:b] for a, b in pairwise(problem.start)]
            before = case.arrays["window"][t - 1, agent]
            before = before[: min(t - 1, case.options["N"]) + 1]
            newest = dense.transition(len(recording.agents), problem.period_s) @ before[-1]
            newest = newest + dense.inputs(len(recording.agents), problem.period_s) @ problem.accel[-1]
            states = [*before, newest][-len(rows) :]
            arguments = rows, states, problem.period_s, case.settings.norm_smoothing_m
            expected = case.arrays["rho_rank"][t, agent]
            assert observability_rank(*arguments) == dense.observability_rank(*arguments) == expected
