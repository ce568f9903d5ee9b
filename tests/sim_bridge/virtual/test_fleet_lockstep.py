"""A whole fleet in virtual time: the same at every run, true to the wires, and honest about injected faults."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.mavlink.session import PRESSURE_HZ
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.model.layout import Layout, position
from sim_bridge.virtual.fleet_lockstep import Fidelity, FleetLockstep, LockstepReport

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
DURATION_S = 8.0
SETTLED_S = 4.0


class Flight:
    """A run and all its estimates, by agent."""

    def __init__(self, *overrides: str, fidelity: Fidelity = "values", duration_s: float = DURATION_S) -> None:
        self.config: FleetConfig = load_config(LINE3, overrides)
        self.estimates: dict[int, list[EstimateReady]] = {agent_id: [] for agent_id in self.config.ids}
        run = FleetLockstep(self.config, make_estimator, self._on_estimate, fidelity)
        self.report: LockstepReport = run.run(duration_s)

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        self.estimates[agent.agent_id].append(ready)

    def position_rmse_m(self, agent_id: int) -> float:
        """Of the own position after the transient."""
        slot, epoch_s = Layout(self.config.ids).slot(agent_id), self.config.fleet.epoch_unix_s
        errors = []
        for ready in self.estimates[agent_id]:
            unix_s = ready.t_s + epoch_s
            if unix_s >= self.report.start_unix_s + SETTLED_S and ready.estimate.status != Status.NO_DATA:
                truth = self.report.truth.at(min(unix_s, self.report.truth.time_unix_s[-1]))
                errors.append(ready.estimate.mean[position(slot)] - truth[slot, :3])
        return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight()


def test_every_tick_has_its_estimate_in_order_and_on_time(flight: Flight) -> None:
    for estimates in flight.estimates.values():
        ticks = [ready.estimate.tick for ready in estimates]
        assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
        assert len(ticks) == pytest.approx(DURATION_S / flight.config.fleet.period_s, abs=1)
        assert all(ready.on_time for ready in estimates)
        assert estimates[-1].estimate.status == Status.OK


def test_twice_with_one_seed_is_equal_bit_by_bit(flight: Flight) -> None:
    again = Flight()
    for agent_id, estimates in flight.estimates.items():
        for one, other in zip(estimates, again.estimates[agent_id], strict=True):
            assert (one.t_s, one.ready_s) == (other.t_s, other.ready_s)
            assert one.estimate.mean.tobytes() == other.estimate.mean.tobytes()
            assert one.estimate.covariance.tobytes() == other.estimate.covariance.tobytes()
    assert again.report.counters == flight.report.counters


def test_another_seed_is_another_flight(flight: Flight) -> None:
    other = Flight("sim.seed=2", duration_s=2.0)
    assert not np.array_equal(other.report.truth.position_m[0], flight.report.truth.position_m[0])


def test_the_estimates_are_near_the_truth(flight: Flight) -> None:
    # GIVEN fixes good to 0.15 m per axis, THEN each drone knows its place better than one fix tells it
    one_fix_m = 0.15
    assert all(flight.position_rmse_m(agent_id) < one_fix_m for agent_id in flight.config.ids)


def test_values_and_bytes_are_the_same_flight(flight: Flight) -> None:
    # GIVEN the same scenario over MAVLink bytes and sealed packets, THEN only rounding and start-up differ
    wired = Flight(fidelity="bytes")
    assert np.array_equal(wired.report.truth.position_m, flight.report.truth.position_m)
    for agent_id in flight.config.ids:
        assert wired.position_rmse_m(agent_id) == pytest.approx(flight.position_rmse_m(agent_id), rel=0.05)
        counters = wired.report.counters[agent_id]
        assert counters["mavlink rx"] > 100 * DURATION_S
        assert counters["mavlink bad"] == 0
        assert not [name for name in counters if name.startswith("rejected")]


def received(flight: Flight) -> list[int]:
    return [flight.report.counters[agent_id]["packets received"] for agent_id in flight.config.ids]


def test_injected_loss_takes_its_share_and_hurts_nobody_else(flight: Flight) -> None:
    lossy = Flight("transport.loss=0.3", "transport.seed=7")
    for agent_id, got in zip(lossy.config.ids, received(lossy), strict=True):
        lost = lossy.report.counters[agent_id]["injected losses"]
        assert lost / (lost + got) == pytest.approx(0.3, abs=0.1)
        assert lossy.report.counters[agent_id]["ticks: late"] == 0
        assert lossy.position_rmse_m(agent_id) < 2 * flight.position_rmse_m(agent_id)


def test_total_loss_leaves_each_drone_with_itself() -> None:
    alone = Flight("transport.loss=1.0", duration_s=6.0)
    assert received(alone) == [0, 0, 0]
    for agent_id in alone.config.ids:
        assert alone.estimates[agent_id][-1].estimate.status != Status.NO_DATA
        assert alone.position_rmse_m(agent_id) < 1.0  # ranges to drones that it knows nothing of do not help


def test_delayed_packets_are_late_and_still_used() -> None:
    late = Flight("transport.delay_s=0.15")
    for agent_id in late.config.ids:
        counters = late.report.counters[agent_id]
        assert counters["measurements: late"] > 5 * DURATION_S
        assert counters["information: late"] > 5 * DURATION_S
        assert counters["ticks: late"] == 0


def test_progress_counts_the_simulated_seconds() -> None:
    told: list[Any] = []
    config = load_config(LINE3)
    FleetLockstep(config, make_estimator, lambda _agent, _ready: None).run(3.5, told.append)
    assert told == [pytest.approx(1.0), pytest.approx(2.0), pytest.approx(3.0)]


@pytest.mark.parametrize("fidelity", ["values", "bytes"])
def test_barometers_are_flown_with_in_either_fidelity_and_their_samples_add_up(fidelity: Fidelity) -> None:
    flown = Flight('sim.profile="nom"', "estimator.systematic_errors=true", fidelity=fidelity, duration_s=4.0)
    for agent_id, counters in flown.report.counters.items():
        assert counters["baro: used"] == pytest.approx(2 * 4.0, abs=3)
        came = {name: count for name, count in counters.items() if "baro: " in name}
        samples, received = came.pop("baro: samples"), came.pop("baro: received")
        assert sum(came.values()) == received >= samples
        of_imu = flown.config.agent(agent_id).autopilot != "ardupilot"  # PX4 has it beside each of its samples
        assert samples == pytest.approx(4.0 * (flown.config.mavlink.imu_hz if of_imu else PRESSURE_HZ), rel=0.15)
