"""Samples through the real codec and back: nothing but the fields' own resolution is lost."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim_bridge.autopilot import mavlink_wire as wire
from sim_bridge.world.sensors import GpsFix, SensedAttitude, SensedImu

accel = st.lists(st.floats(-80.0, 80.0), min_size=3, max_size=3).map(np.array)
gyro = st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3).map(np.array)
mag = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)
imus = st.builds(SensedImu, st.just(0.0), accel, gyro, mag, st.floats(300.0, 1100.0), st.floats(-100.0, 5000.0))
fixes = st.builds(
    GpsFix,
    time_s=st.just(0.0),
    valid=st.just(True),
    lat_deg=st.floats(-90.0, 90.0),
    lon_deg=st.floats(-180.0, 180.0),
    alt_msl_m=st.floats(-400.0, 9000.0),
    alt_ellipsoid_m=st.floats(-400.0, 9000.0),
    speed_mps=st.floats(0.0, 600.0),
    course_rad=st.floats(0.0, 2.0 * math.pi),
    h_acc_m=st.floats(0.01, 100.0),
    v_acc_m=st.floats(0.01, 100.0),
    speed_acc_mps=st.floats(0.01, 50.0),
    hdop=st.floats(0.3, 99.0),
    vdop=st.floats(0.3, 99.0),
)


def through_the_codec(message: Any) -> Any:
    sender, receiver = mavlink.MAVLink(None, 7, 1), mavlink.MAVLink(None)
    parsed = receiver.parse_buffer(message.pack(sender))
    assert len(parsed) == 1
    assert (parsed[0].get_srcSystem(), parsed[0].get_srcComponent()) == (7, 1)
    return parsed[0]


@settings(max_examples=60, deadline=None)
@given(imu=imus, time_us=st.integers(0, 2**50))
def test_highres_imu(imu, time_us):
    got = through_the_codec(wire.highres_imu(time_us, imu))
    assert got.time_usec == time_us
    np.testing.assert_allclose((got.xacc, got.yacc, got.zacc), imu.accel_mps2, rtol=1e-6, atol=1e-30)
    np.testing.assert_allclose((got.xgyro, got.ygyro, got.zgyro), imu.gyro_rps, rtol=1e-6, atol=1e-30)
    np.testing.assert_allclose((got.xmag, got.ymag, got.zmag), imu.mag_gauss, rtol=1e-6, atol=1e-30)
    assert got.fields_updated & 0x3F == 0x3F


@settings(max_examples=60, deadline=None)
@given(imu=imus)
def test_raw_imu_is_in_milli_g_and_milliradians(imu):
    got = through_the_codec(wire.raw_imu(5, imu))
    for value, true in zip((got.xacc, got.yacc, got.zacc), imu.accel_mps2, strict=True):
        assert value * 9.80665e-3 == pytest.approx(true, abs=0.5 * 9.80665e-3 + 1e-9)
    for value, true in zip((got.xgyro, got.ygyro, got.zgyro), imu.gyro_rps, strict=True):
        assert value * 1e-3 == pytest.approx(true, abs=0.5e-3 + 1e-9)


def test_integer_fields_saturate_instead_of_wrapping():
    imu = SensedImu(0.0, np.full(3, 500.0), np.full(3, -90.0), np.zeros(3), 1000.0, 0.0)
    got = through_the_codec(wire.scaled_imu2(5, imu))
    assert (got.xacc, got.xgyro) == (32767, -32768)


@settings(max_examples=100, deadline=None)
@given(fix=fixes)
def test_gps_raw_int(fix):
    got = through_the_codec(wire.gps_raw_int(123, fix))
    assert got.fix_type == 3
    assert got.lat * 1e-7 == pytest.approx(fix.lat_deg, abs=0.51e-7)
    assert got.lon * 1e-7 == pytest.approx(fix.lon_deg, abs=0.51e-7)
    assert got.alt * 1e-3 == pytest.approx(fix.alt_msl_m, abs=0.51e-3)
    assert got.alt_ellipsoid * 1e-3 == pytest.approx(fix.alt_ellipsoid_m, abs=0.51e-3)
    assert got.vel * 1e-2 == pytest.approx(fix.speed_mps, abs=0.51e-2)
    # 360.00 deg is not in the field's range: it saturates one centidegree below
    assert math.radians(got.cog * 1e-2) == pytest.approx(fix.course_rad, abs=math.radians(0.011))
    assert got.eph == round(100 * fix.hdop)
    assert got.h_acc * 1e-3 == pytest.approx(fix.h_acc_m, abs=0.51e-3)
    assert got.vel_acc * 1e-3 == pytest.approx(fix.speed_acc_mps, abs=0.51e-3)


def test_a_receiver_without_solution_says_unknown():
    got = through_the_codec(wire.gps_raw_int_lost(9, wire.FIX_NO_GPS))
    assert (got.fix_type, got.eph, got.epv, got.vel, got.cog) == (0, 65535, 65535, 65535, 65535)
    assert (got.satellites_visible, got.h_acc) == (255, 0)


def test_attitude_quaternion_and_euler_agree():
    half = math.radians(15.0)
    attitude = SensedAttitude(0.0, np.array([math.cos(half), 0.0, 0.0, math.sin(half)]), np.array([0.1, 0.2, 0.3]))
    quaternion = through_the_codec(wire.attitude_quaternion(77, attitude))
    euler = through_the_codec(wire.attitude_euler(77, attitude))
    assert quaternion.time_boot_ms == euler.time_boot_ms == 77
    assert (quaternion.q1, quaternion.q4) == pytest.approx((math.cos(half), math.sin(half)))
    assert (euler.roll, euler.pitch, euler.yaw) == pytest.approx((0.0, 0.0, math.radians(30.0)))
    assert (euler.rollspeed, quaternion.yawspeed) == pytest.approx((0.1, 0.3))


def test_long_status_texts_are_cut_to_one_chunk():
    got = through_the_codec(wire.statustext(mavlink.MAV_SEVERITY_CRITICAL, "x" * 80))
    assert len(got.text) == 50
