"""Truth: recorded, read back, and interpolated."""

from __future__ import annotations

import numpy as np
import pytest

from sim_bridge.world.scenario import Vehicle
from sim_bridge.world.simulation import Simulation
from sim_bridge.world.truth import TruthError, TruthRecorder, load_truth


@pytest.fixture
def flown(make_scenario):
    vehicles = tuple(Vehicle(agent, system_id=agent) for agent in (4, 2, 9))
    simulation = Simulation(make_scenario(*vehicles, profile="realistic"), 50.0, 1.7e9)
    states = []
    for _ in range(400):
        simulation.advance(simulation.next_step_s())
        states.append(np.hstack((simulation.world.position_m, simulation.world.velocity_mps)))
    return simulation, np.array(states)


def test_truth_survives_the_file(flown, tmp_path):
    simulation, _ = flown
    truth = simulation.truth()
    truth.save(tmp_path / "truth.npz")
    again = load_truth(tmp_path / "truth.npz")
    assert again.agents == (4, 2, 9)
    for name in ("time_unix_s", "position_m", "velocity_mps", "pair_bias_m", "pairs"):
        np.testing.assert_array_equal(getattr(again, name), getattr(truth, name))
    bias = {frozenset(pair): value for pair, value in zip(again.pairs.tolist(), again.pair_bias_m, strict=True)}
    assert bias == simulation.sensors.pair_bias_m


def test_interpolation_agrees_with_the_world_between_the_samples(flown):
    # GIVEN truth sampled at 50 Hz of a world stepped at 200 Hz
    simulation, states = flown
    truth = simulation.truth()
    assert np.diff(truth.time_unix_s) == pytest.approx(0.02, abs=1e-6)
    times = 1.7e9 + 50.0 + 0.005 * np.arange(1, 401)
    got = truth.at(times)
    np.testing.assert_allclose(got[..., :3], states[..., :3], atol=1e-4)
    np.testing.assert_allclose(got[..., 3:], states[..., 3:], atol=0.02)
    # at the samples themselves nothing is interpolated
    np.testing.assert_allclose(got[3::4], states[3::4], atol=1e-6)
    np.testing.assert_array_equal(truth.at(times[7]), got[7])


def test_times_outside_are_refused(flown):
    truth = flown[0].truth()
    for time in (truth.time_unix_s[0] - 0.1, truth.time_unix_s[-1] + 0.1, np.nan):
        with pytest.raises(TruthError, match="expected times in"):
            truth.at(time)


def test_one_sample_is_no_record():
    recorder = TruthRecorder((1,), {})
    recorder.record(0.0, np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises(TruthError, match="at least two samples, found 1"):
        recorder.truth()


def test_files_that_are_none_are_named(tmp_path, flown):
    path = tmp_path / "garbled.npz"
    with pytest.raises(TruthError, match="garbled"):
        load_truth(path)
    path.write_bytes(b"garbage")
    with pytest.raises(TruthError, match="garbled"):
        load_truth(path)
    np.savez(path, time_unix_s=np.zeros(3))
    with pytest.raises(TruthError, match="expected a truth record"):
        load_truth(path)
    truth = flown[0].truth()
    columns = {name: getattr(truth, name) for name in ("time_unix_s", "velocity_mps", "pairs", "pair_bias_m")}
    np.savez(path, agents=np.array(truth.agents), position_m=truth.position_m * np.nan, **columns)
    with pytest.raises(TruthError, match="position_m: expected finite"):
        load_truth(path)
