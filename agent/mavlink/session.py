"""The session with the autopilot, sans-I/O: bytes in with a time, samples and bytes out.

``now_s`` is the host's monotonic clock; samples come out in fleet time, by the fleet clock. TIMESYNC is answered
with the same monotonic clock, so that a step of UTC cannot reach the autopilot's own clock filter.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

from agent.config.tables import FleetConfig
from agent.mavlink.codec import Decoder, Encoder, Message, mavlink
from agent.mavlink.sample_adapter import SampleAdapter
from agent.mavlink.signing import LinkSigning
from agent.mavlink.stream_rates import StreamRates
from agent.mavlink.timesync import BootClock
from agent.sensing.clock import FleetClock
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Sample

HEARTBEAT_PERIOD_S = 1.0
REBOOT_BACKWARDS_S = 1.0
FLAVOURS = {mavlink.MAV_AUTOPILOT_PX4: "px4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot"}
_NOT_VEHICLES = {
    mavlink.MAV_TYPE_GCS,
    mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
    mavlink.MAV_TYPE_GIMBAL,
    mavlink.MAV_TYPE_ADSB,
    mavlink.MAV_TYPE_CAMERA,
    mavlink.MAV_TYPE_ANTENNA_TRACKER,
}
LOCAL_POSITION_HZ = 2.0
"""For comparison only, never a measurement."""


class LinkState(StrEnum):
    """What is known of the autopilot."""

    SEARCHING = "searching"
    """No heartbeat of an autopilot yet."""
    CONNECTED = "connected"
    LOST = "lost"
    """Its heartbeats stopped; it is taken back when they return."""


@dataclass(frozen=True, slots=True)
class AutopilotId:
    """Who the autopilot is: MAVLink ids and ``px4``, ``ardupilot`` or ``other``."""

    system_id: int
    component_id: int
    flavour: str


class AutopilotSession:
    """One autopilot on one link; ``ignored`` counts messages not acted on, by reason.

    With ``signing`` we sign what we send, and what is not well signed counts as not received.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        clock: FleetClock,
        *,
        datagrams: bool,
        signing: LinkSigning | None = None,
    ) -> None:
        table = config.agent(agent_id)
        self._settings = config.mavlink
        self._expected_system = config.system_id(agent_id)
        self._expected_flavour = table.autopilot
        self.signing = signing
        self._epoch_unix_s = config.fleet.epoch_unix_s
        self._fleet_clock = clock
        self.decoder = Decoder(datagrams=datagrams, signing=signing)
        self._encoder = Encoder(self._expected_system, config.mavlink.component_id, signing)
        self.clock = BootClock()
        self.samples = SampleAdapter(
            FleetFrame.of(config), config.sensors, config.fleet.epoch_unix_s, self._fleet_time_of_boot
        )
        self.rates = StreamRates(_wanted(config))
        self.state = LinkState.SEARCHING
        self.autopilot: AutopilotId | None = None
        self.heard = 0
        """Messages of the autopilot's system, whatever its component but our own."""
        self.reboots = 0
        self.ignored: Counter[str] = Counter()
        self._last_heartbeat_s = 0.0
        self._next_heartbeat_s = 0.0
        self._boot_s: float | None = None
        self._someone_else_answers = False
        self._answers: list[bytes] = []

    @property
    def sent(self) -> int:
        """Messages encoded for the autopilot."""
        return self._encoder.sent

    def receive(self, data: bytes, now_s: float) -> list[Sample]:
        """Take in bytes of the link; the samples they hold. Answers are fetched by `to_send`."""
        samples = []
        self._tell_time(now_s)
        own = (self._encoder.system_id, self._encoder.component_id)
        for message in self.decoder.feed(data):
            if (message.get_srcSystem(), message.get_srcComponent()) == own:
                self.ignored["own frame"] += 1  # sent back to us, well signed or not: nobody's word but ours
                continue
            self.heard += message.get_srcSystem() == self._expected_system
            sample = self._on_message(message, now_s)
            if sample is not None:
                samples.append(sample)
        return samples

    def to_send(self, now_s: float, system_status: int | None) -> list[bytes]:
        """Frames due now: answers, our heartbeat, TIMESYNC and rate requests; notes a lost autopilot.

        ``system_status`` (MAV_STATE) is what our heartbeat says; ``None`` = a fault: none is sent.
        """
        self._tell_time(now_s)
        frames, self._answers = self._answers, []
        if now_s >= self._next_heartbeat_s and system_status is not None:
            due_s = self._next_heartbeat_s or now_s
            self._next_heartbeat_s = max(due_s + HEARTBEAT_PERIOD_S, now_s)
            frames.append(self._encoder.encode(_heartbeat(system_status)))
        if self.state is LinkState.SEARCHING:
            return frames
        if self.state is LinkState.CONNECTED:
            if now_s - self._last_heartbeat_s > self._settings.heartbeat_timeout_s:
                self.state = LinkState.LOST
                return frames
            ts1 = self.clock.request(now_s, self._settings.component_id)
            if ts1 is not None:
                frames.append(self._encoder.encode(mavlink.MAVLink_timesync_message(0, ts1)))
            request = self.rates.poll(now_s)
            if request is not None:
                frames.append(self._encoder.encode(self._interval_command(*request)))
        return frames

    def _tell_time(self, now_s: float) -> None:
        if self.signing is not None:
            self.signing.unix_s = self._fleet_clock.fleet_s(now_s) + self._epoch_unix_s

    # --- incoming ------------------------------------------------------------------------------------------

    def _on_message(self, message: Message, now_s: float) -> Sample | None:
        message_id = message.get_msgId()
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            self._on_heartbeat(message, now_s)
            return None
        source = (message.get_srcSystem(), message.get_srcComponent())
        if self.autopilot is None or source != (self.autopilot.system_id, self.autopilot.component_id):
            self._on_stranger(message)
            return None
        if message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            self._on_timesync(message, now_s)
            return None
        if message_id == mavlink.MAVLINK_MSG_ID_COMMAND_ACK:
            self._on_ack(message, now_s)
            return None
        self.rates.on_message(message_id)
        boot_ms = getattr(message, "time_boot_ms", None)
        if boot_ms is not None:
            self._on_boot_time(boot_ms * 1e-3, now_s)
        return self.samples.convert(message, self._fleet_clock.fleet_s(now_s))

    def _on_heartbeat(self, message: Message, now_s: float) -> None:
        if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID or message.type in _NOT_VEHICLES:
            return
        flavour = FLAVOURS.get(message.autopilot, "other")
        if message.get_srcSystem() != self._expected_system:
            self.ignored["heartbeat: other system"] += 1
            return
        if self._expected_flavour not in ("auto", flavour):
            self.ignored[f"heartbeat: {flavour} instead of {self._expected_flavour}"] += 1
            return
        found = AutopilotId(message.get_srcSystem(), message.get_srcComponent(), flavour)
        if self.autopilot is not None and found.component_id != self.autopilot.component_id:
            self.ignored["heartbeat: second autopilot component"] += 1
            return
        self._last_heartbeat_s = now_s
        if self.state is not LinkState.CONNECTED:
            self.autopilot = found
            self.samples.flavour = flavour
            self.state = LinkState.CONNECTED
            self.rates.restart(now_s)

    def _on_stranger(self, message: Message) -> None:
        self.ignored["other source"] += 1
        if message.get_msgId() == mavlink.MAVLINK_MSG_ID_TIMESYNC and message.tc1:
            # Two responders with different clocks would corrupt the autopilot's filter.
            self._someone_else_answers = True

    def _on_timesync(self, message: Message, now_s: float) -> None:
        if message.tc1:
            self.clock.on_reply(message.tc1, message.ts1, now_s)
            return
        if not self._someone_else_answers:
            answer = mavlink.MAVLink_timesync_message(round(now_s * 1e9), message.ts1)
            self._answers.append(self._encoder.encode(answer))

    def _on_ack(self, message: Message, now_s: float) -> None:
        mine = (self._encoder.system_id, self._encoder.component_id)
        target = (message.target_system, message.target_component)
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and target in (mine, (0, 0)):
            self.rates.on_ack(message.result, now_s)
            self._fall_back()

    def _fall_back(self) -> None:
        """Ask for the second-best message where the best one is refused (older ArduPilot builds)."""
        assert self.autopilot is not None
        if self.autopilot.flavour == "ardupilot" and self.rates.refused(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU):
            self.rates.add(mavlink.MAVLINK_MSG_ID_RAW_IMU, self._settings.imu_hz)
        if self.rates.refused(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION):
            self.rates.add(mavlink.MAVLINK_MSG_ID_ATTITUDE, self._settings.attitude_hz)

    def _on_boot_time(self, boot_s: float, now_s: float) -> None:
        if self._boot_s is not None and boot_s < self._boot_s - REBOOT_BACKWARDS_S:
            self.reboots += 1
            self.clock.reset()
            self.samples.reset()
            self.rates.restart(now_s)
            self._boot_s = boot_s
        self._boot_s = boot_s if self._boot_s is None else max(self._boot_s, boot_s)
        self.clock.on_arrival(boot_s, now_s)

    def _fleet_time_of_boot(self, boot_s: float, arrival_s: float) -> float | None:
        if not self.clock.synchronised:
            self.clock.on_arrival(boot_s, arrival_s - self._fleet_clock.offset_s)
        host_s = self.clock.host_s(boot_s)
        return None if host_s is None else self._fleet_clock.fleet_s(host_s)

    # --- outgoing ------------------------------------------------------------------------------------------

    def _interval_command(self, message_id: int, interval_us: float) -> Message:
        assert self.autopilot is not None
        return mavlink.MAVLink_command_long_message(
            self.autopilot.system_id,
            self.autopilot.component_id,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
            0,
            float(message_id),
            round(interval_us),
            0, 0, 0, 0, 0,
        )  # fmt: skip


def _heartbeat(system_status: int) -> Message:
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, system_status, 3
    )


def _wanted(config: FleetConfig) -> dict[int, float]:
    """Streams and rates in Hz, in the order in which they are asked for."""
    settings = config.mavlink
    return {
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: settings.imu_hz,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: settings.attitude_hz,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: settings.gps_hz,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: LOCAL_POSITION_HZ,
    }
