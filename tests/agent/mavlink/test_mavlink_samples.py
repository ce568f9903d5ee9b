"""Real pymavlink messages of both flavours through the adapter: units, invalid markers, traps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.tables import FleetConfig, SensorsTable
from agent.mavlink.codec import Decoder, Encoder, mavlink
from agent.mavlink.sample_adapter import SampleAdapter
from agent.sensing.frames import FleetFrame, rotated
from agent.sensing.samples import AttitudeSample, AutopilotEstimate, BaroSample, GpsSample, GroundSample, ImuSample

FRAME = FleetFrame(47.0, 8.0, 400.0, msl=True)
EPOCH_UNIX_S = 1_767_225_600.0
ARRIVAL_S = 500.0
BOOT_OFFSET_S = 400.0


def adapter(ardupilot: bool = False, **sensors: Any) -> SampleAdapter:
    made = SampleAdapter(FRAME, SensorsTable(**sensors), EPOCH_UNIX_S, lambda boot_s, _: boot_s + BOOT_OFFSET_S)
    made.flavour = "ardupilot" if ardupilot else "px4"
    return made


def through_the_wire(message: Any) -> Any:
    return Decoder(datagrams=True).feed(Encoder(1, 1).encode(message))[0]


def convert(made: SampleAdapter, message: Any, arrival_s: float = ARRIVAL_S) -> Any:
    return made.convert(through_the_wire(message), arrival_s)


def highres(time_usec: int = 99_990_000, fields: int = 0x1FFF, number: int = 0, x: float = 0.5) -> Any:
    return mavlink.MAVLink_highres_imu_message(
        time_usec, x, -0.25, -9.75, 0.1, -0.2, 0.3, 0.2, 0, 0.4, 950, 0, 500, 35, fields, number
    )


def raw_imu(time_usec: int = 99_990_000) -> Any:
    return mavlink.MAVLink_raw_imu_message(time_usec, 100, -50, -1000, 10, -20, 30, 0, 0, 0, 0, 0)


def gps(**changed: Any) -> Any:
    fields: dict[str, Any] = {
        "time_usec": 99_900_000, "fix_type": 3, "lat": 470001000, "lon": 80002000, "alt": 412_500, "eph": 80,
        "epv": 120, "vel": 500, "cog": 9000, "satellites_visible": 14, "alt_ellipsoid": 460_000, "h_acc": 300,
        "v_acc": 500, "vel_acc": 200, "hdg_acc": 0, "yaw": 0,
    }  # fmt: skip
    return mavlink.MAVLink_gps_raw_int_message(**{**fields, **changed})


@pytest.mark.parametrize("force_mps2", [1e30, -1000.5])
def test_what_no_imu_can_measure_is_no_sample(force_mps2: float) -> None:
    made = adapter()
    assert convert(made, highres(x=force_mps2)) is None
    assert made.skipped == {"imu: out of range": 1}
    assert convert(made, highres(x=-999.5)) is not None


def test_highres_imu_is_si_already() -> None:
    sample = convert(adapter(), highres())
    assert isinstance(sample, ImuSample)
    assert sample.t_s == pytest.approx(499.99)
    assert sample.specific_force_mps2 == pytest.approx((0.5, -0.25, -9.75))
    assert sample.gyro_radps == pytest.approx((0.1, -0.2, 0.3))


def test_raw_imu_of_ardupilot_is_in_milli_g_and_millirad() -> None:
    sample = convert(adapter(ardupilot=True), raw_imu())
    assert sample.specific_force_mps2 == pytest.approx((0.980665, -0.4903325, -9.80665))
    assert sample.gyro_radps == pytest.approx((0.01, -0.02, 0.03))


def test_raw_imu_of_others_is_unscaled_and_refused() -> None:
    made = adapter(ardupilot=False)
    assert convert(made, raw_imu()) is None
    assert made.skipped["imu: RAW_IMU unscaled"] == 1


def test_raw_imu_serves_only_while_highres_imu_is_silent() -> None:
    made = adapter(ardupilot=True)
    assert convert(made, highres()) is not None
    assert convert(made, raw_imu()) is None
    assert convert(made, raw_imu(101_000_000), ARRIVAL_S + 1.1) is not None


def pressure(hpa: float = 954.61, second: bool = False, time_boot_ms: int = 99_990) -> Any:
    kind = mavlink.MAVLink_scaled_pressure2_message if second else mavlink.MAVLink_scaled_pressure_message
    return kind(time_boot_ms, hpa, 0.0, 3500)


def test_scaled_pressure_is_in_hectopascals_and_gives_metres_at_its_own_instant() -> None:
    sample = convert(adapter(), pressure())
    assert isinstance(sample, BaroSample)
    assert sample.t_s == pytest.approx(499.99)
    assert sample.altitude_m == pytest.approx(500.0, abs=0.3)


def test_highres_imu_holds_a_barometer_beside_the_imu() -> None:
    made = adapter()
    sample = made.pressure_beside(through_the_wire(highres()), ARRIVAL_S)
    assert isinstance(sample, BaroSample)
    assert (sample.t_s, sample.altitude_m) == (pytest.approx(499.99), pytest.approx(540.3, abs=0.5))
    # of which nothing is new, or that is of another IMU
    assert made.pressure_beside(through_the_wire(highres(fields=0x1FFF & ~0x200)), ARRIVAL_S) is None
    assert made.pressure_beside(through_the_wire(highres(number=1)), ARRIVAL_S) is None
    assert made.pressure_beside(through_the_wire(pressure()), ARRIVAL_S) is None
    assert made.received["baro"] == 1
    # while it comes, the same sensor's own message is the lesser one
    assert convert(made, pressure(), ARRIVAL_S + 0.1) is None
    assert convert(made, pressure(time_boot_ms=101_500), ARRIVAL_S + 1.6) is not None


@pytest.mark.parametrize("hpa", [0.0, math.nan, 99.0, 1300.0])
def test_what_is_no_pressure_of_air_is_no_sample(hpa: float) -> None:
    made = adapter()
    assert convert(made, pressure(hpa)) is None
    assert made.skipped == {"baro: no pressure of air": 1}
    assert convert(made, pressure(second=True)) is not None  # and a second barometer takes its place


def distance(**changed: Any) -> Any:
    fields: dict[str, Any] = {
        "time_boot_ms": 99_990, "min_distance": 20, "max_distance": 4000, "current_distance": 1234, "type": 0,
        "id": 0, "orientation": 25, "covariance": 9,
    }  # fmt: skip
    return mavlink.MAVLink_distance_sensor_message(**{**fields, **changed})


def test_a_range_finder_is_in_centimetres_and_its_variance_in_their_squares() -> None:
    made = adapter()
    sample = convert(made, distance())
    assert sample == GroundSample(pytest.approx(499.99), pytest.approx(12.34), pytest.approx(0.03))
    unknown = [convert(made, distance(covariance=value)) for value in (0, 255)]
    assert [sample.sigma_m for sample in unknown] == pytest.approx([0.3468] * 2)
    assert convert(made, distance(id=1)) is None
    assert made.skipped == {"ground: a better one comes": 1}


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"orientation": 0}, "looks elsewhere"),
        ({"current_distance": 20}, "out of its reach"),
        ({"current_distance": 4000}, "out of its reach"),
        ({"signal_quality": 1}, "out of its reach"),
    ],
)
def test_what_sees_no_ground_is_no_sample(changed: dict[str, int], reason: str) -> None:
    made = adapter()
    assert convert(made, distance(**changed)) is None
    assert made.skipped == {f"ground: {reason}": 1}


def test_second_imus_and_frames_without_new_data_are_left_out() -> None:
    made = adapter()
    assert convert(made, highres(number=1)) is None
    assert convert(made, highres(fields=0x1FC0)) is None
    assert convert(made, highres(x=math.nan)) is None
    assert dict(made.skipped) == {"imu: not the first one": 1, "imu: nothing new": 1, "imu: not finite": 1}


def test_attitude_quaternion_is_preferred_and_its_display_offset_ignored() -> None:
    made = adapter()
    turned = mavlink.MAVLink_attitude_quaternion_message(
        99_990, math.cos(0.5), 0, 0, math.sin(0.5), 0, 0, 0, [0, 1, 0, 0]
    )
    sample = convert(made, turned)
    assert isinstance(sample, AttitudeSample)
    assert rotated(sample.quaternion, (1, 0, 0)) == pytest.approx((math.cos(1), math.sin(1), 0), abs=1e-6)
    euler = mavlink.MAVLink_attitude_message(99_990, 0.0, 0.0, 0.0, 0, 0, 0)
    assert convert(made, euler) is None
    assert isinstance(
        convert(made, mavlink.MAVLink_attitude_message(101_000, 0, 0, 0, 0, 0, 0), 501.1), AttitudeSample
    )
    assert convert(made, mavlink.MAVLink_attitude_quaternion_message(99_990, 0, 0, 0, 0, 0, 0, 0)) is None
    assert made.skipped["attitude: no unit quaternion"] == 1


def test_gps_position_accuracies_and_horizontal_velocity() -> None:
    sample = convert(adapter(), gps())
    assert isinstance(sample, GpsSample)
    assert sample.t_s == pytest.approx(499.9)
    assert sample.position_m == pytest.approx(FRAME.ned(47.0001, 8.0002, 412.5), abs=1e-6)
    assert sample.position_m[2] == pytest.approx(-12.5, abs=0.01)
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == pytest.approx((0.3, 0.5))
    assert sample.ground_velocity_mps == pytest.approx((0.0, 5.0), abs=1e-9)
    assert sample.speed_mps is None
    assert sample.speed_sigma_mps == pytest.approx(0.2)


def test_hdop_times_hundred_is_not_metres_and_zero_accuracy_is_unknown() -> None:
    sample = convert(adapter(), gps(h_acc=0, v_acc=0, vel_acc=0, eph=80, epv=120))
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == pytest.approx((0.8 * 2.5, 1.2 * 2.5))
    assert sample.speed_sigma_mps == pytest.approx(0.3)
    assert convert(adapter(), gps(h_acc=0, eph=20)).horizontal_sigma_m == pytest.approx(0.5 * 2.5)
    assert convert(adapter(), gps(h_acc=1)).horizontal_sigma_m == pytest.approx(0.02)
    made = adapter()
    assert convert(made, gps(h_acc=0, eph=65535)) is None
    assert made.skipped["gps: no accuracy"] == 1


def test_the_configured_meaning_of_speed() -> None:
    norm = convert(adapter(gps_speed="norm"), gps())
    assert (norm.ground_velocity_mps, norm.speed_mps) == (None, 5.0)
    off = convert(adapter(gps_speed="off"), gps())
    assert (off.ground_velocity_mps, off.speed_mps) == (None, None)
    for unknown in ({"vel": 65535}, {"cog": 65535}):
        sample = convert(adapter(), gps(**unknown))
        assert (sample.ground_velocity_mps, sample.speed_mps) == (None, None)


@pytest.mark.parametrize("fix_type", [0, 1, 2, 9])
def test_without_a_fix_there_is_no_sample(fix_type: int) -> None:
    made = adapter()
    assert convert(made, gps(fix_type=fix_type)) is None
    assert made.fix_type == fix_type
    assert made.skipped["gps: no fix"] == 1


def test_a_lost_receiver_of_px4_gives_no_sample() -> None:
    lost = gps(fix_type=0, eph=65535, epv=65535, vel=65535, cog=65535, satellites_visible=255)
    assert convert(adapter(), lost) is None


def test_a_fix_sent_again_is_used_once() -> None:
    made = adapter()
    assert convert(made, gps()) is not None
    assert convert(made, gps()) is None
    assert made.skipped["gps: sent again"] == 1
    assert convert(made, gps(time_usec=100_000_000)) is not None


def repeated(made: SampleAdapter, count: int, **changed: Any) -> list[bool]:
    """Which of so many fixes with rising times and the same content are used."""
    return [convert(made, gps(time_usec=99_000_000 + 100_000 * k, **changed)) is not None for k in range(count)]


def test_a_receiver_that_repeats_itself_though_it_moves_is_not_used() -> None:
    # GIVEN a receiver that says 5 m/s and repeats one fix to the last digit
    made = adapter()
    # THEN from its third time on it is not used, and that is counted
    assert repeated(made, 5) == [True, True, False, False, False]
    assert made.skipped["gps: frozen"] == 3
    assert made.frozen
    # and once it moves on it is
    assert convert(made, gps(time_usec=99_900_000, lat=470001010)) is not None
    assert not made.frozen


@pytest.mark.parametrize("still", [{"vel": 20}, {"vel": 65535}])
def test_a_receiver_at_rest_may_repeat_itself(still: dict[str, int]) -> None:
    made = adapter()
    assert all(repeated(made, 8, **still))
    assert not made.skipped


def test_a_reboot_forgets_what_the_receiver_repeated() -> None:
    made = adapter()
    repeated(made, 3)
    made.reset()
    assert not made.frozen
    assert convert(made, gps(time_usec=99_900_000)) is not None


def test_gps_time_zero_is_arrival_and_unix_time_is_understood() -> None:
    made = adapter()
    assert convert(made, gps(time_usec=0)).t_s == pytest.approx(ARRIVAL_S)
    assert convert(made, gps(time_usec=0)).t_s == pytest.approx(ARRIVAL_S)  # time 0 is no identity
    unix = round((EPOCH_UNIX_S + 499.5) * 1e6)
    assert convert(made, gps(time_usec=unix, lat=470001010)).t_s == pytest.approx(499.5, abs=1e-5)


def test_heights_follow_the_fleets_origin() -> None:
    ellipsoid = FleetFrame(47.0, 8.0, 448.0, msl=False)
    made = SampleAdapter(ellipsoid, SensorsTable(), EPOCH_UNIX_S, lambda boot_s, _: boot_s + BOOT_OFFSET_S)
    assert convert(made, gps()).position_m[2] == pytest.approx(-12.0, abs=0.01)
    assert convert(made, gps(alt_ellipsoid=0, time_usec=1)) is None
    assert made.skipped["gps: no height of the fleet's sort"] == 1


@pytest.mark.parametrize("place", [{"lat": 0, "lon": 0}, {"lat": 900_000_001}, {"lon": -1_800_000_001}])
def test_places_that_do_not_exist_are_refused(place: dict[str, int]) -> None:
    made = adapter()
    assert convert(made, gps(**place)) is None
    assert made.skipped["gps: no position"] == 1


def test_stamps_that_cannot_be_true_are_counted() -> None:
    made = adapter()
    assert convert(made, highres(time_usec=90_000_000)) is None
    assert convert(made, highres(time_usec=101_000_000)) is None
    assert made.skipped["imu: wrong time"] == 2
    blind = SampleAdapter(FRAME, SensorsTable(), EPOCH_UNIX_S, lambda boot_s, _: None)
    assert convert(blind, highres()) is None
    assert blind.skipped["imu: clock unknown"] == 1


def test_the_autopilots_own_position_is_never_a_measurement() -> None:
    made = adapter()
    local = mavlink.MAVLink_local_position_ned_message(99_990, 1, 2, 3, 4, 5, 6)
    assert isinstance(convert(made, local), AutopilotEstimate)
    for message in (
        mavlink.MAVLink_global_position_int_message(99_990, 470000000, 80000000, 1, 2, 3, 4, 5, 6),
        mavlink.MAVLink_vfr_hud_message(1, 2, 3, 4, 5, 6),
    ):
        assert convert(made, message) is None


def gps2(**changed: Any) -> Any:
    fields: dict[str, Any] = {
        "time_usec": 99_900_000, "fix_type": 3, "lat": 470003000, "lon": 80002000, "alt": 412_500, "eph": 80,
        "epv": 120, "vel": 500, "cog": 9000, "satellites_visible": 14, "dgps_numch": 0, "dgps_age": 0, "h_acc": 300,
    }  # fmt: skip
    return mavlink.MAVLink_gps2_raw_message(**{**fields, **changed})


def test_the_second_receiver_serves_while_the_first_has_no_fix() -> None:
    made = adapter()
    assert convert(made, gps()) is not None
    assert convert(made, gps2()) is None
    assert made.skipped == {"gps: not the first one": 1}
    assert convert(made, gps(fix_type=1)) is None
    second = convert(made, gps2(time_usec=99_950_000))
    assert second.receiver == 1
    assert second.position_m[0] == pytest.approx(FRAME.ned(47.0003, 8.0002, 412.5)[0], abs=1e-6)
    assert made.fix_type == 3
    assert convert(made, gps(time_usec=99_960_000)) is not None
    assert convert(made, gps2(time_usec=99_970_000)) is None


def test_there_is_no_fix_when_all_receivers_that_spoke_say_so() -> None:
    made = adapter()
    assert not made.without_fix

    convert(made, gps())
    assert not made.without_fix
    convert(made, gps(fix_type=1))
    assert made.without_fix
    convert(made, gps2())
    assert not made.without_fix
    convert(made, gps2(fix_type=0))
    assert made.without_fix
    made.reset()
    assert not made.without_fix


def test_the_second_receiver_serves_once_the_first_was_silent_for_long() -> None:
    made = adapter()
    served = [
        convert(made, gps2(time_usec=99_900_000 + 200_000 * k, lat=470_003_000 + k), ARRIVAL_S + 0.2 * k)
        for k in range(20)
    ]
    assert [each is not None for each in served].index(True) == 13
    assert all(each is not None for each in served[13:])


def scaled_imu(number: int = 1, boot_ms: int = 99_990) -> Any:
    make = {
        1: mavlink.MAVLink_scaled_imu_message,
        2: mavlink.MAVLink_scaled_imu2_message,
        3: mavlink.MAVLink_scaled_imu3_message,
    }[number]
    return make(boot_ms, 100, -50, -1000 + number, 10, -20, 30, 0, 0, 0)


def test_the_best_imu_that_comes_is_used() -> None:
    """GIVEN the third IMU alone, then the second, the first, and HIGHRES_IMU THEN each takes over at once."""
    made = adapter()
    for message in (scaled_imu(3), scaled_imu(2), scaled_imu(1), highres()):
        assert isinstance(convert(made, message), ImuSample)
    for message in (scaled_imu(1), scaled_imu(2), scaled_imu(3)):
        assert convert(made, message) is None
    assert made.skipped == {"imu: a better one comes": 3}
    late = convert(made, scaled_imu(2, 101_000), ARRIVAL_S + 1.01)
    assert late.specific_force_mps2 == pytest.approx((0.980665, -0.4903325, -998 * 9.80665e-3))


@given(st.floats(1.0, 4000.0), st.integers(0, 3000))
def test_stamps_of_32_bits_are_of_the_turn_that_fits(past_s: float, turn: int) -> None:
    """GIVEN an autopilot up for many turns of its microseconds THEN RAW_IMU's stamp is of the present one."""
    wrap_us = 2**32
    offset_s = ARRIVAL_S - (turn * wrap_us * 1e-6 + past_s)
    made = SampleAdapter(FRAME, SensorsTable(), EPOCH_UNIX_S, lambda boot_s, _: boot_s + offset_s)
    made.flavour = "ardupilot"
    sample = convert(made, raw_imu(round(past_s * 1e6) % wrap_us))
    assert sample.t_s == pytest.approx(ARRIVAL_S - 0.0125, abs=1e-4)


@pytest.mark.parametrize("days", [49.7103, 99.4206, 1000.0])
def test_stamps_in_milliseconds_are_of_the_turn_that_fits(days: float) -> None:
    up_s = days * 86_400.0
    made = SampleAdapter(FRAME, SensorsTable(), EPOCH_UNIX_S, lambda boot_s, _: boot_s + ARRIVAL_S - up_s)
    stamp_ms = round(up_s * 1e3) % 2**32
    attitude = mavlink.MAVLink_attitude_quaternion_message(stamp_ms, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert convert(made, attitude).t_s == pytest.approx(ARRIVAL_S, abs=1e-3)


def test_utc_of_a_receiver_that_missed_a_turn_of_its_week_is_understood() -> None:
    made = adapter()
    stamp_us = round((EPOCH_UNIX_S + 499.9 - 1024 * 604_800) * 1e6)
    assert convert(made, gps(time_usec=stamp_us)).t_s == pytest.approx(499.9, abs=1e-5)
    assert made.noted == {"fixes whose weeks have rolled over": 1}


def test_single_absurd_stamps_of_a_receiver_on_the_boot_clock_are_no_other_clock() -> None:
    made = adapter()
    assert convert(made, gps(time_usec=99_900_000)) is not None
    for years in (3, 11, 40, -20):
        stamp_us = round((EPOCH_UNIX_S + 499.9 + years * 31_557_600.0) * 1e6)
        assert convert(made, gps(time_usec=stamp_us)) is None
    assert made.skipped == {"gps: wrong time": 4}


@given(st.integers(-32768, 32767), st.integers(-32768, 32767), st.integers(-32768, 32767))
def test_raw_imu_scales_every_integer(x: int, y: int, z: int) -> None:
    message = mavlink.MAVLink_raw_imu_message(99_990_000, x, y, z, x, y, z, 0, 0, 0, 0, 0)
    sample = convert(adapter(ardupilot=True), message)
    assert sample.specific_force_mps2 == pytest.approx((x * 9.80665e-3, y * 9.80665e-3, z * 9.80665e-3))
    assert sample.gyro_radps == pytest.approx((x * 1e-3, y * 1e-3, z * 1e-3))


def test_the_frame_comes_from_the_configuration(make_config: Callable[..., FleetConfig]) -> None:
    assert FleetFrame.of(make_config()) == FRAME


AIDED, JUST_LOST, WITHOUT_POSITION = 0b1101111111, 0b0001111111, 0b0001100101
"""Flags of a PX4 in flight: with fixes, at once after the last one, and four seconds later."""


def estimator_status(flags: int, ardupilot: bool) -> Any:
    if ardupilot:
        return mavlink.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.0)
    return mavlink.MAVLink_estimator_status_message(100_000_000, flags, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.3, 0.3)


@pytest.mark.parametrize("ardupilot", [False, True])
@pytest.mark.parametrize(("flags", "aided"), [(AIDED, True), (JUST_LOST, False), (WITHOUT_POSITION, False)])
def test_an_attitude_says_whether_the_autopilot_is_aided_by_positions(
    flags: int, aided: bool, ardupilot: bool
) -> None:
    made = adapter(ardupilot)
    attitude = mavlink.MAVLink_attitude_quaternion_message(99_990, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert convert(made, estimator_status(WITHOUT_POSITION, ardupilot)) is None
    before = convert(made, attitude)  # it has had no position yet: it stands still, and is level
    assert convert(made, estimator_status(AIDED, ardupilot)) is None
    assert convert(made, estimator_status(flags, ardupilot)) is None
    after = convert(made, attitude)

    assert before.aided
    assert after.aided is aided


def test_after_a_reboot_its_last_word_on_that_is_forgotten() -> None:
    made = adapter()
    for flags in (AIDED, WITHOUT_POSITION):
        convert(made, estimator_status(flags, False))
    made.reset()
    attitude = mavlink.MAVLink_attitude_quaternion_message(99_990, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert convert(made, attitude).aided


def test_what_we_gave_the_autopilot_as_a_receiver_is_no_measurement() -> None:
    made = SampleAdapter(
        FRAME, SensorsTable(), EPOCH_UNIX_S, lambda boot_s, _: boot_s + BOOT_OFFSET_S, own_receiver=1
    )

    assert convert(made, gps2()) is None
    assert made.skipped["gps: given by us"] == 1
    assert convert(made, gps()) is not None
