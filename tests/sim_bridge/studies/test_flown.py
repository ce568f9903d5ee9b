"""Study inputs flown by the drones' own agents."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import convert

from estimators.estimator import Status
from estimators.settings import EstimatorSettings, default_settings, with_kind_defaults
from sim_bridge.studies.air import Air, lossy
from sim_bridge.studies.flown import FlownResult, config_of, fly_recording
from sim_bridge.studies.lockstep import run_lockstep
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario
from transport.link.channel import LinkFaults

SETTINGS = default_settings()


def line(samples: int = 25, run: int = 0) -> StudyInput:
    return StudyScenario(samples=samples).record(4, run)


def errors(recording: StudyInput, mean: np.ndarray) -> np.ndarray:
    assert recording.truth is not None
    return np.linalg.norm(mean - recording.truth.reshape(len(recording.truth), 1, -1), axis=-1)


@pytest.fixture(scope="module")
def flown() -> FlownResult:
    return fly_recording(line(), SETTINGS)


def test_every_tick_has_its_estimate_in_time(flown: FlownResult) -> None:
    assert flown.available.all()
    assert (flown.estimates.status[1:] == Status.OK).all()


def test_over_whole_links_it_is_the_study_of_the_same_input_to_the_wires_rounding(flown: FlownResult) -> None:
    # GIVEN the estimator run tick by tick on the same input, with the same records at the same ticks
    recording = line()
    stepped = run_lockstep(recording, SETTINGS)
    # THEN what flies is that, but for the rounding of records and pairs on the wire
    assert np.abs(flown.estimates.mean[6:] - stepped.mean[6:]).max() < 0.02
    np.testing.assert_allclose(flown.estimates.cov_diag[6:], stepped.cov_diag[6:], rtol=0.05)


def test_it_repeats_bit_by_bit_and_follows_the_seed_of_the_radio() -> None:
    one, again, other = (fly_recording(line(12), SETTINGS, lossy(0.5), seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.estimates.mean, again.estimates.mean)
    assert (one.estimates.mean != other.estimates.mean).any()


def test_what_could_be_known_is_what_packets_brought(flown: FlownResult) -> None:
    # over whole links everybody could know everything of a tick by its estimate, once neighbours have been heard
    ticks = np.arange(1, 26)
    assert all(flown.heard[tick, :, : tick + 1].all() for tick in ticks)
    assert not any(flown.heard[tick, :, tick + 1 :].any() for tick in ticks)
    # and with a radio that brings nothing each knows its own
    alone = fly_recording(line(6), SETTINGS, lossy(1.0))
    own = np.eye(3, dtype=bool)[:, None, :]
    assert all((alone.heard[tick, :, : tick + 1] == own).all() for tick in range(7))


def test_lost_and_late_packets_cost_and_copies_do_not(flown: FlownResult) -> None:
    recording = line()
    whole = errors(recording, flown.estimates.mean)[15:].mean()
    lost = fly_recording(recording, SETTINGS, lossy(0.9))
    assert errors(recording, lost.estimates.mean)[15:].mean() > 1.3 * whole
    late = fly_recording(recording, SETTINGS, Air(delay_ticks=3.0))
    assert errors(recording, late.estimates.mean)[15:].mean() > 1.1 * whole
    twice = fly_recording(recording, SETTINGS, Air(LinkFaults(duplicate=1.0)))
    np.testing.assert_array_equal(twice.estimates.mean, flown.estimates.mean)


def test_bytes_are_counted_by_kind_and_within_what_packets_may_hold(flown: FlownResult) -> None:
    kinds = {name: rate for name, rate in flown.bytes_per_s.items() if name != "all"}
    assert set(kinds) == {"Measurements", "Information", "FleetEstimate"}
    assert flown.bytes_per_s["all"] == pytest.approx(sum(kinds.values()))
    assert 2 * 10 * 40 < kinds["Measurements"] < 4 * 10 * 1200


def test_an_estimator_that_agrees_on_states_flies_like_any_other() -> None:
    # GIVEN the consensus MHE, whose neighbours get windows instead of information pairs
    recording = line(60)
    settings = convert(with_kind_defaults({"kind": "consensus_mhe", "rounds": 2}), EstimatorSettings)
    flown = fly_recording(recording, settings)
    # THEN all estimates are in time, windows travel, and the fleet comes to be known
    assert flown.available.all()
    assert flown.bytes_per_s["WindowStates"] > 0
    assert "Information" not in flown.bytes_per_s
    assert (flown.estimates.status[1:] == Status.OK).all()
    assert errors(recording, flown.estimates.mean)[50:].mean() < 0.6
    # and packed or not is only rounding
    stepped = run_lockstep(recording, settings)
    assert errors(recording, stepped.mean)[30:].mean() == pytest.approx(
        errors(recording, flown.estimates.mean)[30:].mean(), rel=0.2
    )


def test_a_drone_without_fixes_flies_on_its_ranges() -> None:
    recording = StudyScenario("K4", 60, blind=1, start_sigma_m=2.0).record(0, 0)
    found = fly_recording(recording, SETTINGS).estimates
    assert recording.truth is not None
    error = np.linalg.norm(found.mean[40:, 3, 18:21] - recording.truth[40:, 3, :3], axis=-1)
    assert np.median(error) < 0.3


def test_the_configuration_says_what_the_input_says() -> None:
    recording = line()
    config = config_of(recording, EstimatorSettings(kind="dekf_ci"))
    assert config.ids == (1, 2, 3)
    assert config.fleet.edges == ((1, 2), (2, 3))
    assert config.estimator.kind == "dekf_ci"
    assert config.sensors.gps_position_half_width_m == recording.gps_half_width[0]
    with pytest.raises(ValueError, match="gps_half_width: expected one bound for all axes"):
        config_of(replace(recording, gps_half_width=np.array([0.1, 0.2, 0.1, 0.1])), EstimatorSettings())
