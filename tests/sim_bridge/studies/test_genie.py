"""The genie: what reaches it, and that it solves the full-information problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.estimator import Status
from estimators.settings import EstimatorSettings, default_settings
from sim_bridge.studies.air import lossy
from sim_bridge.studies.flown import fly_recording
from sim_bridge.studies.genie import Genie
from sim_bridge.studies.lockstep import LockstepResult, run_lockstep
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario
from tests.support.link_conditions import with_loss
from tests.support.whole_exchange import heard_of


def relay(window: int) -> EstimatorSettings:
    return EstimatorSettings(
        kind="dmhe_shared", window=window, rounds=2, share_inputs="fleet", relay_hops=2, unknown_inputs="hold"
    )


RELAY = relay(12)


def line(samples: int = 12) -> StudyInput:
    return StudyScenario(samples=samples).record(4, 0)


def genie(recording: StudyInput) -> LockstepResult:
    """Of a fleet whose packets of records come twice a tick and carry everything."""
    return Genie(RELAY).run(recording, heard_of(recording, 2))


def only_positions(recording: StudyInput) -> StudyInput:
    """The linear problem: no speed and no range rows."""
    gps = recording.gps.copy()
    gps[:, :, 3] = np.nan
    return replace(recording, gps=gps, ranges=np.full_like(recording.ranges, np.nan))


def test_on_a_linear_problem_it_is_the_kalman_filter() -> None:
    recording = only_positions(line(20))
    found = genie(recording)
    filtered = run_lockstep(recording, EstimatorSettings(kind="centralized_ekf"))
    np.testing.assert_allclose(found.mean[:, 0], filtered.mean[:, 0], atol=1e-9)
    np.testing.assert_allclose(found.cov_diag[:, 0], filtered.cov_diag[:, 0], rtol=1e-8)


def test_what_came_late_is_worth_as_much_as_on_time() -> None:
    # GIVEN a linear problem, and links that brought nothing until the last tick
    recording = only_positions(line(20))
    received = recording.received.copy()
    received[:20] = False
    deaf = genie(replace(recording, received=received))
    whole = genie(recording)
    # THEN they know nothing of each other until then, and in the end all that they would have known
    assert deaf.cov_diag[19, 0, 12] > 100 * whole.cov_diag[19, 0, 12]
    np.testing.assert_allclose(deaf.mean[20], whole.mean[20], atol=1e-8)


def test_it_solves_what_a_window_as_long_as_the_flight_solves() -> None:
    recording = line(12)
    found, window = genie(recording), run_lockstep(recording, RELAY)
    assert (found.status[3:] == Status.OK).all()
    np.testing.assert_allclose(found.mean[3:], window.mean[3:], atol=2e-4)
    np.testing.assert_allclose(found.cov_diag[3:], window.cov_diag[3:], rtol=1e-3)


def test_it_repeats_bit_by_bit() -> None:
    recording = with_loss(line(), 0.5, np.random.default_rng(0))
    one, again = (genie(recording) for _ in range(2))
    np.testing.assert_array_equal(one.mean, again.mean)


@pytest.mark.slow
def test_no_worse_than_the_flown_estimator_it_bounds() -> None:
    # GIVEN the same runs over bad links, flown
    settings, figures = default_settings(), []
    for run in range(4):
        recording = StudyScenario(samples=60).record(9, run)
        assert recording.truth is not None
        truth = recording.truth.reshape(61, 1, 18)
        flown = fly_recording(recording, settings, lossy(0.6), seed=run)
        for result in (Genie(settings).run(recording, flown.heard), flown.estimates):
            figures.append(np.linalg.norm(result.mean - truth, axis=-1)[35:].mean())
    bound, flagship = np.mean(np.reshape(figures, (4, 2)), axis=0)
    # THEN full information wins or ties, within what four runs can tell, and the flagship is near to it
    assert bound < 1.03 * flagship
    assert flagship < 1.15 * bound
