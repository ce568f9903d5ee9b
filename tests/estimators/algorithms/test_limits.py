"""The shared estimator with limits on its states: a floor that resolves mirror images, and one in flight."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from estimators.estimator import Estimate, Status
from estimators.factory import make_estimator
from estimators.model.layout import Layout, position
from estimators.model.measurements import empty_inputs, input_rows, position_rows, range_row
from estimators.settings import EstimatorSettings, LimitsTable, VehicleLimits, default_settings
from sim_bridge.studies.flown import fly_recording
from sim_bridge.studies.study_scenario import StudyScenario

DT = 0.1
BLIND = 3


def with_limits(**limits: float) -> EstimatorSettings:
    return msgspec.structs.replace(default_settings(), limits=LimitsTable(vehicle=VehicleLimits(**limits)))


def above_a_flat_fleet(
    settings: EstimatorSettings, seed: int, prior_down_m: float, prior_sigma_m: float, ticks: int = 40
) -> tuple[list[Estimate], Sequence[float]]:
    """A blind drone 8 m up, its three neighbours 3 m up: the mirror image is 2 m below the origin.

    ``prior_down_m`` with its sigma is where the blind drone is taken to be first. Gives its own estimates and their
    errors in m.
    """
    rng = np.random.default_rng(seed)
    places = np.array([[0, 0, -3.0], [12, 0, -3.0], [3, 11, -3.0], [5, 4, -8.0]])
    places += rng.normal(size=(4, 3)) * [0.3, 0.3, 0.1]
    truth = np.concatenate([places, rng.normal(size=(4, 3)) * [0.3, 0.3, 0.02]], axis=1)
    mean = truth + 0.3 * rng.normal(size=(4, 6))
    mean[BLIND] = [*(places[BLIND, :2] + rng.normal(size=2)), prior_down_m, 0.0, 0.0, 0.0]
    sigmas = np.concatenate([np.tile([0.5, 0.5, 0.5, 0.3, 0.3, 0.3], 3), [prior_sigma_m] * 3, [1.0] * 3])
    estimator = make_estimator(settings, Layout((1, 2, 3, 4)), BLIND, mean.ravel(), np.diag(sigmas**2), DT)
    estimates, errors = [], []
    for tick in range(ticks):
        truth[:, :3] = places + truth[:, 3:] * tick * DT
        rows = [position_rows(tick, a, truth[a, :3] + 0.1 * rng.normal(size=3), np.full(3, 0.01)) for a in range(3)]
        for a in range(4):
            for b in range(a):
                away = float(np.linalg.norm(truth[a, :3] - truth[b, :3]))
                rows.append(range_row(tick, a, b, away + 0.05 * rng.normal(), 0.0025))
        pushes = [input_rows(tick - 1, a, 0.02 * rng.normal(size=3), np.full(3, 0.01)) for a in range(4)]
        estimator.begin(tick, np.concatenate(rows), np.concatenate(pushes) if tick else empty_inputs())
        estimates.append(estimator.solve())
        errors.append(float(np.linalg.norm(estimates[-1].mean[position(BLIND)] - truth[BLIND, :3])))
    return estimates, errors


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("prior", [(1.0, 10.0), (2.0, 3.0)], ids=["wide", "on the wrong side"])
def test_a_floor_resolves_the_mirror_image_of_a_flat_fleet(seed: int, prior: tuple[float, float]) -> None:
    # GIVEN a start nearer to the mirror image below the floor than to the truth: without a floor it is taken
    _, lost = above_a_flat_fleet(default_settings(), seed, *prior)
    assert lost[-1] > 8.0
    # THEN with a floor the drone is where it is, and knows so
    estimates, errors = above_a_flat_fleet(with_limits(floor_m=0.0), seed, *prior)
    assert max(errors[3:]) < 1.0
    assert {each.status for each in estimates[10:]} == {Status.OK}
    # and once it is there, no limit has anything to do
    assert max(each.report.qp_solves for each in estimates[10:]) == 0


@pytest.mark.parametrize("seed", range(3))
def test_a_belief_that_is_sure_of_a_place_below_the_floor_is_held_there_and_flagged(seed: int) -> None:
    # GIVEN a start 10 m off that is sure to a metre
    estimates, errors = above_a_flat_fleet(with_limits(floor_m=0.0), seed, 2.0, 1.0, ticks=12)
    # THEN the estimate keeps the floor, and says that something is wrong
    for estimate, error in zip(estimates[1:], errors[1:], strict=True):
        assert estimate.mean[position(BLIND)][2] <= 1e-6
        assert estimate.report.active_bounds > 0
        assert error < 5.0 or estimate.status is not Status.OK


def test_agents_fly_with_a_floor_and_a_speed_limit() -> None:
    # GIVEN a flight in virtual time, whose lowest drone is a centimetre above the floor
    recording = StudyScenario(graph="triangle", samples=40).record(0, 6)
    assert recording.truth is not None
    floor_m = -float(recording.truth[..., 2].max()) - 0.01
    fastest_mps = float(np.linalg.norm(recording.truth[..., 3:], axis=-1).max())
    free = fly_recording(recording, default_settings())
    settings = with_limits(floor_m=floor_m, speed_mps=fastest_mps + 0.01)
    # WHEN agents fly with that floor, and with a limit a little above the highest speed
    kept = fly_recording(recording, settings)
    # THEN no drone is believed beyond them, as some are without, and the estimates are no worse
    lowest, fastest = [], []
    for flight in (free, kept):
        blocks = flight.estimates.mean[1:].reshape(-1, 2, 3)
        lowest.append(-float(blocks[:, 0, 2].max()))
        fastest.append(float(np.linalg.norm(blocks[:, 1], axis=-1).max()))
    assert lowest[0] < floor_m - 0.01
    assert lowest[1] >= floor_m - 1e-6
    assert fastest[0] > fastest_mps + 0.01
    assert fastest[1] <= fastest_mps + 0.01 + 1e-6
    assert kept.available.all()
    truth = recording.truth.reshape(len(recording.truth), 1, -1)
    before, after = (float(np.sqrt(((f.estimates.mean - truth)[10:] ** 2).mean())) for f in (free, kept))
    assert after < 1.02 * before
