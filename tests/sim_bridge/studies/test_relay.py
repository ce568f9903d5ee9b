"""How records travel in lockstep."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from estimators.settings import EstimatorSettings
from sim_bridge.studies.relay import ACCEL_BYTES, POSITION_BYTES, RANGE_BYTES, SPEED_BYTES, Arrival, MeasurementRelay
from sim_bridge.studies.study_scenario import StudyScenario
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    Measurements,
    PositionMeasurement,
    RangeMeasurement,
    SpeedMeasurement,
    encode_measurements,
)

ONE_HOP = EstimatorSettings()
TWO_HOPS = EstimatorSettings(kind="dmhe_shared", relay_hops=1, rounds=2, window=3)


def line(samples: int = 12):  # type: ignore[no-untyped-def]
    return StudyScenario(samples=samples).record(0, 0)


def test_without_relay_an_agent_gets_its_neighbours_records_of_the_tick() -> None:
    relay = MeasurementRelay(line(), ONE_HOP)
    for tick in range(3):
        end, middle, _ = relay.exchange(tick)
        assert set(end) == {Arrival(0, tick, 0), Arrival(1, tick, 1)}
        assert set(middle) == {Arrival(1, tick, 0), Arrival(0, tick, 1), Arrival(2, tick, 1)}


def test_with_one_relay_hop_and_two_exchanges_everyone_has_everything_in_the_tick() -> None:
    relay = MeasurementRelay(line(), TWO_HOPS)
    end = relay.exchange(0)[0]
    assert set(end) == {Arrival(0, 0, 0), Arrival(1, 0, 1), Arrival(2, 0, 2)}


def test_nothing_arrives_twice() -> None:
    relay = MeasurementRelay(line(), TWO_HOPS)
    seen: list[tuple[int, int]] = []
    for tick in range(8):
        seen += [(each.slot, each.tick) for each in relay.exchange(tick)[0]]
    assert len(seen) == len(set(seen)) == 24


def test_a_later_packet_repairs_a_loss_with_relay_and_not_without() -> None:
    recording = line()
    received = recording.received.copy()
    received[1] = False
    lossy = replace(recording, received=received)
    for settings, repaired in ((ONE_HOP, False), (TWO_HOPS, True)):
        relay = MeasurementRelay(lossy, settings)
        arrivals = [relay.exchange(tick)[0] for tick in range(3)]
        assert {each.slot for each in arrivals[1]} == {0}
        assert (Arrival(1, 1, 1) in arrivals[2]) is repaired


def test_a_late_packet_arrives_when_it_arrives() -> None:
    recording = line()
    relay = MeasurementRelay(replace(recording, delay_ticks=np.full_like(recording.delay_ticks, 2)), ONE_HOP)
    arrivals = [relay.exchange(tick)[0] for tick in range(4)]
    assert [sorted((each.slot, each.tick) for each in one) for one in arrivals] == [
        [(0, 0)],
        [(0, 1)],
        [(0, 2), (1, 0)],
        [(0, 3), (1, 1)],
    ]


def test_a_packet_is_cut_at_its_size_newest_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_bridge.studies.relay.BODY_BYTES", 130)  # one agent's records of one tick, not two
    relay = MeasurementRelay(line(), TWO_HOPS)
    end = relay.exchange(0)[0]
    assert set(end) == {Arrival(0, 0, 0), Arrival(1, 0, 1)}


def test_sizes_are_those_on_the_wire() -> None:
    bound = (0.1, 0.1, 0.1)
    for record, size in (
        (PositionMeasurement(1, 5, (1.0, 2.0, 3.0), bound, bound), POSITION_BYTES),
        (SpeedMeasurement(1, 5, 2.0, 0.1, 0.1), SPEED_BYTES),
        (RangeMeasurement(1, 5, 2, 7.0, 0.1, 0.1), RANGE_BYTES),
        (AccelerationMeasurement(1, 5, (1.0, 2.0, 3.0), bound), ACCEL_BYTES),
    ):
        encoded = encode_measurements(Measurements(5, (record,)))
        # with an instant of its own (offset), as on the wire of a real sensor
        assert math.isclose(len(encoded.body), size, abs_tol=4)
