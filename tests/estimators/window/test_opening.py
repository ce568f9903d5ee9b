"""The start with speeds that have no direction, from rows that come late."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import empty_inputs, empty_rows, input_rows, position_rows, speed_row
from estimators.model.motion import predict_mean
from estimators.settings import default_settings
from sim_bridge.studies.air import Air
from sim_bridge.studies.monte_carlo import StudyFlight
from sim_bridge.studies.study_scenario import StudyScenario

DT = 0.1
TICKS = 40
FIX_SIGMA_M, SPEED_SIGMA_MPS, ACCEL_SIGMA_MPS2 = 0.09, 0.05, 0.02
FLYING = msgspec.structs.replace(default_settings(), systematic_errors=False)
PRIOR = np.diag([6.0] * 3 + [1.0] * 3)


def nees(seed: int, late: int) -> float:
    """Of the last state, over six, of a drone whose rows and accelerations come ``late`` ticks after theirs."""
    rng = np.random.default_rng(seed)
    state = np.r_[rng.normal(size=3) * 10.0, rng.normal(size=3) * 1.5]
    first = rng.multivariate_normal(state, PRIOR)
    estimator = make_estimator(FLYING, Layout((1,)), 0, first, PRIOR, DT)
    accel, rows, inputs = rng.uniform(-2.0, 2.0, 3), [], []
    for tick in range(TICKS):
        fix = state[:3] + rng.normal(size=3) * FIX_SIGMA_M
        speed = float(np.linalg.norm(state[3:])) + rng.normal() * SPEED_SIGMA_MPS
        said = accel + rng.normal(size=3) * ACCEL_SIGMA_MPS2
        rows.append(
            np.concatenate(
                [
                    position_rows(tick, 0, fix, np.full(3, FIX_SIGMA_M**2)),
                    speed_row(tick, 0, speed, SPEED_SIGMA_MPS**2),
                ]
            )
        )
        inputs.append(input_rows(tick, 0, said, np.full(3, ACCEL_SIGMA_MPS2**2)))
        then = tick - late
        estimator.begin(
            tick, rows[then] if then >= 0 else empty_rows(), inputs[then - 1] if then > 0 else empty_inputs()
        )
        estimate, truth = estimator.solve(), state
        state = predict_mean(state, accel, DT)
        accel = np.clip(accel + rng.normal(size=3) * 0.3, -2.0, 2.0)
    error = estimate.mean - truth
    return float(error @ np.linalg.solve(estimate.covariance, error)) / 6.0


@pytest.mark.parametrize("late", [0, 2, 4])
def test_nobody_stays_on_the_wrong_side_of_the_sphere_of_a_speed(late: int) -> None:
    # GIVEN drones that begin with velocities about 1 m/s off, as their covariance says; what is measured comes late
    found = np.array([nees(seed, late) for seed in range(60)])
    # THEN none is sure of another velocity, and all together are as good as they say
    assert found.max() < 6.0
    assert 0.5 < found.mean() < 1.4


@pytest.mark.parametrize("run", [2, 19])
def test_the_other_end_of_a_line_is_not_held_where_the_first_fixes_alone_put_it(run: int) -> None:
    # GIVEN flights of three in a line, three ticks from neighbour to neighbour: the iteration from the first estimate
    # alone ended on the wrong side, and the fixes that came later were taken for outliers
    air = Air(delay_ticks=3)
    flown = StudyFlight(StudyScenario(), {"flown": FLYING}, 0, run, air, None, True).fly()["flown"]
    assert 0.05 < float(flown.norm_full[0][41:].mean()) < 0.3
