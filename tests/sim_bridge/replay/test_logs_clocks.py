"""Stamps of recorders, and boot clocks fitted to them."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_bridge.replay.logs.boot_clock import MAX_POINTS, BootClockFit, LogBootClock
from sim_bridge.replay.logs.gps_time import GpsTimeFit, fitted, unix_of_week
from sim_bridge.replay.logs.stamps import StampRepair, without_outliers
from sim_bridge.replay.logs.telemetry.pace import PaceSurvey

S = 1_000_000


def placed(
    stamps_us: list[int], boots_s: list[float | None] | None = None
) -> tuple[list[float | None], Counter[str]]:
    notes: Counter[str] = Counter()
    repair = StampRepair(notes)
    boots = boots_s or [None] * len(stamps_us)
    return [repair.place(stamp, 1, boot) for stamp, boot in zip(stamps_us, boots, strict=True)], notes


def test_steady_stamps_are_taken_as_they_are() -> None:
    times, notes = placed([5 * S, 6 * S, int(6.5 * S)])
    assert times == [0.0, 1.0, 1.5]
    assert not notes


@given(st.lists(st.integers(0, 2**64 - 1), max_size=60))
def test_no_stamps_make_log_time_go_back(stamps_us: list[int]) -> None:
    times, _ = placed(stamps_us)
    believed = [t_s for t_s in times if t_s is not None]
    assert believed == sorted(believed)


def test_a_clock_set_in_flight_does_not_move_log_time() -> None:
    """GIVEN a recorder whose clock is set from 1970 to now WHEN the boot time goes on THEN so does log time."""
    boots: list[float | None] = [100.0 + 0.1 * i for i in range(60)]
    stamps = [i * S // 10 + (1_795_000_000 * S if i >= 30 else 0) for i in range(60)]
    times, notes = placed(stamps, boots)
    assert notes["clock jumps"] == 1
    assert times[30:32] == [None, None]
    assert times[-1] == pytest.approx(5.9)
    notes = Counter()
    repair = StampRepair(notes)
    for stamp, boot in zip(stamps + [stamps[-1]] * 20, [*boots, *[boots[-1]] * 20], strict=True):
        repair.place(stamp, 1, boot)
    assert repair.zero_stamp_s == pytest.approx(1_795_000_000)


def test_a_pause_of_the_recorder_is_time_that_passed() -> None:
    boots: list[float | None] = [0.1 * i + (300.0 if i >= 30 else 0.0) for i in range(60)]
    stamps = [round((100.0 + boot) * S) for boot in boots if boot is not None]
    times, notes = placed(stamps, boots)
    assert None not in times
    assert times[-1] == pytest.approx(305.9)
    assert not notes["clock jumps"]


def test_a_clock_set_back_does_not_stop_log_time() -> None:
    boots: list[float | None] = [0.1 * i for i in range(60)]
    stamps = [i * S // 10 + 3600 * S - (1800 * S if i >= 30 else 0) for i in range(60)]
    times, notes = placed(stamps, boots)
    assert notes["clock jumps"] == 1
    assert times[-1] == pytest.approx(5.9)


@given(st.integers(4, 40), st.data())
def test_one_damaged_stamp_in_five_is_repaired(count: int, data: st.DataObject) -> None:
    stamps = [1_795_000_000 * S + i * 10_000 for i in range(count)]
    damaged = list(stamps)
    for start in range(0, count, 5):
        place = start + data.draw(st.integers(0, 4))
        if 2 <= place < count - 2:
            damaged[place] ^= 1 << data.draw(st.integers(18, 62))
    repaired = list(without_outliers(damaged, int, lambda _, stamp_us: stamp_us, Counter()))
    assert len(repaired) == count
    assert max(abs(a - b) for a, b in zip(repaired, stamps, strict=True)) <= 20_000


def fit(boots_s: list[float], arrivals_s: list[float]) -> tuple[BootClockFit, LogBootClock]:
    made = BootClockFit()
    for boot_s, arrival_s in zip(boots_s, arrivals_s, strict=True):
        made.add(boot_s, arrival_s)
    return made, LogBootClock(made.sessions())


@pytest.mark.parametrize("drift", [0.0, 1e-5, -0.003, 0.017, 0.02])
@pytest.mark.parametrize("jitter_s", [0.003, 0.05])
def test_the_offset_is_found_under_skew_and_jitter(drift: float, jitter_s: float) -> None:
    """GIVEN 100 Hz of messages with exponential lateness THEN the clock is right to a fraction of the jitter."""
    rng = np.random.default_rng(1)
    boots = np.arange(0.0, 60.0, 0.01)
    true = 50.0 + (1.0 + drift) * boots
    arrivals = true + rng.exponential(jitter_s, len(boots))
    _, clock = fit(boots.tolist(), arrivals.tolist())
    errors = np.array([clock.log_s(b, a) for b, a in zip(boots, arrivals, strict=True)]) - true
    assert np.abs(errors).max() < 0.2 * jitter_s
    assert np.median(np.abs(errors)) < 0.05 * jitter_s


def test_a_stall_of_the_clock_is_followed_within_a_second() -> None:
    rng = np.random.default_rng(2)
    boots = np.arange(0.0, 40.0, 0.01)
    true = boots + np.where(boots > 20.0, 0.15, 0.0)
    _, clock = fit(boots.tolist(), (true + rng.exponential(0.002, len(boots))).tolist())
    errors = np.array([clock.log_s(b, b) for b in boots]) - true
    assert np.abs(errors[np.abs(boots - 20.0) > 1.5]).max() < 0.003


def test_single_late_packets_do_not_move_the_clock() -> None:
    boots = np.arange(0.0, 20.0, 0.02)
    late = np.zeros(len(boots))
    late[::97] = 0.185
    _, clock = fit(boots.tolist(), (boots + 7.0 + late).tolist())
    assert clock.log_s(10.0, 17.0) == pytest.approx(17.0, abs=1e-6)


def test_a_reboot_begins_a_new_clock() -> None:
    boots = [100.0 + 0.02 * i for i in range(500)] + [1.0 + 0.02 * i for i in range(500)]
    arrivals = [0.02 * i for i in range(500)] + [25.0 + 0.02 * i for i in range(500)]
    made, clock = fit(boots, arrivals)
    assert made.reboots == 1
    assert clock.log_s(105.0, 5.0) == pytest.approx(5.0, abs=1e-6)
    assert clock.log_s(5.0, 29.0) == pytest.approx(29.0, abs=1e-6)
    assert (clock.session(5.0), clock.session(26.0)) == (0, 1)


def test_overtaken_messages_are_no_reboot() -> None:
    boots = [100.0 + 0.02 * i for i in range(200)]
    arrivals = [0.02 * i for i in range(200)]
    burst = [(boots[-1] - 1.4, arrivals[-1] + 0.001 * i) for i in range(12)]
    made, clock = fit(boots + [b for b, _ in burst] + [104.01], arrivals + [a for _, a in burst] + [4.02])
    assert made.reboots == 0
    assert made.refused == 12
    assert clock.log_s(102.0, 2.0) == pytest.approx(2.0, abs=1e-6)


def test_memory_of_the_fit_is_bounded() -> None:
    made = BootClockFit()
    for i in range(3 * MAX_POINTS):
        made.add(i * 0.5, 10.0 + i * 0.5 + (i % 7) * 1e-3)
    (session,) = made.sessions()
    assert len(session.nodes_s) <= MAX_POINTS
    assert session.log_s(3000.0) == pytest.approx(3010.0, abs=2e-3)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.floats(0, 1e9), st.floats(0, 1e9)), max_size=80))
def test_no_pairs_break_the_fit(pairs: list[tuple[float, float]]) -> None:
    made = BootClockFit()
    for boot_s, arrival_s in sorted(pairs, key=lambda pair: pair[1]):
        made.add(boot_s, arrival_s)
    clock = LogBootClock(made.sessions())
    for boot_s, arrival_s in pairs:
        log_s = clock.log_s(boot_s, arrival_s)
        assert log_s is not None
        assert np.isfinite(log_s)


def test_gps_time_is_found_among_wrong_stamps() -> None:
    times = GpsTimeFit()
    for i in range(500):
        times.add(i * 0.2, 1e9 + i * 0.2 * 1.001 + (3600.0 if i % 20 == 0 else 0.0))
    zero = times.unix_zero()
    assert zero.known_by == "gps"
    assert zero.at(50.0) == pytest.approx(1e9 + 50.05, abs=1e-3)
    assert zero.drift == pytest.approx(1e-3, rel=1e-3)


def test_too_little_gps_time_is_unknown() -> None:
    assert GpsTimeFit().unix_zero().known_by == "unknown"
    assert fitted([(0.0, 5.0)]) is None


def test_gps_week() -> None:
    """2017-10-29 01:46:52 UTC, eighteen leap seconds behind GPS."""
    assert unix_of_week(1973, 6_430_000) == 1_509_241_612.0


@pytest.mark.parametrize(
    ("week", "of_week_s", "unix_s"),
    [
        (1930, 18, 1_483_228_800.0),  # the first second of 2017
        (1929, 604_800 - 1, 1_483_228_800.0 - 18.0),
        (1851, 259_200 + 15, 1_435_708_799.0),  # one second before the leap of July 2015
        (1982, 6_430, 1_514_684_812.0),
    ],
)
def test_the_leap_seconds_are_those_of_the_date(week: int, of_week_s: int, unix_s: float) -> None:
    assert unix_of_week(week, of_week_s * 1000) == unix_s


@pytest.mark.parametrize("turn", [1, 2])
def test_a_week_that_has_rolled_over_is_put_into_the_years_of_autopilots(turn: int) -> None:
    assert unix_of_week(2238 - 1024 * turn, 1000) == unix_of_week(2238, 1000)


@pytest.mark.parametrize("pace", [0.1, 0.3, 0.9, 1.5, 5.0])
def test_the_pace_of_a_simulator_is_found_and_its_clock_taken(pace: float) -> None:
    survey = PaceSurvey()
    for step in range(4000):
        survey.add(100.0 + pace * step * 0.01, step * 0.01)
    found = survey.pace()
    assert found is not None
    assert found.mean == pytest.approx(pace, rel=0.02)
    assert found.log_s(30.0) - found.log_s(10.0) == pytest.approx(20.0 * pace, rel=0.02)


def test_a_simulator_of_changing_pace_that_is_rebooted_keeps_one_clock() -> None:
    survey = PaceSurvey()
    boot_s = 50.0
    for step in range(6000):
        boot_s = 1.0 if step == 3000 else boot_s + 0.01 * (0.2 if step < 2000 else 0.6)
        survey.add(boot_s, step * 0.01)
    found = survey.pace()
    assert found is not None
    logs_s = [found.log_s(0.1 * k) for k in range(600)]
    assert logs_s == sorted(logs_s)
    assert found.log_s(15.0) - found.log_s(5.0) == pytest.approx(2.0, abs=0.1)
    assert found.log_s(55.0) - found.log_s(35.0) == pytest.approx(12.0, abs=0.2)


@pytest.mark.parametrize(("drift", "jitter_s"), [(1e-4, 0.0), (0.03, 0.01), (0.0, 1.0)])
def test_a_vehicle_and_its_radio_are_no_slow_simulator(drift: float, jitter_s: float) -> None:
    survey, rng = PaceSurvey(), np.random.default_rng(3)
    arrivals_s = np.sort(0.05 * np.arange(2000) + rng.uniform(0.0, jitter_s, 2000))
    for step, arrival_s in enumerate(arrivals_s.tolist()):
        survey.add(7.0 + 0.05 * step * (1.0 - drift), arrival_s)
    assert survey.pace() is None
