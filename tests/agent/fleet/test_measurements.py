"""Samples to records to rows, and the store that hands them out once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.tables import FleetConfig, SensorsTable
from agent.fleet.lever_arms import Shift
from agent.fleet.measurement_store import KEEP_TICKS, MeasurementStore
from agent.fleet.measurements import (
    acceleration_measurement,
    anchor_measurement,
    gps_measurements,
    height_measurement,
    inputs_of,
    range_measurement,
    rows_of,
    sighting_measurement,
)
from agent.sensing.barometer import SIGMA_M
from agent.sensing.detections import DetectionSample
from agent.sensing.samples import BaroSample, GpsSample, RangeSample
from agent.sensing.timeline import TickInput
from estimators.integrity.observability import row_jacobian
from estimators.model import measurements
from estimators.model.measurements import Kind
from tests.agent.conftest import fleet_config
from tests.support.holding import held
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    AnchorRangeMeasurement,
    GroundHeightMeasurement,
    HeightMeasurement,
    Measurement,
    PositionMeasurement,
    RangeMeasurement,
    SpeedMeasurement,
    VelocityMeasurement,
    as_sent,
)

SLOTS = {1: 0, 2: 1, 3: 2}


def fix(**changed: Any) -> GpsSample:
    fields: dict[str, Any] = {
        "t_s": 10.03, "position_m": (1.0, 2.0, -3.0), "horizontal_sigma_m": 0.5, "vertical_sigma_m": 0.8,
        "ground_velocity_mps": (3.0, 4.0), "speed_mps": None, "speed_sigma_mps": 0.2, "fix_type": 3,
    }  # fmt: skip
    return GpsSample(**{**fields, **changed})


def test_a_fix_becomes_rows_at_its_own_instant_with_the_receivers_accuracy() -> None:
    records = gps_measurements(2, fix(), 0.1, SensorsTable())
    rows = rows_of(records, SLOTS)
    assert rows["tick"].tolist() == [100] * 5
    assert rows["offset_s"] == pytest.approx([0.03] * 5)
    assert rows["agent"].tolist() == [1] * 5
    assert rows["kind"].tolist() == [Kind.POSITION] * 3 + [Kind.VELOCITY] * 2
    assert rows["value"] == pytest.approx([1, 2, -3, 3, 4])
    assert rows["variance"] == pytest.approx([0.25, 0.25, 0.64, 0.04, 0.04])
    assert np.isinf(rows["half_width"]).all()


def test_the_variance_of_wandering_fixes_is_raised_by_its_factor() -> None:
    rows = rows_of(gps_measurements(2, fix(), 0.1, SensorsTable(gps_variance_factor=20.0))[:1], SLOTS)
    assert rows["variance"] == pytest.approx([5.0, 5.0, 12.8])


def test_a_height_becomes_a_row_down_at_its_own_instant() -> None:
    record = height_measurement(2, BaroSample(10.03, 12.5), 0.1)
    (row,) = rows_of([record], SLOTS)
    assert (row["tick"], row["offset_s"]) == (100, pytest.approx(0.03))
    assert (row["kind"], row["agent"], row["other"], row["value"], row["x"]) == (Kind.HEIGHT, 1, -1, -12.5, 1.0)
    assert row["variance"] == pytest.approx(SIGMA_M**2)
    (level,) = rows_of([GroundHeightMeasurement(2, 100, -12.5, 0.01)], SLOTS)
    assert (level["kind"], level["x"]) == (Kind.HEIGHT, 0.0)


@pytest.mark.parametrize(("known", "taken"), [("true", 2), ("false", 1)])
def test_heights_that_drift_are_not_for_an_estimator_without_slow_errors(known: str, taken: int) -> None:
    store = MeasurementStore(fleet_config(2, f"estimator.systematic_errors={known}"), 1)
    store.neighbourhood.hear(2, 100)
    heights = [HeightMeasurement(2, 100, -12.5, 0.1), GroundHeightMeasurement(2, 100, -12.5, 0.1)]
    assert len(store.add_heard(2, heights, 100)) == taken
    assert store.refused["heard: not used"] == 2 - taken


SEEN = DetectionSample(10.03, 3, "ned", (0.6, 0.0, 0.8), 0.02, 50.0, 2.0)


@given(st.integers(0, 999))
def test_a_detection_becomes_rows_that_hold_where_the_target_is(seed: int) -> None:
    # GIVEN a drone that sees a target, both in motion
    rng = np.random.default_rng(seed)
    state = rng.normal(size=18) * 20.0
    offset_s = 0.03
    now = [state[6 * s : 6 * s + 3] + offset_s * state[6 * s + 3 : 6 * s + 6] for s in (1, 2)]
    away = now[1] - now[0]
    distance_m = float(np.linalg.norm(away))
    direction = tuple((away / distance_m).tolist())
    sample = replace(SEEN, direction=direction, distance_m=distance_m)
    # THEN the rows of its record are met exactly at that state, along the sight and across it, as sure as was said
    rows = rows_of([sighting_measurement(2, sample, direction, 0.0, 0.1)], SLOTS)
    predicted, _ = row_jacobian(rows, state, 1e-3)
    np.testing.assert_allclose(predicted, rows["value"], atol=1e-9 * (1.0 + distance_m))
    assert rows["kind"].tolist() == [Kind.RELATIVE] * 3
    assert rows["variance"] == pytest.approx([4.0, (0.02 * distance_m) ** 2, (0.02 * distance_m) ** 2])
    axes = np.stack([rows["x"], rows["y"], rows["z"]], axis=1)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert rows["agent"].tolist() == [1] * 3
    assert rows["other"].tolist() == [2] * 3


def test_of_a_bearing_only_what_is_across_it_becomes_rows() -> None:
    sample = replace(SEEN, distance_m=None, distance_sigma_m=None)
    record = sighting_measurement(2, sample, sample.direction, 80.0, 0.1)
    assert record.is_bearing
    rows = rows_of([as_sent(record)], SLOTS)
    assert rows["value"].tolist() == [0.0, 0.0]
    assert rows["variance"] == pytest.approx([(0.02 * 80.0) ** 2] * 2, rel=5e-3)
    axes = np.stack([rows["x"], rows["y"], rows["z"]], axis=1)
    np.testing.assert_allclose(axes @ sample.direction, 0.0, atol=1e-6)


def test_configured_half_widths_set_variance_and_bound() -> None:
    sensors = SensorsTable(gps_position_half_width_m=0.15, gps_speed_half_width_mps=0.08, uwb_bound_m=0.1)
    records = gps_measurements(1, fix(ground_velocity_mps=None, speed_mps=5.0), 0.1, sensors)
    rows = rows_of(records, SLOTS)
    assert rows["kind"].tolist() == [Kind.POSITION] * 3 + [Kind.SPEED]
    assert rows["variance"] == pytest.approx([0.0075] * 3 + [0.08**2 / 3])
    assert rows["half_width"] == pytest.approx([0.15] * 3 + [0.08])
    ranged = rows_of([range_measurement(RangeSample(10.07, 1, 3, 12.5, 0.3), 0.1, sensors)], SLOTS)
    assert ranged["variance"] == pytest.approx([0.01 / 3])
    assert (ranged["agent"][0], ranged["other"][0], ranged["value"][0]) == (0, 2, 12.5)
    assert (ranged["tick"][0], ranged["offset_s"][0]) == (101, pytest.approx(-0.03))


def test_a_flat_fix_says_nothing_of_the_height() -> None:
    rows = rows_of(gps_measurements(1, fix(fix_type=2), 0.1, SensorsTable(gps_min_fix=2))[:1], SLOTS)
    assert rows["z"].tolist() == [0, 0]


def test_anchors_and_accelerations_keep_their_numbers() -> None:
    anchored = rows_of([AnchorRangeMeasurement(3, 7, (1, 2, 3), 9.0, 0.04)], SLOTS)
    assert (anchored["kind"][0], anchored["x"][0], anchored["agent"][0]) == (Kind.ANCHOR_RANGE, 1.0, 2)
    closed = TickInput(7, (0.1, 0.2, 0.3), (0.01, 0.01, 0.01), 1.0, 10)
    table = inputs_of([acceleration_measurement(2, closed)], SLOTS)
    assert table["accel"].tolist() == [[0.1, 0.2, 0.3]]
    assert (table["tick"][0], table["agent"][0]) == (7, 1)
    with pytest.raises(TypeError, match="not a measurement"):
        rows_of([acceleration_measurement(2, closed)], SLOTS)


def test_a_range_to_an_anchor_is_one_of_the_body_to_the_anchor_less_the_arm() -> None:
    # GIVEN an antenna 0.3 m north of the body, whose range to an anchor is exact
    arm, body, anchor = Shift((0.3, 0.0, 0.0), 0.01), np.array((1.0, 2.0, -3.0)), (10.0, -4.0, 0.0)
    range_m = float(np.linalg.norm(body + arm.arm_m - anchor))
    record = anchor_measurement(RangeSample(10.02, 2, 201, range_m, 0.1), anchor, arm, 0.1, SensorsTable())
    # THEN the row says the distance of the body from where the record has the anchor, less sure by the arm's variance
    row = rows_of([record], SLOTS)[0]
    assert np.linalg.norm(body - [row["x"], row["y"], row["z"]]) == pytest.approx(row["value"], abs=1e-6)
    assert (row["kind"], row["agent"], row["other"]) == (Kind.ANCHOR_RANGE, 1, -1)
    assert row["variance"] == pytest.approx(0.02)
    assert row["offset_s"] == pytest.approx(0.02)


def test_no_row_is_surer_than_a_sensor_can_be_whatever_its_record_claims() -> None:
    records = [
        PositionMeasurement(1, 3, (1.0, 2.0, -3.0), (4e-15, 0.04, 1e-5)),
        RangeMeasurement(1, 3, 2, 8.0, 1e-9),
        SpeedMeasurement(1, 3, 2.0, 1e-9),
    ]
    variances = rows_of(records, {1: 0, 2: 1})["variance"]
    assert variances == pytest.approx([1e-4, 0.04, 1e-4, 1e-4, 1e-4])


def test_rows_are_those_of_the_estimators_builders() -> None:
    bounds = (0.5, 0.6, math.inf)
    records: list[Measurement] = [
        PositionMeasurement(2, 7, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), bounds, 0.01),
        VelocityMeasurement(3, 8, (4.0, 5.0, 6.0), (0.4, 0.5, 0.6), bounds, -0.01),
        SpeedMeasurement(1, 9, 7.0, 0.7, 0.8, 0.02),
        RangeMeasurement(1, 10, 3, 8.0, 0.8, 0.9, 0.03),
        AnchorRangeMeasurement(3, 11, (1.0, 2.0, 3.0), 9.0, 0.9, 1.0, 0.04),
    ]
    built = [
        measurements.position_rows(7, 1, (1, 2, 3), (0.1, 0.2, 0.3), offset_s=0.01, half_width_m=bounds),
        measurements.velocity_rows(8, 2, (4, 5, 6), (0.4, 0.5, 0.6), offset_s=-0.01, half_width_mps=bounds),
        measurements.speed_row(9, 0, 7.0, 0.7, offset_s=0.02, half_width_mps=0.8),
        measurements.range_row(10, 0, 2, 8.0, 0.8, offset_s=0.03, half_width_m=0.9),
        measurements.anchor_range_row(11, 2, (1, 2, 3), 9.0, 0.9, offset_s=0.04, half_width_m=1.0),
    ]
    assert rows_of(records, SLOTS).tolist() == np.concatenate(built).tolist()
    assert rows_of([], SLOTS).dtype == measurements.ROW
    pushes = inputs_of([AccelerationMeasurement(3, 7, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3))], SLOTS)
    built_pushes = measurements.input_rows(7, 2, (1, 2, 3), (0.1, 0.2, 0.3))
    for name in measurements.INPUT.names or ():
        assert pushes[name].tolist() == built_pushes[name].tolist()
    assert inputs_of([], SLOTS).dtype == measurements.INPUT


def position(observer: int, tick: int, north_m: float = 1.0, offset_s: float = 0.0) -> PositionMeasurement:
    return PositionMeasurement(observer, tick, (north_m, 0.0, 0.0), (0.1, 0.1, 0.1), offset_s=offset_s)


def acceleration(observer: int, tick: int) -> AccelerationMeasurement:
    return AccelerationMeasurement(observer, tick, (1.0, 0.0, 0.0), (0.1, 0.1, 0.1))


def line(make_config: Callable[..., FleetConfig], count: int = 4, *overrides: str) -> FleetConfig:
    edges = [[i, i + 1] for i in range(1, count)]
    return make_config(count, f"fleet.edges={edges}", *overrides)


IDS = (1, 2, 3)
"""All agents of a small fleet, located."""


def test_each_record_is_handed_out_once_and_inputs_only_when_they_have_acted(
    make_config: Callable[..., FleetConfig],
) -> None:
    store = MeasurementStore(make_config(), 1)
    store.neighbourhood.hear(2, 5)
    for _ in range(3):
        store.add_own(position(1, 5))
        store.add_heard(2, [position(2, 5)], 5)
        store.add_heard(2, [acceleration(2, 5)], 5)
        store.add_heard(2, [position(2, 6)], 5)
    rows, inputs = store.take(5, IDS, IDS)
    assert (sorted(rows["agent"].tolist()), len(inputs)) == ([0, 0, 0, 1, 1, 1], 0)
    rows, inputs = store.take(6, IDS, IDS)
    assert (rows["tick"].tolist(), inputs["tick"].tolist()) == ([6] * 3, [5])
    assert len(store.take(7, IDS, IDS)[0]) == 0
    store.add_heard(2, [position(2, 5)], 7)
    assert len(store.take(8, IDS, IDS)[0]) == 0


def test_a_record_is_taken_in_once_however_often_it_comes(make_config: Callable[..., FleetConfig]) -> None:
    # GIVEN all hear all, WHEN packets repeat records among new ones
    store = MeasurementStore(make_config(), 1)
    for other in (2, 3):
        store.neighbourhood.hear(other, 6)
    own = store.add_own(position(1, 6))
    assert own is not None
    assert store.add_heard(2, [position(2, 6), position(2, 5)], 6) == [position(2, 6), position(2, 5)]
    assert store.add_heard(3, [position(2, 6), position(3, 6), own, position(3, 6)], 6) == [position(3, 6)]
    # THEN nothing is used twice
    assert store.take(6, IDS, IDS)[0]["agent"].tolist() == [0] * 3 + [1] * 6 + [2] * 3
    assert not store.refused
    # AND a record long forgotten does not stand in the way of another
    store.forget(200)
    store.neighbourhood.hear(2, 200)
    assert store.add_heard(2, [position(2, 200)], 200)


def test_late_records_keep_their_own_tick(make_config: Callable[..., FleetConfig]) -> None:
    store = MeasurementStore(make_config(), 1)
    store.neighbourhood.hear(2, 20)
    store.take(20, IDS, IDS)
    store.add_heard(2, [position(2, 18, offset_s=0.04)], 20)
    rows, _ = store.take(21, IDS, IDS)
    assert rows["tick"].tolist() == [18] * 3
    assert rows["offset_s"] == pytest.approx([0.04] * 3)


def test_what_is_old_of_the_future_or_our_own_is_refused(make_config: Callable[..., FleetConfig]) -> None:
    store = MeasurementStore(make_config(), 1)
    store.neighbourhood.hear(2, 100)
    assert not store.add_heard(2, [position(2, 100 - 65)], 100)
    assert not store.add_heard(2, [position(2, 103)], 100)
    assert not store.add_heard(2, [position(1, 100)], 100)
    assert store.add_heard(2, [position(2, 102)], 100)
    assert dict(store.refused) == {"heard: too old": 1, "heard: of the future": 1}


def told(store: MeasurementStore, tick: int, *neighbours: int) -> list[tuple[int, int]]:
    """(observer, tick) of what a packet says, in its order."""
    return [(record.observer, record.tick) for record in store.packet(tick, 0, frozenset(neighbours)).records]


def test_while_nobody_is_heard_packets_repeat_the_last_ticks_newest_first(
    make_config: Callable[..., FleetConfig],
) -> None:
    store = MeasurementStore(make_config(3, "transport.history_ticks=3", "estimator.share_inputs=none"), 1)
    for tick in range(10):
        store.add_own(position(1, tick))
        store.add_own(acceleration(1, tick))
    packet = store.packet(8, 1, frozenset())
    assert (packet.tick, packet.exchange) == (8, 1)
    assert [(record.observer, record.tick) for record in packet.records] == [(1, 8), (1, 7), (1, 6)]


def test_a_record_is_told_until_every_neighbour_has_said_it(make_config: Callable[..., FleetConfig]) -> None:
    # GIVEN drone 2 between 1 and 3
    store = MeasurementStore(line(make_config, 3, "estimator.relay_hops=1"), 2)
    store.add_own(position(2, 5))
    store.add_heard(1, [position(1, 5)], 5)
    # THEN its own record goes to both, that of 1 is for 3
    assert told(store, 5, 1, 3) == [(2, 5), (1, 5)]
    assert store.lacked(6, frozenset({1, 3}))
    # WHEN 1 says our record back, THEN it is still told, for 3
    store.add_heard(1, [position(2, 5)], 6)
    assert told(store, 6, 1, 3) == [(2, 5), (1, 5)]
    # WHEN 3 says both, THEN neither is told any more
    store.add_heard(3, [position(2, 5), position(1, 5)], 6)
    assert not store.lacked(7, frozenset({1, 3}))
    assert told(store, 7, 1, 3) == [(1, 5)]  # an echo: 3 knows then that we have it
    assert told(store, 8, 1, 3) == []
    # AND another neighbour that turns up gets all
    assert told(store, 8, 1, 3, 4) == [(2, 5), (1, 5)]
    # AND what comes late, of a tick of which they had everything, is told
    store.add_own(acceleration(2, 5))
    assert store.lacked(7, frozenset({1, 3}))
    assert told(store, 8, 1, 3) == [(2, 5)]


def test_on_a_slow_link_nothing_is_asked_for_before_its_echo_can_be_back(
    make_config: Callable[..., FleetConfig],
) -> None:
    # GIVEN a link over which our record comes back three ticks later
    store = MeasurementStore(line(make_config, 2, "estimator.relay_hops=1"), 1)
    for tick in range(5, 9):
        store.add_own(position(1, tick))
    assert store.lacked(9, frozenset({2}))
    store.add_heard(2, [position(1, 5)], 8)
    # THEN those of the last three ticks are not lacked yet, an older one is
    assert not store.lacked(9, frozenset({2}))
    assert store.lacked(10, frozenset({2}))


def test_what_is_heard_is_said_back_once_behind_what_is_lacked(make_config: Callable[..., FleetConfig]) -> None:
    # GIVEN an end of a line, that relays to nobody
    store = MeasurementStore(line(make_config, 3, "estimator.relay_hops=0"), 1)
    store.add_heard(2, [position(2, 5), position(2, 4)], 5)
    store.add_own(position(1, 5))
    # THEN its packet holds its own record and the echoes, the next one its own alone
    assert told(store, 5, 2) == [(1, 5), (2, 5), (2, 4)]
    assert told(store, 5, 2) == [(1, 5)]
    # AND a record that comes again, since its sender has not heard so, is said again
    store.add_heard(2, [position(2, 5)], 5)
    assert told(store, 5, 2) == [(1, 5), (2, 5)]


@pytest.mark.parametrize(
    ("relay_hops", "share", "positions", "accelerations"),
    [
        (0, "none", [1, 2, 3], [2]),
        (0, "neighbours", [1, 2, 3], [1, 2, 3]),
        (1, "neighbours", [1, 2, 3, 4], [1, 2, 3]),
        (1, "fleet", [1, 2, 3, 4], [1, 2, 3, 4, 5]),
    ],
)
def test_whose_records_are_used_follows_hops_and_sharing(
    make_config: Callable[..., FleetConfig],
    relay_hops: int,
    share: str,
    positions: list[int],
    accelerations: list[int],
) -> None:
    config = line(make_config, 5, f"estimator.relay_hops={relay_hops}", f"estimator.share_inputs={share}")
    hood = MeasurementStore(config, 2).neighbourhood
    assert [hood.hops(i) for i in range(1, 6)] == [1, 0, 1, 2, 3]
    assert [i for i in range(1, 6) if hood.uses(position(i, 1))] == positions
    assert [i for i in range(1, 6) if hood.uses(acceleration(i, 1))] == accelerations
    assert [i for i in range(1, 6) if hood.sends(position(i, 1))] == [
        i for i in range(1, 6) if (hood.hops(i) or 0) <= relay_hops
    ]


def test_our_own_numbers_are_those_that_others_get(make_config: Callable[..., FleetConfig]) -> None:
    store = MeasurementStore(make_config(), 1)
    rounded = store.add_own(position(1, 5, north_m=1 / 3))
    assert isinstance(rounded, PositionMeasurement)
    assert rounded.position_m[0] == float(np.float32(1 / 3))
    assert store.take(5, IDS, IDS)[0]["value"][0] == rounded.position_m[0]
    assert store.add_own(position(1, 6, north_m=1e7)) is None
    assert store.refused["own: out of range"] == 1


@given(st.floats(0, 1e7), st.floats(-1, 1))
def test_tick_and_offset_add_up_to_the_instant(t_s: float, sign: float) -> None:
    record = range_measurement(RangeSample(t_s, 1, 2, 5.0, 0.1), 0.1, SensorsTable())
    assert record.tick * 0.1 + record.offset_s == pytest.approx(t_s, abs=1e-6)
    assert abs(record.offset_s) <= 0.05 + 1e-6


def test_memory_stays_bounded(make_config: Callable[..., FleetConfig]) -> None:
    store = MeasurementStore(make_config(), 1)
    for tick in range(1000):
        store.add_own(position(1, tick))
        store.add_heard(2, [RangeMeasurement(2, tick, 3, 4.0, 0.1)], tick)
        store.add_heard(3, [VelocityMeasurement(3, tick, (0, 0, 0), (0.1, 0.1, math.pi))], tick)
        store.take(tick, IDS, IDS)
    kept = held(store)
    for kind in (PositionMeasurement, RangeMeasurement, VelocityMeasurement):
        assert kept[kind] <= KEEP_TICKS + 2


def test_rows_wait_until_everybody_they_name_is_located_and_slots_are_those_of_the_members(
    make_config: Callable[..., FleetConfig],
) -> None:
    # GIVEN a fix of 3 and ranges 1-3 and 1-2, WHEN 2 is no member and 3 is not located yet
    store = MeasurementStore(make_config(3, "estimator.window=4"), 1)
    store.neighbourhood.hear(3, 10)
    store.add_heard(3, [position(3, 10)], 10)
    store.add_own(RangeMeasurement(1, 10, 3, 4.0, 0.1))
    store.add_own(RangeMeasurement(1, 10, 2, 5.0, 0.1))
    store.add_own(acceleration(1, 9))
    store.add_heard(3, [acceleration(3, 9)], 10)
    rows, inputs = store.take(10, (1,), (1,))
    assert (len(rows), inputs["agent"].tolist()) == (0, [0])
    # THEN what names 3 comes once it is, with its slot, and what names 2 stays
    rows, inputs = store.take(11, (1, 3), (1, 3))
    assert sorted(zip(rows["agent"].tolist(), rows["other"].tolist(), strict=True)) == [(0, 1), *[(1, -1)] * 3]
    assert inputs["agent"].tolist() == [1]
    assert store.take(14, IDS, (1, 3))[0].size == 0
    # AND after a window's length it is let go and counted
    assert store.take(15, IDS, (1, 3))[0].size == 0
    assert store.take(16, IDS, IDS)[0].size == 0
    assert store.refused["not located"] == 1


def test_without_edges_a_neighbour_is_who_was_heard_of_late(make_config: Callable[..., FleetConfig]) -> None:
    hood = MeasurementStore(
        make_config(3, "transport.neighbour_timeout_s=2.0", "estimator.relay_hops=1"), 1
    ).neighbourhood
    assert [hood.hops(i) for i in IDS] == [0, 2, 2]
    hood.hear(2, 100)
    assert [hood.hops(i) for i in IDS] == [0, 1, 2]
    assert hood.sends(position(2, 100))
    assert not hood.sends(position(3, 100))
    hood.hear(3, 121)
    assert [hood.hops(i) for i in IDS] == [0, 2, 1]
