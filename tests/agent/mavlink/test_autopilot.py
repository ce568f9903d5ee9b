"""The autopilot session in virtual time, against an autopilot that speaks real MAVLink."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from agent.config.tables import FleetConfig
from agent.mavlink.codec import Encoder, mavlink
from agent.mavlink.session import AutopilotSession, LinkState
from agent.mavlink.slow_streams import SlowStreamLog, slow_findings, slow_text
from agent.mavlink.stream_rates import StreamState
from agent.sensing.samples import AttitudeSample, FlowSample, GpsSample, ImuSample, Sample, VelocitySample
from agent.watch.health import State, assess
from estimators.integrity.finding import Finding, Gravity, What
from tests.support.onboard import onboard_of

STEP_S = 0.01
DELAY_S = 0.001
PX4, ARDUPILOT = mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
HIGHRES, RAW, QUATERNION = 105, 27, 31
STATUS = {PX4: 230, ARDUPILOT: 193}
"""ESTIMATOR_STATUS and EKF_STATUS_REPORT."""


@dataclass
class Bench:
    """A session and an autopilot on a wire with a delay of 1 ms each way."""

    session: AutopilotSession
    autopilot: Any
    now_s: float = 100.0
    samples: list[Sample] = field(default_factory=list)
    silent: bool = False
    system_status: int | None = mavlink.MAV_STATE_STANDBY

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / STEP_S)):
            self.now_s += STEP_S
            for frame in self.autopilot.step(self.now_s):
                if not self.silent:
                    self.samples += self.session.receive(frame, self.now_s + DELAY_S)
            for frame in self.session.to_send(self.now_s + DELAY_S, self.system_status):
                self.autopilot.receive(frame, self.now_s + 2 * DELAY_S)
                for answer in self.autopilot.step(self.now_s + 2 * DELAY_S):
                    if not self.silent:
                        self.samples += self.session.receive(answer, self.now_s + 3 * DELAY_S)

    def of(self, kind: type) -> list[Any]:
        return [sample for sample in self.samples if isinstance(sample, kind)]


@pytest.fixture
def bench(make_config: Callable[..., FleetConfig], virtual_autopilot: type[Any]) -> Callable[..., Bench]:
    def make(*overrides: str, offset_s: float = 0.0, **autopilot: Any) -> Bench:
        config = make_config(3, *overrides)
        onboard = onboard_of(config, linked=True, fleet_offset_s=offset_s)
        return Bench(onboard.autopilot, virtual_autopilot(**autopilot))

    return make


@pytest.mark.parametrize("flavour", [PX4, ARDUPILOT])
def test_an_autopilot_is_found_asked_and_understood(bench: Callable[..., Bench], flavour: int) -> None:
    b = bench(autopilot=flavour)
    assert b.session.state is LinkState.SEARCHING
    b.run(10)
    assert b.session.state is LinkState.CONNECTED
    assert b.session.autopilot is not None
    assert b.session.autopilot.flavour == {PX4: "px4", ARDUPILOT: "ardupilot"}[flavour]
    asked = [message_id for message_id, _ in b.autopilot.commands]
    assert asked[:6] == [HIGHRES, QUATERNION, 24, 2, 32, STATUS[flavour]]
    assert {*asked[6:]} <= {32, STATUS[flavour]}  # which this autopilot accepts and does not send
    assert len(b.of(ImuSample)) == pytest.approx(990, abs=15)
    assert len(b.of(AttitudeSample)) == pytest.approx(495, abs=10)
    assert len(b.of(GpsSample)) == pytest.approx(98, abs=5)
    rate = b.session.rates.streams[HIGHRES].rate_hz
    assert rate == pytest.approx(100, rel=0.05)


def test_samples_carry_fleet_time_of_the_boot_stamps(bench: Callable[..., Bench]) -> None:
    b = bench(offset_s=-50.0)
    b.run(5)
    last = b.of(ImuSample)[-1]
    assert last.t_s == pytest.approx(b.now_s - 50.0, abs=2e-3)


def test_our_heartbeat_says_who_and_how_we_are_and_stops_when_at_fault(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(3)
    beats = b.autopilot.received["HEARTBEAT"]
    assert len(beats) == 3
    assert (beats[0].get_srcSystem(), beats[0].get_srcComponent()) == (1, 197)
    assert (beats[0].type, beats[0].autopilot) == (18, 8)
    b.system_status = None
    b.run(3)
    assert len(b.autopilot.received["HEARTBEAT"]) == 3


def test_heartbeats_of_others_are_not_autopilots(bench: Callable[..., Bench]) -> None:
    b = bench()
    for system, component, kind, autopilot in [
        (255, 190, 6, 8),
        (1, 191, 18, 8),
        (1, 154, 26, 3),
        (2, 1, 2, 12),
    ]:
        frame = Encoder(system, component).encode(mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3))
        b.session.receive(frame, 100.0)
    assert b.session.state is LinkState.SEARCHING
    assert b.session.ignored["heartbeat: other system"] == 1
    assert b.session.told == "searching: expected system 1, heard 2"
    b.run(2)
    assert b.session.told == "connected"


def test_of_many_other_systems_a_few_are_named(bench: Callable[..., Bench]) -> None:
    b = bench()
    for system in range(10, 60):
        b.session.receive(Encoder(system, 1).encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)), 100.0)
    assert b.session.ignored["heartbeat: other system"] == 50
    assert b.session.told == "searching: expected system 1, heard 10, 11, 12, 13, 14, 15, 16, 17"


def test_another_flavour_than_configured_is_refused_by_name(bench: Callable[..., Bench]) -> None:
    b = bench("agents.1.autopilot=px4", autopilot=ARDUPILOT)
    b.run(3)
    assert b.session.state is LinkState.SEARCHING
    assert b.session.ignored["heartbeat: ardupilot instead of px4"] == 3


def test_raw_imu_is_asked_for_where_highres_imu_is_refused(bench: Callable[..., Bench]) -> None:
    b = bench(autopilot=ARDUPILOT, refuses=(HIGHRES,))
    b.run(5)
    assert RAW in b.autopilot.rates
    assert b.of(ImuSample)[-1].specific_force_mps2[2] == pytest.approx(-9.80665)
    px4 = bench(refuses=(HIGHRES,))
    px4.run(5)
    assert RAW not in px4.autopilot.rates
    assert mavlink.MAVLINK_MSG_ID_SCALED_IMU in [message_id for message_id, _ in px4.autopilot.commands]


@pytest.mark.parametrize(("barometer", "asked"), [("true", True), ("false", False)])
def test_pressure_is_asked_for_where_highres_imu_does_not_bring_it(
    bench: Callable[..., Bench], barometer: str, asked: bool
) -> None:
    lacking = bench(f"sensors.barometer={barometer}", autopilot=ARDUPILOT, refuses=(HIGHRES,))
    lacking.run(8)
    assert (mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE in dict(lacking.autopilot.commands)) is asked
    having = bench(f"sensors.barometer={barometer}")
    having.run(8)
    assert mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE not in dict(having.autopilot.commands)


def test_requests_without_answer_are_repeated_three_times_and_then_the_next_is_tried(
    bench: Callable[..., Bench],
) -> None:
    b = bench(deaf=True)
    b.run(4)
    asked = [int(command.param1) for command in b.autopilot.received["COMMAND_LONG"]]
    assert asked == [HIGHRES] * 3 + [QUATERNION] * 3 + [24] * 2


def test_a_stream_that_someone_slowed_is_asked_for_again_but_not_at_once(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(5)
    b.autopilot.rates[HIGHRES] = 10.0
    b.run(20)
    asked = [message_id for message_id, _ in b.autopilot.commands]
    assert asked.count(HIGHRES) == 1
    (slow,) = needed(b)
    assert slow_text(slow) == "HIGHRES_IMU at 10 of 100 Hz"
    (finding,) = slow_findings([slow])
    assert assess([finding]).reasons == ("autopilot sends HIGHRES_IMU at 10 of 100 Hz",)
    b.run(10)
    assert [message_id for message_id, _ in b.autopilot.commands].count(HIGHRES) == 2
    assert b.autopilot.rates[HIGHRES] == pytest.approx(100.0)


def needed(b: Bench) -> list[StreamState]:
    """Slow streams that this autopilot could send."""
    return [stream for stream in b.session.slow_streams() if stream.message_id in (HIGHRES, QUATERNION, 24)]


def asked_at(b: Bench, message_id: int, duration_s: float) -> list[float]:
    """How long from now on a message is asked for, within a while."""
    times, begin_s = [], b.now_s

    def asked() -> int:
        return [int(each.param1) for each in b.autopilot.received["COMMAND_LONG"]].count(message_id)

    for _ in range(round(duration_s / 0.1)):
        before = asked()
        b.run(0.1)
        times += [b.now_s - begin_s] * (asked() - before)
    return times


def test_a_stream_that_was_accepted_and_stays_silent_is_asked_for_again_after_2_4_and_8_seconds(
    bench: Callable[..., Bench],
) -> None:
    b = bench(forgets=(QUATERNION,))
    first_s, *again_s = asked_at(b, QUATERNION, 60.0)
    assert [at_s - first_s for at_s in again_s] == pytest.approx([2.0, 6.0, 14.0, 44.0], abs=0.5)
    b.autopilot.forgets = ()
    b.run(32.0)
    assert QUATERNION in b.autopilot.rates
    assert needed(b) == []


def test_a_stream_that_stops_is_asked_for_within_seconds(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(40)
    b.autopilot.rates.pop(QUATERNION)
    assert len(asked_at(b, QUATERNION, 10.0)) == 1
    assert QUATERNION in b.autopilot.rates


def test_a_stream_that_is_refused_is_not_asked_for_soon_and_not_called_slow(bench: Callable[..., Bench]) -> None:
    b = bench(autopilot=ARDUPILOT, refuses=(HIGHRES,))
    assert len(asked_at(b, HIGHRES, 20.0)) == 1
    assert needed(b) == []


def test_an_incomplete_imu_is_told_by_its_slow_stream() -> None:
    gap = Finding(What.IMU_GAP, Gravity.DEGRADED, value=0.5, limit=0.8)
    (slow,) = slow_findings([StreamState(HIGHRES, 100.0, rate_hz=45.0)])
    assert assess([slow]).state is State.OK  # the coverage decides
    assert assess([gap]).reasons == ("IMU incomplete",)
    assert assess([slow, gap]).reasons == ("autopilot sends HIGHRES_IMU at 45 of 100 Hz",)
    assert assess([slow, gap]).state is State.DEGRADED
    (useless,) = slow_findings([StreamState(QUATERNION, 50.0, rate_hz=0.0)])
    assert assess([useless]).state is State.DEGRADED
    assert slow_findings([StreamState(32, 2.0, rate_hz=0.0)]) == ()  # for comparison only


def test_a_slow_stream_is_logged_once_and_one_that_comes_and_goes_once_a_minute() -> None:
    log, slow = SlowStreamLog(), [StreamState(HIGHRES, 100.0, rate_hz=13.2)]
    line = "autopilot sends HIGHRES_IMU at 13.2 of 100 Hz"
    assert log.lines(slow, 0.0) == [line]
    assert log.lines(slow, 100.0) == []
    assert log.lines([], 101.0) == []
    assert log.lines(slow, 102.0) == [line]
    assert log.lines([], 103.0) == []
    assert log.lines(slow, 104.0) == []
    unknown = StreamState(60000, 2.0, rate_hz=0.5)
    assert log.lines([unknown], 105.0) == ["autopilot sends message 60000 at 0.5 of 2 Hz"]


def test_a_lost_autopilot_is_noticed_and_taken_back(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(5)
    b.silent = True
    b.run(1.9)
    assert b.session.state is LinkState.CONNECTED
    b.run(2.2)
    assert b.session.state is LinkState.LOST
    b.silent = False
    asked = len(b.autopilot.commands)
    b.run(2)
    assert b.session.state is LinkState.CONNECTED
    assert len(b.autopilot.commands) > asked  # it may have restarted meanwhile


def test_a_reboot_is_seen_and_times_are_right_again(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(8)
    b.autopilot.boot_s = b.now_s
    b.autopilot.rates = {2: 1.0}
    b.samples.clear()
    b.run(5)
    assert b.session.reboots == 1
    assert b.of(ImuSample)[-1].t_s == pytest.approx(b.now_s, abs=2e-3)
    assert all(abs(sample.t_s - b.now_s) < 6 for sample in b.samples)


def test_a_boot_clock_in_milliseconds_that_begins_anew_is_no_reboot(bench: Callable[..., Bench]) -> None:
    b = bench(boot_s=95.0 - 2**32 * 1e-3)  # its milliseconds wrap at 95 s
    b.now_s = 93.0
    b.run(8)
    assert b.session.reboots == 0
    assert b.of(AttitudeSample)[-1].t_s == pytest.approx(b.now_s, abs=0.03)  # they come every 0.02 s
    assert len(b.of(AttitudeSample)) > 350


@pytest.mark.parametrize("wrong_ms", [0, 2**32 - 1])
def test_a_single_stamp_that_is_wrong_is_no_reboot(bench: Callable[..., Bench], wrong_ms: int) -> None:
    b = bench()
    b.run(3)
    for _ in range(4):
        wrong = mavlink.MAVLink_attitude_quaternion_message(wrong_ms, 1, 0, 0, 0, 0, 0, 0)
        assert b.session.receive(b.autopilot.encoder.encode(wrong), b.now_s) == []
        b.run(1)
    assert b.session.reboots == 0


def component(number: int, kind: int = 2, autopilot: int = ARDUPILOT) -> Callable[..., bytes]:
    """A component of system 1 that says what it is, or sends a message."""
    encoder = Encoder(1, number)
    beat = mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)
    return lambda message=None: encoder.encode(beat if message is None else message)


def test_a_companion_that_says_it_is_the_vehicle_is_not_taken_while_the_autopilot_has_sensors(
    bench: Callable[..., Bench],
) -> None:
    b = bench()
    b.run(3)
    companion = component(191, autopilot=PX4)
    for _ in range(20):
        b.session.receive(companion(), b.now_s)
        b.session.receive(companion(mavlink.MAVLink_attitude_message(5000, 0, 0, 0, 0, 0, 0)), b.now_s)
        b.run(0.5)
    assert b.session.autopilot is not None
    assert b.session.autopilot.component_id == 1
    assert b.session.handovers == 0


def test_a_component_without_sensors_is_given_up_for_one_that_has_some(bench: Callable[..., Bench]) -> None:
    """GIVEN an autopilot under an unusual component id, and a payload that was heard before."""
    b = bench()
    payload, autopilot = component(100), component(7)
    for step in range(200):
        now_s = 100.0 + 0.05 * step
        b.session.receive(payload(), now_s)
        b.session.receive(autopilot(), now_s)
        fix = mavlink.MAVLink_gps_raw_int_message(
            round(5e6 + 5e4 * step), 3, 470_000_000, 80_000_000, 400_000, 80, 120, 0, 0, 12
        )
        b.session.receive(autopilot(fix), now_s)
    assert b.session.autopilot is not None
    assert b.session.autopilot.component_id == 7


def test_timesync_requests_are_answered_with_the_monotonic_clock(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(2)
    frame = b.autopilot.encoder.encode(mavlink.MAVLink_timesync_message(0, 777))
    b.session.receive(frame, 123.456)
    b.run(0.02)
    answers = [m for m in b.autopilot.received["TIMESYNC"] if m.ts1 == 777]
    assert [m.tc1 for m in answers] == [123_456_000_000]


def test_a_second_responder_silences_ours(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(2)
    other = Encoder(1, 191).encode(mavlink.MAVLink_timesync_message(5, 6))
    b.session.receive(other, b.now_s)
    b.session.receive(b.autopilot.encoder.encode(mavlink.MAVLink_timesync_message(0, 777)), b.now_s)
    b.run(0.02)
    assert not [m for m in b.autopilot.received["TIMESYNC"] if m.ts1 == 777]
    assert b.session.ignored["other source"] == 1


def test_without_timesync_answers_the_fallback_serves(bench: Callable[..., Bench]) -> None:
    b = bench(answers_timesync=False)
    b.run(5)
    assert not b.session.clock.synchronised
    assert b.of(ImuSample)[-1].t_s == pytest.approx(b.now_s, abs=5e-3)


def test_messages_of_other_components_are_never_samples(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(2)
    b.samples.clear()
    frame = Encoder(1, 200).encode(mavlink.MAVLink_attitude_quaternion_message(12_000, 1, 0, 0, 0, 0, 0, 0))
    assert b.session.receive(frame, b.now_s) == []


def test_fuzzed_datagrams_are_all_accounted_for_and_change_nothing(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.run(3)
    rng = random.Random(5)
    template = b.autopilot.encoder.encode(mavlink.MAVLink_attitude_quaternion_message(3000, 1, 0, 0, 0, 0, 0, 0))
    before = (b.session.decoder.received, b.session.reboots, b.session.state)
    b.samples.clear()
    for _ in range(20_000):
        data = bytearray(template)
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(len(data))] ^= rng.randint(1, 255)
        b.samples += b.session.receive(bytes(data[: rng.randint(1, len(data))]), b.now_s)
        b.samples += b.session.receive(rng.randbytes(rng.randint(1, 64)), b.now_s)
    accepted = b.session.decoder.received - before[0]
    assert accepted <= 5  # a 16-bit checksum lets one in 65536 through
    assert len(b.samples) <= accepted
    assert b.session.decoder.bad.total() >= 40_000 - accepted
    assert len(b.session.decoder.bad) <= 10
    assert (b.session.reboots, b.session.state) == before[1:]
    b.run(1)
    assert len(b.of(ImuSample)) == pytest.approx(100, abs=2)


def test_frames_of_other_systems_are_not_heard_as_the_autopilot(bench: Callable[..., Bench]) -> None:
    # GIVEN a connected autopilot, WHEN sound frames of another system come on the same link
    b = bench()
    b.run(1)
    heard = b.session.heard
    assert heard > 0
    stranger = Encoder(77, 1)
    b.session.receive(stranger.encode(mavlink.MAVLink_heartbeat_message(2, PX4, 0, 0, 4, 3)), b.now_s)
    b.session.receive(stranger.encode(mavlink.MAVLink_attitude_quaternion_message(1, 1, 0, 0, 0, 0, 0, 0)), b.now_s)
    # THEN the link has no reason to answer them instead
    assert b.session.heard == heard
    b.run(1)
    assert b.session.heard > heard


def test_velocities_are_taken_from_other_components_only(bench: Callable[..., Bench]) -> None:
    # GIVEN the autopilot's own velocity, ours sent back, another vehicle's, and a companion's
    made = bench()
    made.run(2.0)
    before = made.session.heard
    vision = mavlink.MAVLink_vision_speed_estimate_message(0, 1.0, 2.0, 0.0)
    for source in ((1, 1), (1, 197), (2, 191), (1, 191)):
        made.samples += made.session.receive(Encoder(*source).encode(vision), made.now_s)
    velocities = made.of(VelocitySample)
    # THEN the companion's alone is a measurement
    assert [sample.velocity_mps for sample in velocities] == [(1.0, 2.0, 0.0)]
    told = made.session.velocities
    assert told.received["odometry"] == 2
    assert told.skipped == {"odometry: the autopilot's own": 1}
    assert made.session.ignored["own frame"] == 1
    assert made.session.heard == before + 2
    # AND flow is whoever passes it on
    flow = mavlink.MAVLink_optical_flow_rad_message(0, 0, 100_000, 0.0, 0.1, 0.0, 0.0, 0.0, 0, 255, 0, 4.0)
    made.samples += made.session.receive(Encoder(1, 1).encode(flow), made.now_s)
    assert len(made.of(FlowSample)) == 1
