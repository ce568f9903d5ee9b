"""Fleets that change in virtual time: drones join, crash and come back; blind starts; partitions that heal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.config.reading import load_config
from agent.fleet.membership import is_absent
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.integrity.consistency import nees
from estimators.model.layout import Layout, block, states_of
from estimators.model.unknown_motion import silence_sigma_m
from sim_bridge.virtual.fleet_events import FleetEvents, Partition
from sim_bridge.virtual.fleet_lockstep import Fidelity, FleetLockstep, Surroundings
from sim_bridge.world.scenario import Interval

CONFIGS = Path(__file__).parents[3] / "configs"
PAPER_NOISE = (
    "sim.profile=paper",
    "sensors.gps_position_half_width_m=0.15",
    "sensors.gps_speed=norm",
    "sensors.gps_speed_half_width_mps=0.08",
    "sensors.uwb_bound_m=0.1",
    "sensors.accel_sigma_mps2=0.0577",
    "sensors.gps_variance_factor=1.0",
    "sensors.gps_latency_s=0.0",
    "estimator.window=3",
    "estimator.rounds=1",
    "estimator.relay_hops=1",
    "mavlink.imu_hz=50",
    "mavlink.attitude_hz=25",
    "estimator.reciprocal_ranges=independent",
)
"""Of the five-drone mesh: sensors whose errors are what their covariances say.

Consistency (ANEES) is held to both sides: over 3 to 16 seeds a figure below varied within 0.55 to 1.3 (a drone that
went silent), 0.89 to 1.9 (1.5 s after a late join), 0.60 to 1.6 (1 s of one drone), 0.76 to 1.4 (the first seconds).
"""


class Flight:
    """A run with events and its estimates; times are seconds since the start."""

    def __init__(
        self, name: str, duration_s: float, events: FleetEvents, *overrides: str, fidelity: Fidelity = "values"
    ) -> None:
        self.config = load_config(CONFIGS / name, overrides)
        self.estimates: dict[int, list[EstimateReady]] = {agent_id: [] for agent_id in self.config.ids}
        around = Surroundings(events=events)
        run = FleetLockstep(self.config, make_estimator, self._on_estimate, fidelity, around)
        self.report = run.run(duration_s)
        self.layout = Layout(self.config.ids)

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        self.estimates[agent.agent_id].append(ready)

    def between(self, agent_id: int, from_s: float, to_s: float) -> list[EstimateReady]:
        start_s = self.report.start_unix_s - self.config.fleet.epoch_unix_s
        return [ready for ready in self.estimates[agent_id] if from_s <= ready.t_s - start_s < to_s]

    def present(self, ready: EstimateReady) -> tuple[int, ...]:
        absent = is_absent(ready.estimate.age_ticks)
        return tuple(a for a, away in zip(self.config.ids, absent, strict=True) if not away)

    def error(self, ready: EstimateReady) -> np.ndarray:
        unix_s = min(ready.t_s + self.config.fleet.epoch_unix_s, self.report.truth.time_unix_s[-1])
        return np.asarray(ready.estimate.mean - self.report.truth.at(unix_s).ravel())

    def own_error_m(self, agent_id: int, from_s: float, to_s: float) -> np.ndarray:
        own = block(self.layout.slot(agent_id))
        found = self.between(agent_id, from_s, to_s)
        return np.array([np.linalg.norm(self.error(ready)[own][:3]) for ready in found])

    def anees(self, agent_id: int, from_s: float, to_s: float, of: tuple[int, ...] | None = None) -> float:
        """Over those who are present, or over ``of``, per dimension."""
        ratios = []
        for ready in self.between(agent_id, from_s, to_s):
            at = states_of([self.layout.slot(a) for a in (of or self.present(ready))])
            ratios.append(nees(self.error(ready)[at], ready.estimate.covariance[np.ix_(at, at)]) / len(at))
        return float(np.mean(ratios))

    def sigma_m(self, ready: EstimateReady, agent_id: int) -> float:
        own = block(self.layout.slot(agent_id))
        return float(np.sqrt(ready.estimate.covariance.diagonal()[own][:3].min()))


@pytest.mark.parametrize("back_s", [0.9490488, 1.0494905, 1.1000001, 0.9500001])
def test_whoever_is_away_comes_back_at_whatever_instant(back_s: float) -> None:
    # GIVEN instants that a clock with a start of 1000 s cannot show
    flight = Flight("line3.toml", 2.0, FleetEvents(away=(Interval(2, 0.5, back_s),)))
    assert flight.between(2, back_s, 2.0)


# --- join, crash, come back --------------------------------------------------------------------------------

CHANGES = FleetEvents(away=(Interval(3, 0.0, 3.0), Interval(2, 6.0, 12.0)))
SHORT = "fleet.absent_after_s=3.0"


@pytest.fixture(scope="module")
def changing() -> Flight:
    """Mesh of five: drone 3 joins at 3 s, drone 2 crashes at 6 s and comes back at 12 s."""
    return Flight("mesh5.toml", 15.5, CHANGES, *PAPER_NOISE, SHORT)


def test_a_drone_joins_where_it_is_located_and_not_before(changing: Flight) -> None:
    for agent_id in (1, 2, 4, 5):
        before, after = changing.between(agent_id, 2.0, 3.0), changing.between(agent_id, 5.5, 6.0)
        assert {changing.present(ready) for ready in before} == {(1, 2, 4, 5)}
        assert {changing.present(ready) for ready in after} == {(1, 2, 3, 4, 5)}
        assert 0.4 < changing.anees(agent_id, 5.0, 6.0, of=(3,)) < 2.0
    assert changing.own_error_m(3, 5.0, 6.0).max() < 0.3


def test_who_is_silent_is_let_go_after_its_time_and_taken_in_again(changing: Flight) -> None:
    for agent_id in (1, 3, 4, 5):
        assert all(2 in changing.present(ready) for ready in changing.between(agent_id, 6.0, 8.5))
        assert all(2 not in changing.present(ready) for ready in changing.between(agent_id, 9.6, 12.0))
        assert all(2 in changing.present(ready) for ready in changing.between(agent_id, 14.5, 15.5))
        assert changing.report.counters[agent_id]["drones gone"] == 1
    assert changing.own_error_m(2, 14.5, 15.5).max() < 0.3
    assert changing.report.counters[2].get("drones gone", 0) == 0  # that one is new


def test_the_others_do_not_notice(changing: Flight) -> None:
    for agent_id in (1, 4, 5):
        undisturbed = np.sqrt(np.mean(np.square(changing.own_error_m(agent_id, 2.0, 6.0))))
        for from_s, to_s in ((6.0, 9.0), (9.0, 12.0), (12.0, 15.5)):
            assert np.sqrt(np.mean(np.square(changing.own_error_m(agent_id, from_s, to_s)))) < 1.6 * undisturbed
            assert changing.own_error_m(agent_id, from_s, to_s).max() < 0.15
        assert 0.7 < changing.anees(agent_id, 1.5, 15.5) < 1.5
        # nothing is made anew, no tick is lost
        assert changing.report.counters[agent_id]["starts"] == 1
        assert changing.report.counters[agent_id].get("estimator faults", 0) == 0
        assert len(changing.between(agent_id, 0.0, 15.5)) >= 154


def test_the_age_and_the_variance_of_a_silent_drone_grow_as_the_process_noise_says() -> None:
    # GIVEN a drone that is away from 4 s on, its acceleration being simply unknown then
    events = FleetEvents(away=(Interval(3, 4.0, 99.0),))
    flight = Flight("line3.toml", 9.0, events, "estimator.unknown_inputs=zero")
    found, slot = flight.between(2, 4.2, 9.0), flight.layout.slot(3)
    ages = [int(ready.estimate.age_ticks[slot]) for ready in found]
    assert ages == list(range(ages[0], ages[0] + len(ages)))
    period_s = flight.config.fleet.period_s
    variance = flight.config.estimator.other_accel_variance
    for ready, age in zip(found, ages, strict=True):
        # its last word was of the acceleration over the tick after its last fix
        assert flight.sigma_m(ready, 3) > silence_sigma_m((age - 1) * period_s, variance, period_s)
    assert 0.4 < flight.anees(2, 4.2, 9.0) < 1.6


def test_the_change_goes_through_sealed_packets_too() -> None:
    events = FleetEvents(away=(Interval(2, 3.0, 8.0),))
    flight = Flight("line3.toml", 11.0, events, SHORT, fidelity="bytes")
    assert all(2 in flight.present(ready) for ready in flight.between(1, 10.5, 11.0))
    assert flight.own_error_m(2, 10.5, 11.0).max() < 0.5
    for agent_id in (1, 3):
        counters = flight.report.counters[agent_id]
        assert counters["drones gone"] >= 1
        assert not [name for name in counters if name.startswith("rejected")]


def test_neighbours_who_see_other_fleets_still_exchange_pairs() -> None:
    # GIVEN a line in which the ends do not hear each other and news goes one hop a tick, WHEN one end joins late
    events = FleetEvents(away=(Interval(3, 0.0, 4.0),))
    flight = Flight("line3.toml", 8.0, events, "transport.exchanges=1")
    # THEN while the views differ pairs are mapped and used, none is refused for its members
    for agent_id in (1, 2):
        assert flight.report.counters[agent_id]["information: other members"] > 0
        assert {flight.present(ready) for ready in flight.between(agent_id, 6.5, 8.0)} == {(1, 2, 3)}
        assert 0.6 < flight.anees(agent_id, 6.5, 8.0) < 2.0


# --- starts ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("seed", "loss"), [(2, 0.5), (3, 0.0)])
def test_nobody_is_sure_of_a_wrong_place_in_the_first_seconds(seed: int, loss: float) -> None:
    flight = Flight("line3.toml", 6.0, FleetEvents(), f"sim.seed={seed}", f"transport.loss={loss}")
    for agent_id in flight.config.ids:
        known = [r for r in flight.estimates[agent_id] if r.estimate.status is not Status.NO_DATA]
        start_s = known[0].t_s - flight.report.start_unix_s + flight.config.fleet.epoch_unix_s
        assert start_s < 1.6
        assert 0.6 < flight.anees(agent_id, start_s, 6.0) < 1.7  # 614 (seed 2) when unheard drones were put somewhere


def test_a_drone_that_never_has_gps_is_not_observable_until_it_is_located() -> None:
    outage = "sim.gps_outages=[{agent=5, from_s=0.0, to_s=1e6}]"
    flight = Flight("mesh5.toml", 14.0, FleetEvents(), *PAPER_NOISE, outage)
    ready = flight.between(5, 0.0, 14.0)
    statuses = [each.estimate.status for each in ready]
    unsure = [k for k, status in enumerate(statuses) if status is Status.NOT_OBSERVABLE]
    assert 1 <= len(unsure) < 80
    assert statuses[-1] is Status.OK
    # as long as it says ok it is where it says
    own = states_of([flight.layout.slot(5)])
    for each in ready:
        if each.estimate.status is Status.OK:
            error = flight.error(each)[own]
            assert nees(error, each.estimate.covariance[np.ix_(own, own)]) / 6 < 8.0
    assert flight.own_error_m(5, 12.0, 14.0).max() < 0.5
    # on the safe side so early: that a receiver wanders is not ruled out yet
    assert 0.4 < flight.anees(1, 12.0, 14.0) < 2.0


# --- partition ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def parted() -> Flight:
    events = FleetEvents(partitions=(Partition(frozenset({1, 2}), 4.0, 24.0),))
    return Flight("mesh5.toml", 29.0, events, *PAPER_NOISE)


def test_the_islands_of_a_partition_stay_consistent(parted: Flight) -> None:
    for agent_id in parted.config.ids:
        for from_s in range(4, 29, 5):
            # who hears but one other is careful: 0.29 to 0.79 over seeds, all others 0.51 to 1.2
            least = 0.2 if agent_id in (1, 2) and from_s < 24 else 0.5
            assert least < parted.anees(agent_id, from_s, from_s + 5) < 1.6


def test_who_is_on_the_other_side_ages_and_is_let_go_where_ranges_do_not_hold_it(parted: Flight) -> None:
    # ranges go on across the partition: three drones hold each of the other two, two do not hold three
    for agent_id in (1, 2):
        before = parted.between(agent_id, 12.0, 13.5)[-1]
        assert before.estimate.age_ticks[2:].min() >= 80
        assert before.estimate.age_ticks[:2].max() <= 2
        assert {parted.present(ready) for ready in parted.between(agent_id, 14.5, 24.0)} == {(1, 2)}
    for agent_id in (3, 4, 5):
        last = parted.between(agent_id, 22.5, 23.5)[-1]
        assert last.estimate.age_ticks[2:].max() <= 2
        assert all(age >= 180 for age in last.estimate.age_ticks[:2])
    healed = parted.between(1, 28.0, 29.0)[-1]
    assert healed.estimate.age_ticks.max() <= 2


def test_after_healing_they_agree_again_within_five_seconds(parted: Flight) -> None:
    def disagreement_m(agents: tuple[int, ...], from_s: float, to_s: float) -> float:
        """Mean distance of the agents' ideas of where everybody is from their mean idea."""
        means = [[ready.estimate.mean for ready in parted.between(i, from_s, to_s)] for i in agents]
        places = np.array(means).reshape(len(means), len(means[0]), -1, 6)[..., :3]
        return float(np.mean(np.linalg.norm(places - places.mean(axis=0), axis=-1)))

    clean_error = np.mean([parted.own_error_m(i, 2.0, 4.0).mean() for i in parted.config.ids])
    assert disagreement_m((1, 3), 10.0, 13.5) > 0.2
    # GIVEN a clean disagreement of nothing (all windows hold the same), THEN it is small against the error itself
    assert disagreement_m(parted.config.ids, 2.0, 4.0) < 0.1 * clean_error
    assert disagreement_m(parted.config.ids, 27.5, 29.0) < 0.1 * clean_error
