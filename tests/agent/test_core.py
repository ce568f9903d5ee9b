"""The agent core in virtual time: alone, in a fleet, under loss, faults, gaps and wrong clocks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.core import AgentCore
from agent.outputs import EstimateReady, Tell
from agent.sensing.samples import (
    AttitudeSample,
    BaroSample,
    FlowSample,
    GroundSample,
    ImuSample,
    RangeSample,
    VelocitySample,
)
from estimators.estimator import Status
from estimators.model.measurements import Kind
from tests.support.circling_fleet import CirclingFleet
from tests.support.notebook_estimator import MakeConfig, Notebook, fix, lone, received, tick_through
from tests.support.onboard import CONNECTED, onboard_of
from transport.messages.information_body import Information
from transport.messages.measurement_body import Measurements, PositionMeasurement

# --- one core ----------------------------------------------------------------------------------------------


def test_each_tick_is_begun_mixed_and_solved_once_in_order(make_config: MakeConfig) -> None:
    core, made = lone(make_config, "estimator.rounds=2")
    outputs = tick_through(core, 100.0, 1.0)
    calls = [call[:2] for call in made[0].calls]
    expected = [[("begin", tick), ("mix", 0), ("mix", 1)] for tick in range(1000, 1009)]
    assert calls == [call for tick in expected for call in tick]
    sent = [type(o.message).__name__ for o in outputs if isinstance(o, Tell)]
    assert sent[:5] == ["Measurements", "Measurements", "Information", "Information", "FleetEstimate"]
    ready = [o for o in outputs if isinstance(o, EstimateReady)]
    assert [r.estimate.tick for r in ready] == list(range(1000, 1009))
    assert all(r.on_time for r in ready)
    assert ready[0].t_s == pytest.approx(100.0)


def test_rows_of_a_tick_come_with_it_and_its_input_with_the_next(make_config: MakeConfig) -> None:
    core, made = lone(make_config)
    core.advance(100.0, CONNECTED)
    core.on_gps(fix(100.13), 100.18)
    core.on_gps(fix(100.17), 100.18)
    tick_through(core, 100.18, 0.4)
    first, second, third, fourth, *_ = (call for call in made[0].calls if call[0] == "begin")
    assert (first[1], len(first[2])) == (1000, 0)
    assert (second[1], second[2]["tick"].tolist(), second[3]["tick"].tolist()) == (1001, [1001] * 4, [1000])
    assert second[2]["offset_s"] == pytest.approx(0.03)
    assert (third[1], third[2]["tick"].tolist(), third[3]["tick"].tolist()) == (1002, [1002] * 4, [1001])
    assert third[2]["offset_s"] == pytest.approx(-0.03)  # it is nearer to the start of the next tick
    assert (fourth[1], len(fourth[2])) == (1003, 0)


def heights_counted(core: AgentCore, sensor: str) -> None:
    """Each sample is counted once: used, or why not."""
    counted = {name: count for name, count in core.counters.items() if name.startswith(f"{sensor}: ")}
    assert counted.pop(f"{sensor}: samples") == sum(counted.values())


def test_a_barometers_heights_become_rows_where_the_estimator_has_slow_errors(make_config: MakeConfig) -> None:
    for slow, expected in (("true", 4), ("false", 0)):
        core, made = lone(make_config, f"estimator.systematic_errors={slow}")
        tick_through(core, 100.0, 0.5)
        for k in range(20):
            core.on_sample(BaroSample(100.5 + 0.1 * k, 440.0 + k), 100.5 + 0.1 * k)
            tick_through(core, 100.5 + 0.1 * k, 0.1)
        begun = [call[2] for call in made[0].calls if call[0] == "begin"]
        heights = np.concatenate([rows[rows["kind"] == Kind.HEIGHT] for rows in begun])
        assert len(heights) == expected
        assert (heights["x"] == 1.0).all()
        if expected:  # from where the estimate had the drone they go up with the barometer
            assert np.diff(heights["value"]) == pytest.approx(-5.0)
        heights_counted(core, "baro")
    core, _ = lone(make_config, "estimator.systematic_errors=true", "sensors.barometer=false")
    core.advance(100.0, CONNECTED)
    core.on_sample(BaroSample(100.0, 440.0), 100.0)
    core.on_sample(BaroSample(10.0, 440.0), 100.0)
    assert (core.counters["baro: switched off"], core.counters["baro: wrong time"]) == (1, 1)
    heights_counted(core, "baro")


def test_a_range_finders_heights_become_rows_where_the_ground_is_known(make_config: MakeConfig) -> None:
    for settings, expected in ((("sensors.ground_m=2.0",), 3), ((), 0)):
        core, made = lone(make_config, *settings)
        core.advance(100.0, CONNECTED)
        core.on_sample(GroundSample(100.0, 10.0, 0.1), 100.0)
        for k in range(3):
            core.on_sample(AttitudeSample(100.1 + 0.1 * k, (1.0, 0.0, 0.0, 0.0)), 100.1 + 0.1 * k)
            core.on_sample(GroundSample(100.1 + 0.1 * k, 10.0 + k, 0.2), 100.1 + 0.1 * k)
        tick_through(core, 100.4, 0.3)
        begun = [call[2] for call in made[0].calls if call[0] == "begin"]
        heights = np.concatenate([rows[rows["kind"] == Kind.HEIGHT] for rows in begun])
        assert heights["value"] == pytest.approx([-12.0, -13.0, -14.0][:expected])
        assert heights["x"].tolist() == [0.0] * expected
        assert core.counters["ground: used"] == expected
        heights_counted(core, "ground")


def test_velocities_of_other_sensors_become_rows_by_the_attitude_of_their_instant(make_config: MakeConfig) -> None:
    for settings, expected in (((), 1), (("sensors.odometry=false",), 0)):
        core, made = lone(make_config, *settings)
        tick_through(core, 100.0, 0.4)
        heading_east = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
        core.on_sample(VelocitySample(100.41, (1.5, 0.0, 0.0), (0.2, 0.2, 0.3), in_body=True), 100.42)
        core.on_sample(VelocitySample(90.0, (1.5, 0.0, 0.0), (0.2, 0.2, 0.3), in_body=True), 100.42)
        core.on_sample(AttitudeSample(100.62, heading_east), 100.62)
        core.on_sample(VelocitySample(100.62, (1.5, 0.1, 0.0), (0.2, 0.2, 0.3), in_body=True), 100.63)
        core.on_sample(VelocitySample(100.65, (1.5, 0.0, 0.0), (0.2, 0.2, 0.3), in_body=True), 100.66)
        tick_through(core, 100.42, 0.5)
        begun = [call[2] for call in made[0].calls if call[0] == "begin"]
        rows = np.concatenate([rows[rows["kind"] == Kind.ODOMETRY] for rows in begun])
        assert rows["value"] == pytest.approx([-0.1, 1.5, 0.0][: 3 * expected], abs=1e-6)
        assert rows["tick"].tolist() == [1006] * 3 * expected
        assert core.counters["odometry: used"] == expected
        assert core.counters["odometry: wrong time"] == 1
        if expected:
            assert core.counters["odometry: attitude unknown"] == 1
            assert core.counters["odometry: more than are needed"] == 1
        heights_counted(core, "odometry")


def test_flow_is_used_where_somebody_knows_how_far_the_ground_is(make_config: MakeConfig) -> None:
    core, made = lone(make_config)
    core.advance(100.0, CONNECTED)
    level = (1.0, 0.0, 0.0, 0.0)
    for k, told_m in enumerate((None, 5.0, None)):
        t_s = 100.1 + 0.3 * k
        if k == 2:
            core.on_sample(GroundSample(t_s - 0.1, 8.0, 0.1), t_s)
        core.on_sample(AttitudeSample(t_s, level), t_s)
        core.on_sample(FlowSample(t_s, (0.2, -0.1), 0.05, told_m), t_s)
        tick_through(core, t_s, 0.3)
    begun = [call[2] for call in made[0].calls if call[0] == "begin"]
    rows = np.concatenate([rows[rows["kind"] == Kind.ODOMETRY] for rows in begun])
    assert rows["value"] == pytest.approx([1.0, -0.5, 1.6, -0.8], abs=1e-6)
    assert core.counters["flow: height unknown"] == 1
    assert core.counters["flow: used"] == 2
    heights_counted(core, "flow")


def test_a_fix_that_comes_late_keeps_its_place(make_config: MakeConfig) -> None:
    core, made = lone(make_config)
    tick_through(core, 100.0, 0.5)
    core.on_gps(fix(100.22), 100.5)
    tick_through(core, 100.5, 0.2)
    begun = {call[1]: call[2] for call in made[0].calls if call[0] == "begin"}
    assert begun[1004]["tick"].tolist() == [1002] * 4


def test_the_next_due_time_is_when_something_happens(make_config: MakeConfig) -> None:
    core, _ = lone(make_config, count=2)
    assert core.next_due_s() is None
    assert core.advance(100.05, CONNECTED) == []
    due_s = core.next_due_s()
    assert due_s == pytest.approx(100.11)
    assert core.advance(due_s - 1e-6, CONNECTED) == []
    assert isinstance(next(iter(core.advance(due_s, CONNECTED))), Tell)


def test_samples_of_wrong_times_are_counted_and_unused(make_config: MakeConfig) -> None:
    core, made = lone(make_config)
    core.advance(100.0, CONNECTED)
    core.on_gps(fix(90.0), 100.01)
    core.on_gps(fix(102.0), 100.01)
    core.on_gps(fix(float("nan")), 100.01)
    core.on_imu(ImuSample(1e9, (0, 0, -9.8), (0, 0, 0)), 100.01)
    core.on_range(RangeSample(100.0, 7, 1, 3.0, 0.1), 100.01)
    tick_through(core, 100.01, 0.2)
    assert len(made[0].calls[0][2]) == 0
    assert (core.counters["gps: wrong time"], core.counters["imu: wrong time"]) == (3, 1)
    assert core.counters["range: not ours"] == 1


def test_after_a_long_sleep_the_ticks_between_are_left_out(make_config: MakeConfig) -> None:
    core, made = lone(make_config)
    tick_through(core, 100.0, 0.5)
    outputs = tick_through(core, 200.0, 0.3)
    ticks = [o.estimate.tick for o in outputs if isinstance(o, EstimateReady)]
    assert ticks == [2000, 2001]
    assert len(made) == 2
    assert core.counters["ticks: left out"] == 1000 + 1000 - 1004


def test_a_short_stall_is_made_up_tick_by_tick_and_reported_late(make_config: MakeConfig) -> None:
    core, made = lone(make_config)
    tick_through(core, 100.0, 0.5)
    outputs = core.advance(102.0, CONNECTED)
    ready = [o for o in outputs if isinstance(o, EstimateReady)]
    assert [r.estimate.tick for r in ready] == list(range(1004, 1019))
    assert [r.on_time for r in ready] == [False] * 14 + [True]
    assert core.counters["ticks: late"] == 14
    assert len(made) == 1


def test_before_any_position_the_estimate_says_no_data(make_config: MakeConfig) -> None:
    core = onboard_of(make_config(2), Notebook).core
    ready = [o for o in tick_through(core, 100.0, 20.0) if isinstance(o, EstimateReady)]
    assert {r.estimate.status for r in ready} == {Status.NO_DATA}
    assert (ready[0].estimate.covariance.diagonal() >= 1e8).all()
    assert str(core.health.health).startswith("init: waiting for fixes")


# --- packets -----------------------------------------------------------------------------------------------


def information(
    tick: int, round_: int = 0, agents: tuple[int, ...] = (1, 2), state_tick: int | None = None
) -> Information:
    n = 6 * len(agents)
    return Information(tick, round_, tick if state_tick is None else state_tick, 6, agents, np.eye(n), np.zeros(n))


def test_measurements_are_waited_for_until_they_come_or_their_time_is_over(make_config: MakeConfig) -> None:
    core, made = lone(make_config, count=2)
    core.advance(100.0, CONNECTED)
    core.on_packet(received(2, Measurements(999, ())), 100.01)
    core.advance(100.112, CONNECTED)
    assert made == []  # neighbour 2 is heard, its tick 1000 is not there yet
    record = PositionMeasurement(2, 1000, (1, 2, 3), (1, 1, 1))
    core.on_packet(received(2, Measurements(1000, (record,))), 100.113)
    [second] = core.advance(100.113, CONNECTED)
    assert isinstance(second, Tell)  # the first exchange is complete
    assert second.message.exchange == 1
    assert made == []
    core.on_packet(received(2, Measurements(1000, (record,), 1)), 100.114)
    core.advance(100.114, CONNECTED)
    assert made[0].calls[0][2]["agent"].tolist() == [1, 1, 1]
    core.advance(100.2, CONNECTED)
    core.advance(100.225, CONNECTED)
    assert len(made[0].calls) == 2
    assert core.advance(100.231, CONNECTED) != []  # exchange deadline: 0.3 of the period after the end


def exchanges(outputs: list[Any]) -> list[int]:
    """Of the packets of records."""
    return [o.message.exchange for o in outputs if isinstance(o, Tell) and isinstance(o.message, Measurements)]


def finely(core: AgentCore, start_s: float, duration_s: float) -> list[Any]:
    """As `tick_through`, in steps of a millisecond."""
    return [o for step in range(round(duration_s / 1e-3)) for o in core.advance(start_s + 1e-3 * step, CONNECTED)]


def test_what_a_neighbour_lacks_of_earlier_ticks_is_told_in_further_packets(make_config: MakeConfig) -> None:
    # GIVEN a neighbour that is heard and never says that it has our records
    core, _ = lone(make_config, count=2)
    core.advance(100.0, CONNECTED)
    core.on_packet(received(2, Measurements(999, (), 1)), 100.01)
    first = finely(core, 100.0, 0.2)
    # THEN the first tick has two packets, and the next one as many as there may be
    assert exchanges(first) == [0, 1]
    core.on_packet(received(2, Measurements(1001, (), 1)), 100.2)
    assert exchanges(finely(core, 100.2, 0.1)) == [0, 1, 2, 3]
    # WHEN it says that it has them all, THEN two are enough again
    own = [r for o in first if isinstance(o, Tell) and isinstance(o.message, Measurements) for r in o.message.records]
    core.on_packet(received(2, Measurements(1002, tuple(own), 1)), 100.3)
    latest = core.records.packet(1002, 0, frozenset({2})).records
    core.on_packet(received(2, Measurements(1002, latest, 1)), 100.301)
    assert exchanges(finely(core, 100.305, 0.1)) == [0, 1]


def test_with_one_exchange_there_is_one_packet_a_tick(make_config: MakeConfig) -> None:
    core, _ = lone(make_config, "transport.exchanges=1", count=2)
    core.advance(100.0, CONNECTED)
    core.on_packet(received(2, Measurements(999, ())), 100.01)
    assert exchanges(tick_through(core, 100.0, 0.45)) == [0] * 4


def test_a_neighbour_that_left_is_not_waited_for(make_config: MakeConfig) -> None:
    core, made = lone(make_config, count=2)
    core.advance(100.0, CONNECTED)
    core.on_packet(received(2, Measurements(999, ())), 100.01)
    core.advance(100.115, CONNECTED)
    core.on_gone(2)
    core.advance(100.116, CONNECTED)
    assert made[0].calls[-1][:2] == ("mix", 0)


def test_information_is_mixed_by_slot_in_its_round_and_late_counted(make_config: MakeConfig) -> None:
    core, made = lone(make_config, count=2)
    core.advance(100.0, CONNECTED)
    core.on_packet(received(2, information(999)), 100.0)
    core.on_packet(received(2, Measurements(1000, (), 1)), 100.1)
    core.on_packet(received(2, information(1000)), 100.11)
    core.advance(100.115, CONNECTED)
    assert made[0].calls[-1] == ("mix", 0, (1,))
    core.on_packet(received(2, information(1000)), 100.12)
    assert core.counters["information: late"] >= 1


def test_information_about_another_window_is_left_out(make_config: MakeConfig) -> None:
    core, made = lone(make_config, count=2)
    core.advance(100.0, CONNECTED)
    core.on_packet(received(2, information(1000, state_tick=998)), 100.1)
    core.on_packet(received(2, Measurements(1000, (), 1)), 100.1)
    core.advance(100.115, CONNECTED)
    assert made[0].calls[-1] == ("mix", 0, ())
    assert core.counters["information: other window"] == 1


@pytest.mark.parametrize("agents", [(2, 1), (2,), (2, 3), (3, 2, 1)])
def test_information_about_other_members_is_mapped_and_used_once(
    make_config: MakeConfig, agents: tuple[int, ...]
) -> None:
    # GIVEN a neighbour that sees another fleet than we do, WHEN its pair comes twice
    core, made = lone(make_config, "estimator.kind=dmhe_shared", count=2)
    core.advance(100.0, CONNECTED)
    for _ in range(2):
        core.on_packet(received(2, information(1000, agents=agents)), 100.1)
    core.on_packet(received(2, Measurements(1000, (), 1)), 100.1)
    core.advance(100.115, CONNECTED)
    # THEN the estimator gets it once, in its own layout
    assert made[0].calls[-1] == ("mix", 0, (1,))
    assert made[0].mixed[1].information.shape == (12, 12)
    assert made[0].mixed[1].information[6:, 6:] == pytest.approx(np.eye(6))
    assert core.counters["information: other members"] == 1
    assert core.counters["information: duplicate"] == 1


def test_strangers_are_not_listened_to(make_config: MakeConfig) -> None:
    core, _ = lone(make_config, "fleet.edges=[[1,2]]", count=3)
    core.on_packet(received(3, Measurements(1000, ())), 100.0)
    assert core.counters["packet: not a neighbour"] == 1


def test_a_neighbour_with_a_wrong_clock_harms_nobody(make_config: MakeConfig) -> None:
    core, made = lone(make_config, count=2)
    core.advance(100.0, CONNECTED)
    for k in range(30):
        now_s = 100.0 + 0.01 * k
        wrong = 5000 + k
        core.on_packet(
            received(2, Measurements(wrong, (PositionMeasurement(2, wrong, (1, 2, 3), (1, 1, 1)),))), now_s
        )
        core.on_packet(received(2, information(wrong)), now_s)
        core.advance(now_s, CONNECTED)
    assert core.records.refused["heard: of the future"] == 30
    assert core.counters["information: wild"] == 30
    assert [call[1] for call in made[0].calls if call[0] == "begin"] == [1000, 1001]
    assert len(made[0].calls[0][2]) == 0


# --- fleets ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["dekf_ci", "dmhe_pre_ekf", "consensus_mhe"])
def test_a_fleet_finds_itself_and_stays_on_time(make_config: MakeConfig, kind: str) -> None:
    fleet = CirclingFleet(make_config(3, f"estimator.kind={kind}"))
    fleet.run(8)
    for agent_id in fleet.config.ids:
        ready = fleet.estimates[agent_id]
        assert [r.estimate.tick for r in ready] == list(range(10_000, 10_000 + len(ready)))
        assert len(ready) >= 78
        assert all(r.on_time for r in ready)
        assert all(np.isfinite(r.estimate.covariance).all() for r in ready)
        assert fleet.own_error_m(agent_id, skip=30).mean() < 0.25
        assert fleet.health[agent_id][-1] == "ok"
        assert fleet.cores[agent_id].counters["estimator faults"] == 0


@pytest.mark.parametrize("kind", ["dekf_ci", "dmhe_pre_ekf", "dmhe", "consensus_mhe"])
def test_ticks_without_any_measurement_are_no_fault(make_config: MakeConfig, kind: str) -> None:
    core = onboard_of(make_config(2, f"estimator.kind={kind}", "initial.position_m=[1.0, 2.0, -3.0]")).core
    ready = [o for o in tick_through(core, 100.0, 2.0) if isinstance(o, EstimateReady)]
    assert core.counters["estimator faults"] == 0
    assert all(np.isfinite(r.estimate.mean).all() for r in ready)
    sigma = [r.estimate.covariance[0, 0] for r in ready]
    assert sigma == sorted(sigma)


def test_the_same_run_twice_is_bit_equal(make_config: MakeConfig) -> None:
    runs = []
    for _ in range(2):
        fleet = CirclingFleet(make_config(3))
        fleet.run(3)
        runs.append([r.estimate for i in fleet.config.ids for r in fleet.estimates[i]])
    for first, second in zip(*runs, strict=True):
        assert first.tick == second.tick
        assert np.array_equal(first.mean, second.mean)
        assert np.array_equal(first.covariance, second.covariance)


def test_a_drone_without_gps_lives_on_its_neighbours(make_config: MakeConfig) -> None:
    fleet = CirclingFleet(make_config(4), blind=lambda agent_id, t_s: agent_id == 4 and t_s > 1004)
    fleet.run(12)
    assert fleet.own_error_m(4)[60:].max() < 1.5
    assert "no GPS" in fleet.health[4][-1]
    assert fleet.health[1][-1] == "ok"


def test_a_drone_that_never_had_gps_says_so_until_its_ranges_leave_one_place(
    make_config: MakeConfig
) -> None:
    config = make_config(5, "estimator.kind=dmhe_shared", "estimator.window=4")
    fleet = CirclingFleet(config, blind=lambda agent_id, t_s: agent_id == 5)
    fleet.run(9)
    statuses = [r.estimate.status for r in fleet.estimates[5]]
    assert statuses[0] is Status.NO_DATA
    assert 15 <= statuses.count(Status.NO_DATA) <= 25
    assert Status.NOT_OBSERVABLE in statuses
    located = len(statuses) - next(k for k, s in enumerate(reversed(statuses)) if s is Status.NOT_OBSERVABLE)
    assert located < 60
    assert set(statuses[located:]) == {Status.OK}
    assert fleet.own_error_m(5)[located + 5 :].max() < 1.0
    assert fleet.health[5][-1] == "degraded: no GPS"


def test_a_dead_neighbour_costs_no_tick_and_is_taken_back(make_config: MakeConfig) -> None:
    fleet = CirclingFleet(make_config(3))
    fleet.run(4)
    fleet.kill(2)
    fleet.run(4)
    assert "not heard: 2" in fleet.health[1][-1]
    fleet.start(2)
    fleet.run(4)
    for survivor in (1, 3):
        ready = fleet.estimates[survivor]
        assert [r.estimate.tick for r in ready] == list(range(10_000, 10_000 + len(ready)))
        assert all(r.on_time for r in ready)
        assert fleet.health[survivor][-1] == "ok"
        assert fleet.own_error_m(survivor, skip=30).max() < 1.0
    assert fleet.own_error_m(2)[-10:].max() < 0.5


def test_lost_packets_are_repaired_by_those_after_them(make_config: MakeConfig) -> None:
    def flown(*overrides: str) -> CirclingFleet:
        """Half of all packets are lost, the same ones however many there are."""
        rng = np.random.default_rng(3)
        config = make_config(3, "estimator.kind=dmhe_pre_ekf", "estimator.window=4", *overrides)
        fleet = CirclingFleet(config, cut=lambda *_: rng.random() < 0.5)
        fleet.run(8)
        return fleet

    def others_sigma_m(fleet: CirclingFleet) -> float:
        """How sure the agents are of each other's places."""
        spreads = []
        for slot, agent_id in enumerate(fleet.config.ids):
            for ready in fleet.estimates[agent_id][30:]:
                variances = ready.estimate.covariance.diagonal().reshape(-1, 6)[:, :3]
                spreads.append(np.delete(variances, slot, axis=0).sum())
        return float(np.sqrt(np.mean(spreads)))

    repaired = flown()
    for agent_id in repaired.config.ids:
        assert all(r.on_time for r in repaired.estimates[agent_id])
        assert repaired.own_error_m(agent_id, skip=30).mean() < 0.3
    single = flown("transport.exchanges=1", "transport.history_ticks=1")
    assert others_sigma_m(repaired) < 0.9 * others_sigma_m(single)


def test_a_partition_is_survived_and_healed(make_config: MakeConfig) -> None:
    fleet = CirclingFleet(make_config(3), cut=lambda s, r, t_s: 1003 < t_s < 1007 and 1 in (s, r))
    fleet.run(6.5)
    assert "not heard: 2, 3" in fleet.health[1][-1]
    fleet.run(3.5)
    assert fleet.health[1][-1] == "ok"
    for agent_id in fleet.config.ids:
        assert all(r.on_time for r in fleet.estimates[agent_id])
        assert fleet.own_error_m(agent_id, skip=30).mean() < 0.3


def test_packets_later_than_their_tick_are_still_used(make_config: MakeConfig) -> None:
    config = make_config(3, "estimator.kind=dmhe_pre_ekf", "estimator.window=4")
    fleet = CirclingFleet(config, delay_s=0.12)
    fleet.run(6)
    for agent_id, core in fleet.cores.items():
        assert core.counters["measurements: late"] > 40
        assert core.counters["information: late"] > 40
        assert core.records.refused["heard: too old"] == 0
        assert all(r.on_time for r in fleet.estimates[agent_id])
        ages = fleet.estimates[agent_id][-1].estimate.age_ticks
        assert 1 <= ages.max() <= 3
