"""The studies' scenario and their figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.integrity.consistency import average_nees_band, nees, nis, rms
from estimators.settings import EstimatorSettings, default_settings
from sim_bridge.studies.air import lossy
from sim_bridge.studies.lockstep import LockstepResult
from sim_bridge.studies.monte_carlo import (
    Hangar,
    Sample,
    StudyFlight,
    accuracy_row,
    mean_and_error,
    ratio_of_means,
    run_study,
    table1_row,
    window_mean,
    window_rms,
)
from sim_bridge.studies.study_input import study_input_from_arrays
from sim_bridge.studies.study_scenario import GRAPHS, StudyScenario, graph_of
from tests.support.builders import recording_arrays

# --- scenario ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("graph", GRAPHS)
def test_every_graph_makes_a_valid_recording(graph: str) -> None:
    made = StudyScenario(graph=graph, samples=5).record(0, 0)
    study_input_from_arrays(recording_arrays(made), graph)
    agents, edges = GRAPHS[graph]
    assert len(made.agents) == agents
    # ranges exist exactly along the edges, from both ends
    there = np.isfinite(made.ranges[0])
    expected = np.zeros((agents, agents), bool)
    for a, b in edges:
        expected[a, b] = expected[b, a] = True
    np.testing.assert_array_equal(there, expected)


def test_noises_are_within_their_bounds_and_fill_them() -> None:
    # GIVEN some flights
    recordings = [StudyScenario(samples=60).record(1, run) for run in range(3)]
    for made in recordings:
        assert made.truth is not None
        positions, velocities = made.truth[..., :3], made.truth[..., 3:]
        speed = np.linalg.norm(velocities, axis=-1, keepdims=True)
        distance = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
        applied = np.diff(velocities, axis=0) / made.period_s
        # THEN every noise is within its bound, and comes near it on both sides
        for noise, half in (
            (made.gps - np.concatenate([positions, speed], axis=-1), made.gps_half_width),
            (made.ranges - distance, made.range_half_width),
            (made.accel - applied, made.accel_half_width),
        ):
            share = (noise / half)[np.isfinite(noise)]
            assert np.abs(share).max() <= 1 + 1e-9
            assert share.max() > 0.95
            assert share.min() < -0.95
            assert abs(share.mean()) < 0.12
        # and the commanded acceleration is limited
        assert np.abs(applied).max() <= 2.0 + 1e-9


def test_plant_moves_by_the_double_integrator() -> None:
    made = StudyScenario(samples=20, period_s=0.2).record(4, 0)
    assert made.truth is not None
    p, v = made.truth[..., :3], made.truth[..., 3:]
    applied = np.diff(v, axis=0) / 0.2
    np.testing.assert_allclose(p[1:], p[:-1] + 0.2 * v[:-1] + 0.02 * applied, atol=1e-12)


def test_flight_ends_at_the_references() -> None:
    made = StudyScenario(samples=200).record(4, 0)
    assert made.truth is not None
    np.testing.assert_allclose(made.truth[-1, :, :3], [[5, 0, 5], [0, 5, 6], [-5, 0, 7]], atol=0.1)
    np.testing.assert_allclose(made.truth[-1, :, 3:], 0.0, atol=0.1)


def test_run_is_a_function_of_seed_and_run() -> None:
    first, again = (StudyScenario(samples=8).record(7, 3) for _ in range(2))
    for key, value in recording_arrays(first).items():
        np.testing.assert_array_equal(recording_arrays(again)[key], value, err_msg=key)
    for other in (StudyScenario(samples=8).record(7, 4), StudyScenario(samples=8).record(8, 3)):
        assert np.abs(other.gps - first.gps).max() > 0.1


def test_starts() -> None:
    paper = StudyScenario(samples=3, start="paper").record(0, 0)
    assert not paper.x0.any()
    np.testing.assert_array_equal(np.diag(paper.P0), np.tile([6.0, 6.0, 6.0, 0.01, 0.01, 0.01], 3))
    # the good start is drawn from its own covariance, by every agent for itself
    errors = []
    for run in range(60):
        good = StudyScenario(samples=1).record(0, run)
        assert good.truth is not None
        errors.append(good.x0 - good.truth[0].ravel())
    variance = np.var(np.concatenate(errors), axis=0).reshape(3, 2, 3).mean(axis=(0, 2))
    np.testing.assert_allclose(variance, [6.0, 1.0], rtol=0.15)
    assert np.abs(errors[0][0] - errors[0][1]).max() > 0.1


def test_blind_agents_are_the_last() -> None:
    made = StudyScenario(graph="K5", samples=3, blind=2).record(0, 0)
    assert np.isnan(made.gps[:, 3:]).all()
    assert np.isfinite(made.gps[:, :3]).all()


def test_unknown_graph() -> None:
    with pytest.raises(ValueError, match=r"graph: expected one of line, .*, found 'moebius'"):
        StudyScenario(graph="moebius")


def test_families_of_graphs() -> None:
    assert [graph_of(family, 3) for family in ("line", "ring", "K")] == ["line", "triangle", "triangle"]
    for family, edges in (("line", 6), ("ring", 7), ("K", 21)):
        agents, found = GRAPHS[graph_of(family, 7)]
        assert (agents, len(found)) == (7, edges)
    for family, agents in (("star", 5), ("ring", 2), ("ring", 11)):
        with pytest.raises(ValueError, match=r"expected one of line, ring, K with 3 to 10 agents"):
            graph_of(family, agents)


def test_an_offset_start_is_off_and_its_covariance_says_so() -> None:
    # GIVEN starts with hardly any spread but 10 m off
    squares = []
    for run in range(40):
        made = StudyScenario(samples=1, start_sigma_m=1e-6, start_offset_m=10.0).record(3, run)
        assert made.truth is not None
        error = (made.x0 - made.truth[0].ravel()).reshape(3, 3, 6)
        # THEN every position of every agent is, each its own way, and no velocity more than before
        np.testing.assert_allclose(np.linalg.norm(error[:, :, :3], axis=-1), 10.0, rtol=1e-5)
        squares.append(np.square(error))
        np.testing.assert_allclose(np.diag(made.P0)[:3], 100.0 / 3.0)
    mean = np.mean(squares, axis=(0, 1, 2))
    np.testing.assert_allclose(mean[:3], 100.0 / 3.0, rtol=0.15)
    np.testing.assert_allclose(mean[3:], 1.0, rtol=0.2)
    with pytest.raises(ValueError, match="expected the good start"):
        StudyScenario(start="paper", start_offset_m=1.0)


def test_a_start_of_another_spread() -> None:
    errors = []
    for run in range(40):
        made = StudyScenario(samples=1, start_sigma_m=0.3).record(0, run)
        assert made.truth is not None
        errors.append((made.x0 - made.truth[0].ravel()).reshape(-1, 6))
    assert np.std(np.concatenate(errors)[:, :3]) == pytest.approx(0.3, rel=0.1)
    np.testing.assert_allclose(np.diag(made.P0)[:6], [0.09] * 3 + [1.0] * 3)


def test_vehicles_that_move_on_fly_to_the_next_ones_reference() -> None:
    made = StudyScenario(graph="triangle", samples=240, turn_every_s=12.0).record(0, 0)
    assert made.truth is not None
    first = StudyScenario(graph="triangle", samples=120).record(0, 0).truth
    assert first is not None
    np.testing.assert_array_equal(made.truth[:121], first)
    np.testing.assert_allclose(made.truth[-1, :, :3], [[0, 5, 6], [-5, 0, 7], [5, 0, 5]], atol=0.15)


# --- figures, by hand -------------------------------------------------------------------------------------------


def a_result(error: np.ndarray, truth: np.ndarray) -> LockstepResult:
    """A run of two ticks and two agents with given errors ``(2, 2, 12)``."""
    flat = truth.reshape(2, 1, 12)
    status = np.array([[0, 1], [2, 0]], np.int8)
    shape = (2, 2)
    return LockstepResult(
        flat + error, np.ones((2, 2, 12)), status, np.zeros(shape, np.int64), np.zeros(2, np.int64),
        np.full(shape, 0.5), np.full(shape, 0.25),
    )  # fmt: skip


def test_errors_of_a_run_by_hand() -> None:
    # GIVEN agent 0 wrong by (3, 4, 0) m in its own position and 2 m in that of agent 1; agent 1 by 1 m/s in its speed
    arrays = recording_arrays(StudyScenario(graph="line", samples=1).record(0, 0))
    made = study_input_from_arrays(arrays, "x")
    truth = np.zeros((2, 2, 6))
    recording = replace(made, agents=np.array([1, 2]), truth=truth)
    error = np.zeros((2, 2, 12))
    error[1, 0, :2] = 3.0, 4.0
    error[1, 0, 6] = 2.0
    error[1, 1, 9] = 1.0
    sample = Sample()
    sample.add(recording, a_result(error, truth), cpu_s=0.4)
    np.testing.assert_allclose(sample.norm_full[0], [[0, 0], [np.sqrt(29), 1]])
    np.testing.assert_allclose(sample.own_position[0], [[0, 0], [5, 0]])
    np.testing.assert_allclose(sample.own_velocity[0], [[0, 0], [0, 1]])
    np.testing.assert_allclose(sample.others_position[0], [[0, 0], [2, 0]])
    assert sample.step_cpu_s == [pytest.approx(0.1)]
    assert (sample.not_converged, sample.fell_back) == (1, 1)


def test_means_and_their_errors_by_hand() -> None:
    assert mean_and_error([1.0, 2.0, 6.0]) == (3.0, pytest.approx(np.sqrt(7) / np.sqrt(3)))
    mean, error = mean_and_error([4.0])
    assert mean == 4.0
    assert np.isnan(error)
    # two runs of four ticks and one agent; ticks 1..2 have means 2 and 4, mean squares 5 and 16
    runs = [np.array([[9.0], [1.0], [3.0], [9.0]]), np.array([[9.0], [4.0], [4.0], [9.0]])]
    assert window_mean(runs, 1, 2) == (3.0, pytest.approx(1.0))
    root, error = window_rms(runs, 1, 2)
    assert root == pytest.approx(np.sqrt(10.5))
    assert error == pytest.approx(5.5 / (2 * np.sqrt(10.5)))


def test_ratio_of_two_methods_on_the_same_runs_by_hand() -> None:
    # GIVEN two runs; the first method is worse by a factor of 2 in one, 4 in the other
    over = [np.array([[9.0], [2.0]]), np.array([[9.0], [12.0]])]
    under = [np.array([[9.0], [1.0]]), np.array([[9.0], [3.0]])]
    ratio, error = ratio_of_means(over, under, 1, 1)
    assert ratio == pytest.approx(14 / 4)
    # per run a - ratio b = -1.5 and 1.5, over the mean 2; standard error of two
    assert error == pytest.approx(0.75 * np.sqrt(2) / np.sqrt(2))
    # and a method beside itself is 1, without error
    assert ratio_of_means(under, under, 0, 1) == (1.0, 0.0)


def test_several_processes_give_what_one_gives() -> None:
    methods = {"central": EstimatorSettings(kind="centralized_ekf")}
    alone = run_study(StudyScenario(samples=6), methods, 3, seed=2)
    with Hangar(2) as hangar:
        together = run_study(StudyScenario(samples=6), methods, 3, seed=2, hangar=hangar)
    for name in ("norm_full", "own_sigma", "nees_full", "status"):
        for one, other in zip(getattr(alone["central"], name), getattr(together["central"], name), strict=True):
            np.testing.assert_array_equal(one, other)


def test_links_have_a_seed_of_their_own() -> None:
    def flown(seed: int, link_seed: int | None) -> np.ndarray:
        flight = StudyFlight(StudyScenario(samples=4), {"it": default_settings()}, seed, 0, lossy(0.5), link_seed)
        return flight.fly()["it"].norm_full[0]

    np.testing.assert_array_equal(flown(1, None), flown(1, 1))
    assert (flown(1, None) != flown(1, 2)).any()


def test_a_study_is_flown_or_runs_tick_by_tick_and_says_what_was_served() -> None:
    methods = {"it": default_settings(), "central": EstimatorSettings(kind="centralized_ekf")}
    flown = run_study(StudyScenario(samples=6), methods, 1, seed=2)
    assert [len(flown[name].available) for name in methods] == [1, 0]  # a central filter does not fly
    row = accuracy_row(flown["it"], 1, 6)
    assert row["availability"] == 1.0
    assert row["sent_all_bytes_per_s"] > 0
    stepped = run_study(StudyScenario(samples=6), methods, 1, seed=2, flown=False)
    assert not stepped["it"].available
    np.testing.assert_array_equal(stepped["central"].norm_full[0], flown["central"].norm_full[0])


def test_rows_of_the_tables_by_hand() -> None:
    sample = Sample(
        norm_full=[np.array([[9.0], [1.0], [3.0]]), np.array([[9.0], [3.0], [5.0]])],
        own_position=[np.ones((3, 1))] * 2,
        own_velocity=[np.full((3, 1), 2.0)] * 2,
        others_position=[np.full((3, 1), 3.0)] * 2,
        nees_full=[np.full((3, 1), 0.9)] * 2,
        nees_own=[np.full((3, 1), 1.1)] * 2,
        step_cpu_s=[0.001, 0.003],
        not_converged=2,
        fell_back=1,
    )
    row = table1_row(sample, 2)
    assert row == {
        "norm_full_mean": 3.0,  # means over t = 1..2: 2 and 4
        "norm_full_mean_se": pytest.approx(1.0),
        "norm_full_final": 4.0,
        "norm_full_final_se": pytest.approx(1.0),
        "step_time_mean_s": pytest.approx(0.002),
        "failures": 3,
    }
    steady = accuracy_row(sample, 2, 2)
    assert steady["norm_full_steady_mean"] == 4.0
    assert steady["norm_full_steady_rms"] == pytest.approx(np.sqrt(17))
    assert steady["own_position_steady_mean_m"] == 1.0
    assert steady["own_velocity_steady_rms_mps"] == pytest.approx(2.0)
    assert steady["others_position_steady_mean_m"] == 3.0
    assert steady["anees_full_steady_mean"] == pytest.approx(0.9)
    assert steady["failures"] == 3
    # the transient is what comes before: t = 1
    assert steady["norm_full_transient_mean"] == 2.0
    assert steady["anees_full_transient_mean"] == pytest.approx(0.9)


# --- consistency ------------------------------------------------------------------------------------------------


def test_nees_by_hand() -> None:
    covariance = np.array([[4.0, 0.0], [0.0, 0.25]])
    assert nees(np.array([2.0, 1.0]), covariance) == pytest.approx(1.0 + 4.0)
    turned = np.array([[2.0, 1.0], [1.0, 2.0]])
    assert nis(np.array([1.0, -1.0]), turned) == pytest.approx(2.0)  # eigenvalue 1 along (1, -1)
    with pytest.raises(np.linalg.LinAlgError):
        nees(np.ones(2), -np.eye(2))
    assert rms(np.array([[3.0, 4.0], [0.0, 0.0]])) == pytest.approx(np.sqrt(12.5))


@pytest.mark.parametrize(("dimension", "samples"), [(6, 1), (18, 4), (18, 50)])
def test_nees_band_holds_its_probability(dimension: int, samples: int) -> None:
    # GIVEN draws of a consistent estimator
    rng = np.random.default_rng(0)
    averages = np.square(rng.normal(size=(4000, samples * dimension))).mean(axis=1)
    low, high = average_nees_band(dimension, samples, 0.9)
    assert np.mean((low < averages) & (averages < high)) == pytest.approx(0.9, abs=0.02)
    assert low < 1 < high
    wider = average_nees_band(dimension, samples, 0.99)
    assert wider[0] < low
    assert wider[1] > high


@pytest.mark.slow
def test_small_study() -> None:
    # GIVEN the paper's fleet with the consistent variance and the good start, a few runs
    runs = 6
    methods = {
        "pre": EstimatorSettings(),
        "overconfident": EstimatorSettings(other_accel_variance=0.0033),
        "dekf_ci": EstimatorSettings(kind="dekf_ci"),
        "central": EstimatorSettings(kind="centralized_ekf", iterations_ekf=10),
    }
    calls = []
    samples = run_study(StudyScenario(), methods, runs, seed=11, progress=lambda: calls.append(1), flown=False)
    assert len(calls) == runs * len(methods)
    rows = {name: accuracy_row(sample, 41, 70) for name, sample in samples.items()}
    # THEN the steady figures are those known from twenty other runs (.301, .185, .109), a run scattering by a fifth
    assert rows["pre"]["norm_full_steady_mean"] == pytest.approx(0.301, abs=0.06)
    assert rows["dekf_ci"]["norm_full_steady_mean"] == pytest.approx(0.185, abs=0.03)
    assert rows["central"]["norm_full_steady_mean"] == pytest.approx(0.109, abs=0.03)
    # the estimator is consistent: known 0.90; the band of as many independent samples as runs, at 99.9 %
    low, high = average_nees_band(18, runs, 0.999)
    assert low < rows["pre"]["anees_full_steady_mean"] < high
    # and one that takes the others' unknown accelerations for small is not
    assert rows["overconfident"]["anees_full_steady_mean"] > 10 * high
