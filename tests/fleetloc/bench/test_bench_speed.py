"""``fleetloc bench speed``: the peers solve the problem that we solve, and timing does what it says."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimators.settings import EstimatorSettings
from fleetloc import cli
from fleetloc.bench.speed.bounds import Bounds
from fleetloc.bench.speed.environment import THREAD_VARIABLES
from fleetloc.bench.speed.fleet.study import FleetPlan
from fleetloc.bench.speed.own import filter_step, our_step
from fleetloc.bench.speed.plain_numpy import PlainModel, PlainStep, prior_moments
from fleetloc.bench.speed.report import as_document
from fleetloc.bench.speed.study import SizeResult, SpeedPlan, run_speed
from fleetloc.bench.speed.timing import Method, time_interleaved
from fleetloc.bench.speed.windows import (
    TICKS_BETWEEN_WINDOWS,
    TRANSIENT_TICKS,
    BenchWindow,
    Size,
    capture_windows,
    study_recording,
)
from fleetloc.output import write_json
from sim_bridge.studies.lockstep import neighbours, run_lockstep

SMALL = Size(3, 2)
COUNT = 2
EPS = EstimatorSettings().norm_smoothing_m
needs_casadi = pytest.mark.skipif(
    importlib.util.find_spec("casadi") is None,
    reason="NOT TESTED: casadi is missing (pip install 'fleetloc[studies]'), no peer checks our optimum",
)


@pytest.fixture(scope="module")
def windows() -> list[BenchWindow]:
    return capture_windows(SMALL, COUNT, seed=3)


@pytest.fixture(scope="module")
def result() -> SizeResult:
    plan = SpeedPlan(seed=3, repeats=2, windows=COUNT, sizes=(SMALL,), limit_s=0.5)
    (found,) = run_speed(plan, lambda what: None)
    return found


@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dekf_ci"])
def test_captured_steps_are_those_of_the_closed_loop(windows: list[BenchWindow], kind: Any) -> None:
    # GIVEN the same flight run by the ordinary lockstep runner
    settings = EstimatorSettings(kind=kind, window=SMALL.window)
    run = run_lockstep(study_recording(SMALL, COUNT, seed=3), settings)
    for place, window in enumerate(windows):
        # WHEN the captured step is done
        if kind == "dekf_ci":
            mean, covariance = filter_step(window, settings)
            assert np.linalg.eigvalsh(covariance).min() > 0
        else:
            mean = our_step(window, settings).path[-1]
        # THEN it gives the estimate of that tick
        expected = run.mean[TRANSIENT_TICKS + TICKS_BETWEEN_WINDOWS * place, window.slot]
        assert np.abs(mean - expected).max() < 1e-12


def test_plain_build_is_the_same_step(windows: list[BenchWindow]) -> None:
    tight = EstimatorSettings(window=SMALL.window, tolerance=1e-9)
    for window in windows:
        ours = our_step(window, tight)
        first, last, information = PlainStep(window, EPS, None).run()
        assert np.abs(first - ours.path[0]).max() < 1e-3, "three Gauss-Newton steps"
        assert np.abs(last - ours.path[-1]).max() < 1e-3
        scale = np.abs(ours.next_information).max()
        assert np.abs(information - ours.next_information).max() < 1e-4 * scale
        # bounds that are far away change nothing
        rows = window.rows.copy()
        rows["half_width"] = 10.0
        bounded = PlainStep(replace(window, rows=rows), EPS, Bounds()).run()
        assert np.abs(bounded[0] - first).max() < 1e-3


def test_plain_gradient_is_the_slope_of_the_plain_cost(windows: list[BenchWindow]) -> None:
    problem = windows[0].problem(windows[0].fused())
    model = PlainModel(problem, EPS)
    mean, covariance = prior_moments(problem)
    gains = model.gains(mean, covariance)
    z = mean + np.random.default_rng(1).normal(0.0, 0.1, len(mean))

    def half_cost(point: Any) -> float:
        off = point - mean
        return 0.5 * (float(off @ problem.information @ off) + model.objective(model.linearise(point, gains)))

    _, slope = model.quadratic(z, model.linearise(z, gains), mean, problem.information)
    for i in range(len(z)):
        step = np.zeros(len(z))
        step[i] = 1e-5
        numeric = (half_cost(z + step) - half_cost(z - step)) / 2e-5
        assert slope[i] == pytest.approx(numeric, rel=1e-5, abs=1e-3)


@needs_casadi
def test_casadi_has_the_same_cost_and_gradient(windows: list[BenchWindow]) -> None:
    from fleetloc.bench.speed.peers_casadi import WindowNlp, instance

    problem = windows[0].problem(windows[0].fused())
    function = WindowNlp(problem, EPS).gradient_function()
    model = PlainModel(problem, EPS)
    mean, covariance = prior_moments(problem)
    gains = model.gains(mean, covariance)
    z = mean + np.random.default_rng(1).normal(0.0, 0.1, len(mean))
    path = model.linearise(z, gains)
    _, slope = model.quadratic(z, path, mean, problem.information)
    found = function(z, instance(problem, EPS).parameters)
    cost, gradient, states, residuals = (part.full().ravel() for part in found)
    off = z - mean
    assert 2.0 * cost[0] == pytest.approx(off @ problem.information @ off + model.objective(path), rel=1e-12)
    assert np.abs(gradient - slope).max() < 1e-9 * np.abs(slope).max()
    assert np.abs(states - np.concatenate(path.states)).max() < 1e-12
    assert np.abs(residuals - np.concatenate(path.residuals)).max() < 1e-12


DISTANCES = {
    "ours_1e-9": 0.0,
    "ours_default": 1e-4,
    "ipopt_warm": 1e-6,
    "sqp_osqp": 1e-4,
    "plain_numpy": 1e-3,
    "ours_default_and_covariance": 1e-4,
}
"""Largest distance of a method's answer from our 1e-9 optimum, m or m/s."""


@needs_casadi
@pytest.mark.parametrize("name", ["free", "loose"])
def test_methods_agree_where_no_bound_is_active(result: SizeResult, name: str) -> None:
    (case,) = [case for case in result.cases if case.name == name]
    assert case.active_bounds == [0] * COUNT
    limits = dict(DISTANCES)
    if name == "loose":
        limits["plain_numpy_osqp"] = limits.pop("plain_numpy")
    for method, limit in {**limits, "scipy_slsqp": 1e-3}.items():
        found = case.methods[method]
        assert found.first_state_distance_max <= limit, method
        assert found.last_state_distance_max <= limit, method
    assert case.methods["ipopt_warm"].not_converged == 0
    assert case.methods["ours_1e-9"].not_converged == 0
    assert np.isnan(case.methods["dekf_ci"].first_state_distance_max)
    assert abs(case.optimality.cost_excess_relative_max) < 1e-9
    if name == "free":
        assert case.optimality.newton_step_max < 1e-7


@needs_casadi
def test_methods_agree_where_bounds_are_active(result: SizeResult) -> None:
    (case,) = [case for case in result.cases if case.name == "active"]
    assert all(1 <= active <= 3 for active in case.active_bounds)
    for method in ("ours_default", "ours_1e-9_daqp", "ours_default_daqp", "ipopt_warm"):
        assert case.methods[method].first_state_distance_max < 1e-4, method
        assert case.methods[method].not_converged == 0, method
    assert case.methods["plain_numpy_osqp"].first_state_distance_max < 0.1, "three steps with OSQP at 1e-6"
    assert abs(case.optimality.cost_excess_relative_max) < 1e-7
    assert case.optimality.box_violation_max < 1e-9


@needs_casadi
def test_document_has_every_figure_and_no_nan(result: SizeResult, tmp_path: Path) -> None:
    target = tmp_path / "speed.json"
    write_json(target, as_document(SpeedPlan(sizes=(SMALL,)), [result], FleetPlan(), [], []))
    document = json.loads(target.read_text(), parse_constant=lambda text: pytest.fail(f"{text} in JSON"))
    (size,) = document["sizes"]
    assert (size["agents"], size["window_ticks"], size["regional_agents"]) == (3, 2, 3)
    for case in size["cases"]:
        methods = case["methods"]
        for method in methods.values():
            assert 0 < method["cpu_median_us"] <= method["cpu_p99_us"]
            assert method["timed_solves"] >= COUNT
        ratio = methods["ipopt_warm"]["cpu_median_us"] / methods["ours_1e-9"]["cpu_median_us"]
        assert case["ratios"]["ipopt_warm/ours_1e-9"] == pytest.approx(ratio)
        assert methods["dekf_ci"]["first_state_distance_max"] is None


class Watch:
    """A clock that only calls move."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.log: list[tuple[str, int]] = []

    def __call__(self) -> float:
        return self.now_s

    def method(self, name: str, cost_s: float, windows: int) -> Method:
        def call(window: int) -> Callable[[], int]:
            def run() -> int:
                self.log.append((name, window))
                self.now_s += cost_s
                return window

            return run

        return Method(name, [call(window) for window in range(windows)])


def test_methods_take_turns_and_slow_ones_play_fewer_rounds() -> None:
    # GIVEN a fast method and one whose three windows take 3 s
    watch = Watch()
    methods = [watch.method("fast", 0.001, 3), watch.method("slow", 1.0, 3)]
    # WHEN they are timed in at most 5 rounds and 7 s each
    timings = time_interleaved(methods, 5, 7.0, np.random.default_rng(0), watch)
    # THEN the slow one is in the first two rounds only, and each call is timed by itself
    assert timings["fast"].cpu_s == pytest.approx([0.001] * 15)
    assert timings["slow"].cpu_s == pytest.approx([1.0] * 6)
    assert timings["fast"].answers == timings["slow"].answers == [0, 1, 2]
    timed = watch.log[6:]
    for turn in range(0, 12, 2):  # both methods on a window before the next window
        assert {name for name, _ in timed[turn : turn + 2]} == {"fast", "slow"}
        assert timed[turn][1] == timed[turn + 1][1]
    assert {name for name, _ in timed[12:]} == {"fast"}


def test_work_of_another_process_counts_what_its_answer_says() -> None:
    # GIVEN a call that takes 5 s here, waiting for a process that worked 2 s
    watch = Watch()
    here = watch.method("here", 1.0, 2)
    there = replace(watch.method("there", 5.0, 2), elsewhere=lambda answer: 2.0 + answer)
    # WHEN they take turns
    timings = time_interleaved([here, there], 2, 100.0, np.random.default_rng(0), watch)
    # THEN only that work is counted, and the others' is not disturbed
    assert sorted(timings["there"].cpu_s) == [2.0, 2.0, 3.0, 3.0]
    assert timings["here"].cpu_s == pytest.approx([1.0] * 4)


def test_slowest_method_is_timed_once_at_least() -> None:
    watch = Watch()
    timings = time_interleaved([watch.method("slow", 10.0, 2)], 5, 1.0, np.random.default_rng(0), watch)
    assert timings["slow"].cpu_s == pytest.approx([10.0, 10.0])
    assert timings["slow"].median_s == pytest.approx(10.0)


def test_large_fleet_is_connected_with_about_four_neighbours() -> None:
    for seed in range(5):
        recording = study_recording(Size(20, 5), 1, seed)
        adjacent = neighbours(recording)
        assert np.mean([len(each) for each in adjacent]) == pytest.approx(4.0)
        reached = {0}
        for _ in adjacent:
            reached |= {other for agent in reached for other in adjacent[agent]}
        assert reached == set(range(20))
    again = study_recording(Size(20, 5), 1, 4)
    assert np.array_equal(again.gps, recording.gps)


@pytest.fixture
def threads_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command sets them for its process, which here is that of all tests."""
    for variable in THREAD_VARIABLES:
        monkeypatch.setenv(variable, "1")


@pytest.mark.usefixtures("threads_restored")
def test_missing_casadi_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.util.find_spec

    def without_casadi(name: str, package: str | None = None) -> Any:
        return None if name == "casadi" else find(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", without_casadi)
    assert cli.main(["bench", "speed"]) == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "casadi is not installed" in error
    assert "pip install 'fleetloc[studies]'" in error


@pytest.mark.usefixtures("threads_restored")
@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--sizes", "3", "AGENTSxWINDOW"),
        ("--sizes", "2x5", "at least 3 agents"),
        ("--sizes", "3x2,", "AGENTSxWINDOW"),
        ("--cases", "tight", "free or loose or active"),
        ("--fleets", "3star", "3 to 100 drones"),
        ("--kinds", "kalman", "dmhe_shared"),
        ("--json", "tests", "a file"),
    ],
)
def test_bad_options_are_one_line(
    option: str,
    value: str,
    expected: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(Path(__file__).parents[3])
    assert cli.main(["bench", "speed", option, value]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert option in error
    assert expected in error
