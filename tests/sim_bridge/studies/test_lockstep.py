"""Lockstep: who gets which packet when, and that a run is a function of its recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.estimator import Status
from estimators.model.measurements import Kind
from estimators.settings import EstimatorSettings
from estimators.settings import Kind as EstimatorKind
from sim_bridge.studies.lockstep import Links, neighbours, own_input, own_rows, run_lockstep
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario

ESTIMATORS: tuple[EstimatorKind, ...] = ("dmhe_pre_ekf", "dmhe", "dmhe_shared", "dekf_ci", "centralized_ekf")


@pytest.fixture
def recording() -> StudyInput:
    return StudyScenario(samples=12).record(5, 0)


def test_rows_of_an_agent(recording: StudyInput) -> None:
    rows = own_rows(recording, 4, 1)
    assert rows["kind"].tolist() == [Kind.POSITION] * 3 + [Kind.SPEED] + [Kind.RANGE] * 2
    np.testing.assert_array_equal(rows["value"][:4], recording.gps[4, 1])
    np.testing.assert_array_equal(rows["value"][4:], recording.ranges[4, 1, [0, 2]])
    assert rows["other"].tolist() == [-1] * 4 + [0, 2]
    assert (rows["agent"] == 1).all()
    assert (rows["observer"] == 1).all()
    assert (rows["tick"] == 4).all()
    # variance of a uniform noise, and its bound
    half = [*recording.gps_half_width, 0.1, 0.1]
    np.testing.assert_allclose(rows["half_width"], half)
    np.testing.assert_allclose(rows["variance"], np.square(half) / 3)


def test_what_was_not_measured_is_no_row(recording: StudyInput) -> None:
    gps, ranges = recording.gps.copy(), recording.ranges.copy()
    gps[4, 1, :3] = np.nan
    ranges[4, 1, 0] = np.nan
    spoiled = replace(recording, gps=gps, ranges=ranges)
    assert own_rows(spoiled, 4, 1)["kind"].tolist() == [Kind.SPEED, Kind.RANGE]
    gps[4, 1] = np.nan
    ranges[4, 1] = np.nan
    assert len(own_rows(replace(recording, gps=gps, ranges=ranges), 4, 1)) == 0


def test_input_belongs_to_the_tick_before(recording: StudyInput) -> None:
    assert len(own_input(recording, 0, 2)) == 0
    found = own_input(recording, 3, 2)
    assert found["tick"].tolist() == [2]
    np.testing.assert_array_equal(found["accel"][0], recording.accel[2, 2])
    np.testing.assert_allclose(found["variance"][0], 0.1**2 / 3)


def test_links(recording: StudyInput) -> None:
    # GIVEN a line of three, one packet lost and one late
    received, delay = recording.received.copy(), recording.delay_ticks.copy()
    received[3, 0, 1] = False
    delay[4, 1, 2] = 2
    links = Links(replace(recording, received=received, delay_ticks=delay))
    assert neighbours(recording) == [[1], [0, 2], [1]]
    # THEN only edges carry packets, and neither a lost nor a late one takes part in its tick's rounds
    assert links.heard(2, 0) == [1]
    assert links.heard(3, 0) == []
    assert links.heard(3, 2) == [1]
    assert links.heard(4, 1) == [0]
    assert links.heard(6, 1) == [0, 2]


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_run_repeats_bit_by_bit(recording: StudyInput, kind: EstimatorKind) -> None:
    settings = EstimatorSettings(kind=kind)
    first, second = (run_lockstep(recording, settings) for _ in range(2))
    np.testing.assert_array_equal(first.mean, second.mean)
    np.testing.assert_array_equal(first.cov_diag, second.cov_diag)
    np.testing.assert_array_equal(first.status, second.status)


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_shape_and_health_of_a_run(recording: StudyInput, kind: EstimatorKind) -> None:
    ticks = []
    result = run_lockstep(recording, EstimatorSettings(kind=kind), ticks.append)
    assert ticks == list(range(13))
    assert result.mean.shape == result.cov_diag.shape == (13, 3, 18)
    assert result.status.shape == (13, 3)
    assert result.status.dtype == np.int8
    assert (result.status == Status.OK).all()
    assert (result.cov_diag > 0).all()
    assert not result.dropped.any()
    assert result.nees_full is not None
    assert result.nees_full.shape == (13, 3)
    if kind == "centralized_ekf":  # one estimate for all
        np.testing.assert_array_equal(result.mean[:, 0], result.mean[:, 2])
    else:
        assert np.abs(result.mean[:, 0] - result.mean[:, 2]).max() > 1e-6


def test_without_truth_there_is_no_nees(recording: StudyInput) -> None:
    result = run_lockstep(replace(recording, truth=None), EstimatorSettings(kind="dekf_ci"))
    assert result.nees_full is None
    assert result.nees_own is None


def test_centralised_starts_from_row_zero(recording: StudyInput) -> None:
    settings = EstimatorSettings(kind="centralized_ekf")
    x0 = recording.x0.copy()
    x0[1:] = 77.0
    expected = run_lockstep(recording, settings)
    np.testing.assert_array_equal(run_lockstep(replace(recording, x0=x0), settings).mean, expected.mean)


@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dekf_ci"])
def test_nobody_heard_is_everybody_alone(recording: StudyInput, kind: EstimatorKind) -> None:
    # GIVEN a fleet of which no packet arrives, and the same without edges (the ranges are measured all the same)
    settings = EstimatorSettings(kind=kind)
    deaf = replace(recording, received=np.zeros_like(recording.received))
    loners = replace(recording, edges=np.zeros((0, 2), np.int64))
    np.testing.assert_array_equal(run_lockstep(deaf, settings).mean, run_lockstep(loners, settings).mean)


@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dmhe"])
def test_late_packets_within_the_window_are_used(recording: StudyInput, kind: EstimatorKind) -> None:
    # GIVEN neighbours' packets that all come a tick late, or not at all
    late = replace(recording, delay_ticks=np.ones_like(recording.delay_ticks))
    lost = replace(recording, received=np.zeros_like(recording.received))
    settings = EstimatorSettings(kind=kind, window=3)
    assert recording.truth is not None
    truth = recording.truth.reshape(13, 1, 18)

    def error(which: StudyInput) -> float:
        return float(np.linalg.norm(run_lockstep(which, settings).mean - truth, axis=-1)[6:].mean())

    # THEN the late rows help
    assert error(late) < 0.7 * error(lost)


def test_packets_later_than_the_window_are_counted(recording: StudyInput) -> None:
    # GIVEN delays beyond N = 2 on every link of the line: each packet holds 4 GPS rows and the sender's ranges
    late = replace(recording, delay_ticks=np.full_like(recording.delay_ticks, 4))
    result = run_lockstep(late, EstimatorSettings(window=2))
    # THEN what arrives within the flight (sent at 0..8) is dropped, all of it: 5 rows from an end, 6 from the middle
    assert result.dropped.tolist() == [9 * 6, 9 * 10, 9 * 6]


def test_sharing_inputs_helps() -> None:
    # GIVEN a flight beyond its transient
    recording = StudyScenario(samples=45).record(5, 0)
    assert recording.truth is not None
    truth = recording.truth.reshape(46, 1, 18)

    def error(share: str) -> float:
        settings = EstimatorSettings(kind="dekf_ci", share_inputs=share)  # type: ignore[arg-type]
        return float(np.linalg.norm(run_lockstep(recording, settings).mean - truth, axis=-1)[35:].mean())

    # THEN who knows the neighbours' accelerations knows the fleet better (0.107 against 0.185 over many runs)
    assert error("neighbours") < 0.8 * error("none")
