"""A drone without fixes in flight: an honest status, no mirror image silently chosen, a consistent start.

The flights are those of the studies (`sim_bridge.studies.study_scenario`); the figures over many of them are in
the benches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

import sim_bridge.studies.lockstep as lockstep
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.model.layout import position
from estimators.settings import EstimatorSettings
from sim_bridge.studies.lockstep import LockstepResult, run_lockstep
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario

Array = NDArray[np.float64]
SHARED = EstimatorSettings(
    kind="dmhe_shared", window=6, rounds=2, share_inputs="fleet", relay_hops=2, unknown_inputs="hold"
)


def blind_flight(graph: str, run: int, samples: int, start_sigma_m: float = 2.0) -> StudyInput:
    """The last agent is blind; everybody starts with errors of ``start_sigma_m`` per axis and 1 m/s."""
    recording = StudyScenario(graph=graph, samples=samples, blind=1).record(0, run)
    assert recording.truth is not None
    agents = len(recording.agents)
    sigmas = np.tile([start_sigma_m] * 3 + [1.0] * 3, agents)
    errors = np.random.default_rng([0, run, 99]).normal(size=(agents, 6 * agents)) * sigmas
    return replace(recording, x0=recording.truth[0].ravel() + errors)


def judged(recording: StudyInput, result: LockstepResult) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Error and sigma of the blind drone's own position, and where its status is not observable, by tick."""
    assert recording.truth is not None
    blind = len(recording.agents) - 1
    error = result.mean[:, blind, position(blind)] - recording.truth[:, blind, :3]
    sigma = np.sqrt(result.cov_diag[:, blind, position(blind)].sum(axis=-1))
    return np.linalg.norm(error, axis=-1), sigma, result.status[:, blind] == Status.NOT_OBSERVABLE


@pytest.mark.parametrize("run", range(2))
def test_with_one_range_it_says_that_it_does_not_know(run: int) -> None:
    recording = blind_flight("line", run, 60)
    error, sigma, flagged = judged(recording, run_lockstep(recording, SHARED))
    assert flagged[10:].mean() > 0.9
    assert flagged[1:][error[1:] > 3 * sigma[1:]].all()
    # and the covariance covers what it does not know
    assert (error[1:] > 3 * sigma[1:]).mean() < 0.1


def test_with_four_neighbours_and_with_fixes_it_raises_no_alarm() -> None:
    recording = blind_flight("K5", 0, 40)
    result = run_lockstep(recording, SHARED)
    _, _, flagged = judged(recording, result)
    assert not flagged[5:].any()
    assert not (result.status[:, :-1] == Status.NOT_OBSERVABLE).any()


def test_a_start_at_the_mirror_image_is_not_taken_for_the_truth() -> None:
    # GIVEN three located neighbours, and a blind drone that starts at its mirror image in their plane
    recording = blind_flight("K4", 0, 60)
    assert recording.truth is not None
    corners = recording.truth[0, :3, :3]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    height = float((recording.truth[0, 3, :3] - corners[0]) @ normal)
    x0 = np.tile(recording.truth[0].ravel(), (4, 1))
    x0[:, 18:21] -= 2.0 * height * normal
    recording = replace(recording, x0=x0, P0=np.diag(np.tile([36.0] * 3 + [4.0] * 3, 4)))
    error, sigma, flagged = judged(recording, run_lockstep(recording, SHARED))
    assert error[2] > 3.0
    # THEN it says so as long as it is wrong, its covariance covers the truth, and in the end it is right
    wrong = np.flatnonzero(error > np.maximum(3 * sigma, 0.5))
    assert flagged[wrong[wrong > 2]].all()
    assert (error[3:] < 4 * sigma[3:]).mean() > 0.9
    assert error[-10:].max() < 0.5
    assert sigma[-10:].max() < 0.15
    assert not flagged[-10:].any()


def renamed(recording: StudyInput) -> tuple[StudyInput, Callable[[Array], Array]]:
    order = np.array([1, 0, 2])
    states = (6 * order[:, None] + np.arange(6)).ravel()
    assert recording.truth is not None
    return replace(
        recording,
        edges=np.argsort(order)[recording.edges],
        accel=recording.accel[:, order],
        gps=recording.gps[:, order],
        ranges=recording.ranges[:, order][:, :, order],
        x0=recording.x0[order][:, states],
        truth=recording.truth[:, order],
    ), lambda mean: mean[:, order][:, :, states]


def moved(recording: StudyInput) -> tuple[StudyInput, Callable[[Array], Array]]:
    shift = np.array([300.0, -200.0, 50.0])
    whole = np.tile(np.r_[shift, 0.0, 0.0, 0.0], 3)
    assert recording.truth is not None
    gps, truth = recording.gps.copy(), recording.truth.copy()
    gps[..., :3] += shift
    truth[..., :3] += shift
    return replace(recording, gps=gps, truth=truth, x0=recording.x0 + whole), lambda mean: mean + whole


def turned(recording: StudyInput) -> tuple[StudyInput, Callable[[Array], Array]]:
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    fleet = np.kron(np.eye(6), turn)
    assert recording.truth is not None
    gps = recording.gps.copy()
    gps[..., :3] = gps[..., :3] @ turn.T
    truth = (recording.truth.reshape(-1, 18) @ fleet.T).reshape(recording.truth.shape)
    accel = recording.accel @ turn.T
    return replace(recording, gps=gps, truth=truth, accel=accel, x0=recording.x0 @ fleet.T), lambda m: m @ fleet.T


@pytest.mark.parametrize("change", [renamed, moved, turned])
def test_names_place_and_north_do_not_matter(
    change: Callable[[StudyInput], tuple[StudyInput, Callable[[Array], Array]]],
) -> None:
    recording = blind_flight("triangle", 2, 25)
    other, back = change(recording)
    exact = msgspec.structs.replace(SHARED, tolerance=1e-10, max_iterations=500)
    one, two = (run_lockstep(each, exact) for each in (recording, other))
    np.testing.assert_allclose(two.mean, back(one.mean), rtol=0, atol=1e-4)
    assert (one.status == Status.NOT_OBSERVABLE).any()
    np.testing.assert_array_equal(two.status[:, 2], one.status[:, 2])


def _silent_start(monkeypatch: pytest.MonkeyPatch, run: int) -> LockstepResult:
    """A line of three whose agents hear nothing for two seconds and take the others to be 10 m beside themselves."""
    recording = StudyScenario(graph="line", samples=60).record(0, run)
    assert recording.truth is not None
    angles = 2 * np.pi * np.arange(3) / 3
    beside = 10.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=-1)
    x0 = np.zeros((3, 18))
    for me in range(3):
        here = recording.truth[0, me, :3] + np.random.default_rng([run, me]).normal(size=3) * 2.0
        for slot in range(3):
            x0[me, position(slot)] = here if slot == me else here + beside[slot]
    received = recording.received.copy()
    received[:20] = False

    def wide_of_others(settings, layout, slot, mean, covariance, period_s):  # type: ignore[no-untyped-def]
        variances = np.tile([50.0**2] * 3 + [4.0] * 3, 3)
        variances[6 * slot : 6 * slot + 6] = 4.0
        return make_estimator(settings, layout, slot, mean, np.diag(variances), period_s)

    monkeypatch.setattr(lockstep, "make_estimator", wide_of_others)
    return run_lockstep(replace(recording, x0=x0, received=received), SHARED)


def test_agents_never_heard_of_are_ranged_without_false_certainty(monkeypatch: pytest.MonkeyPatch) -> None:
    results = [_silent_start(monkeypatch, run) for run in range(3)]
    found = np.array([result.nees_full for result in results]).mean(axis=-1)
    # counted with the sensor's variance alone, such ranges give hundreds to thousands
    assert 0.5 < found[:, 1:60].mean() < 3.0
    # and from the time on that they hear each other, the covariance is as large as the errors
    assert 0.6 < found[:, 20:].mean() < 1.5
