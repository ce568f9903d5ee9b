"""The session with the autopilot, sans-I/O: bytes in with a time, samples and bytes out.

``now_s`` is the host's monotonic clock; samples come out in fleet time, by the fleet clock. TIMESYNC is answered
with the same monotonic clock, so that a step of UTC cannot reach the autopilot's own clock filter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from agent.config.tables import FleetConfig
from agent.mavlink.boot_times import WRAP_MS_S, shown_boot_s, turns
from agent.mavlink.codec import Decoder, Encoder, Message, mavlink
from agent.mavlink.components import (
    AUTOPILOT_COMPONENT,
    FLAVOURS,
    SENSORS,
    Standing,
    speaks_for_vehicle,
    standing,
)
from agent.mavlink.sample_adapter import SampleAdapter
from agent.mavlink.signing import LinkSigning
from agent.mavlink.stream_rates import StreamRates, StreamState
from agent.mavlink.timesync import BootClock
from agent.mavlink.velocities import VELOCITY_MESSAGES, VelocityAdapter
from agent.sensing.clock import FleetClock
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Sample

HEARTBEAT_PERIOD_S = 1.0
MOST_NAMED = 8
"""Other systems that are remembered by their id."""
REBOOT_BACKWARDS_S = 1.0
REBOOT_CONFIRM = 3
"""So many stamps in a row that agree are of a new clock; a single one that is behind is not."""
AGREE_S = 1.0
AHEAD_S = 60.0
"""A stamp this far ahead of where the clock should be is doubted too: believed, it would put all others behind."""
PATIENCE_S = 5.0
"""A component that sends no sensors for so long is given up for one that does."""
LOCAL_POSITION_HZ = 2.0
"""For comparison only, never a measurement."""
FED_POSITION_HZ, FED_STATUS_HZ = 10.0, 5.0
"""The same where the autopilot is given the estimate: what it makes of that is watched."""
PRESSURE_HZ = 4.0
GROUND_HZ = 5.0
ESTIMATOR_STATUS_HZ = 2.0
CONVERGED_ANSWERS = 600
"""PX4's TIMESYNC filter needs 500 of our answers, 50 s; some that took long do not count."""
"""Whether the autopilot's attitude is aided: an attitude without positions is tilted within a second."""
_ESTIMATOR_STATUS = {
    "px4": mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
    "ardupilot": mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
}


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
            FleetFrame.of(config),
            config.sensors,
            config.fleet.epoch_unix_s,
            self._fleet_time_of_boot,
            own_receiver=config.fed_receiver(agent_id),
        )
        self.velocities = VelocityAdapter(config.fleet.epoch_unix_s, self._fleet_time_of_boot)
        self._fed = config.feeds(agent_id)
        self.rates = StreamRates(_wanted(config, self._fed))
        self._asks_pressure = config.sensors.barometer
        self.follower: Callable[[Message, float | None, float], None] | None = None
        """Gets every message of the autopilot, its stamp of the boot clock in fleet time, and the host time."""
        self.state = LinkState.SEARCHING
        self.autopilot: AutopilotId | None = None
        self.heard = 0
        """Messages of the autopilot's system, whatever its component but our own."""
        self.reboots = 0
        self.handovers = 0
        """How often another component was taken for the autopilot than before."""
        self.ignored: Counter[str] = Counter()
        self.other_systems: set[int] = set()
        """Systems that say they are vehicles and are not ours, the first few."""
        self._last_heartbeat_s = 0.0
        self._next_heartbeat_s = 0.0
        self._taken_s = 0.0
        """When the autopilot was taken for one."""
        self._sensed_s: dict[int, dict[str, float]] = {}
        """When the components of our system last sent sensors, by kind."""
        self._boot: tuple[float, float] | None = None
        """The autopilot's latest boot time, and when it came."""
        self._doubtful: list[tuple[float, float]] = []
        """The same of the last ones that do not fit it."""
        self._someone_else_answers = False
        self._answered = 0
        """TIMESYNC requests of its present clock that we answered."""
        self._answers: list[bytes] = []

    @property
    def sent(self) -> int:
        """Messages encoded for the autopilot."""
        return self._encoder.sent

    @property
    def told(self) -> str:
        """The link's state, and who is there in place of the autopilot that is looked for."""
        if self.state is not LinkState.SEARCHING or not self.other_systems:
            return str(self.state)
        others = ", ".join(map(str, sorted(self.other_systems)))
        return f"{self.state}: expected system {self._expected_system}, heard {others}"

    def slow_streams(self) -> list[StreamState]:
        """Those that come more slowly than asked for, from an autopilot that is there."""
        return self.rates.slow() if self.state is LinkState.CONNECTED else []

    def receive(self, data: bytes, now_s: float) -> list[Sample]:
        """Take in bytes of the link; the samples they hold. Answers are fetched by `to_send`."""
        samples: list[Sample] = []
        self._tell_time(now_s)
        own = (self._encoder.system_id, self._encoder.component_id)
        for message in self.decoder.feed(data):
            if (message.get_srcSystem(), message.get_srcComponent()) == own:
                self.ignored["own frame"] += 1  # sent back to us, well signed or not: nobody's word but ours
                continue
            self.heard += message.get_srcSystem() == self._expected_system
            samples += self._on_message(message, now_s)
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

    def encode(self, message: Message) -> bytes:
        """A message of ours as a frame for the autopilot."""
        return self._encoder.encode(message)

    def _tell_time(self, now_s: float) -> None:
        if self.signing is not None:
            self.signing.unix_s = self._fleet_clock.fleet_s(now_s) + self._epoch_unix_s

    # --- incoming ------------------------------------------------------------------------------------------

    def _on_message(self, message: Message, now_s: float) -> list[Sample]:
        message_id = message.get_msgId()
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            self._on_heartbeat(message, now_s)
            return []
        if message_id in SENSORS and message.get_srcSystem() == self._expected_system:
            self._sensed_s.setdefault(message.get_srcComponent(), {})[SENSORS[message_id]] = now_s
        source = (message.get_srcSystem(), message.get_srcComponent())
        if self.autopilot is None or source != (self.autopilot.system_id, self.autopilot.component_id):
            if message_id in VELOCITY_MESSAGES and source[0] == self._expected_system:
                return self._on_velocity(message, now_s, of_autopilot=source[1] == AUTOPILOT_COMPONENT)
            self._on_stranger(message)
            return []
        if self.follower is not None:
            self.follower(message, self._stamped_s(message, now_s), now_s)
        if message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            self._on_timesync(message, now_s)
            return []
        if message_id == mavlink.MAVLINK_MSG_ID_COMMAND_ACK:
            self._on_ack(message, now_s)
            return []
        self.rates.on_message(message_id)
        if message_id == mavlink.MAVLINK_MSG_ID_GPS2_RAW:  # there is a second receiver
            self.rates.add(message_id, self._settings.gps_hz)
        if message_id in VELOCITY_MESSAGES:
            return self._on_velocity(message, now_s, of_autopilot=True)
        boot_s = shown_boot_s(message)
        if boot_s is not None:
            self._on_boot_time(boot_s, now_s)
        arrival_s = self._fleet_clock.fleet_s(now_s)
        both = self.samples.convert(message, arrival_s), self.samples.pressure_beside(message, arrival_s)
        return [sample for sample in both if sample is not None]

    def _on_velocity(self, message: Message, now_s: float, *, of_autopilot: bool) -> list[Sample]:
        """What a companion, or the autopilot, says of a velocity."""
        arrival_s = self._fleet_clock.fleet_s(now_s)
        component = message.get_srcComponent()
        sample = self.velocities.convert(message, arrival_s, component, of_autopilot=of_autopilot)
        return [] if sample is None else [sample]

    def _on_heartbeat(self, message: Message, now_s: float) -> None:
        if not speaks_for_vehicle(message):
            return
        flavour = FLAVOURS.get(message.autopilot, "other")
        if message.get_srcSystem() != self._expected_system:
            self.ignored["heartbeat: other system"] += 1
            if len(self.other_systems) < MOST_NAMED:
                self.other_systems.add(message.get_srcSystem())
            return
        if self._expected_flavour not in ("auto", flavour):
            self.ignored[f"heartbeat: {flavour} instead of {self._expected_flavour}"] += 1
            return
        found = AutopilotId(message.get_srcSystem(), message.get_srcComponent(), flavour)
        if self.autopilot is not None and found.component_id != self.autopilot.component_id:
            if not self._is_better(found, now_s):
                self.ignored["heartbeat: second autopilot component"] += 1
                return
            self._hand_over()
        self._last_heartbeat_s = now_s
        if self.state is not LinkState.CONNECTED:
            self.autopilot = found
            self.samples.flavour = flavour
            self.state = LinkState.CONNECTED
            self._taken_s = now_s
            self.rates.restart(now_s)
            if flavour in _ESTIMATOR_STATUS:
                self.rates.add(_ESTIMATOR_STATUS[flavour], FED_STATUS_HZ if self._fed else ESTIMATOR_STATUS_HZ)

    @property
    def reads_stamps(self) -> bool:
        """Whether the autopilot puts our stamps on its clock by now: PX4 takes a message for one of its arrival until
        its TIMESYNC filter has converged."""
        px4 = self.autopilot is not None and self.autopilot.flavour == "px4"
        return not px4 or self._answered >= CONVERGED_ANSWERS

    def _is_better(self, found: AutopilotId, now_s: float) -> bool:
        """Whether another component is rather the autopilot than the one that was taken for it."""
        assert self.autopilot is not None
        if self._standing(found, now_s) <= self._standing(self.autopilot, now_s):
            return False
        # Component 1 is it at once; to others it is handed when sensors have had the time to come.
        return found.component_id == AUTOPILOT_COMPONENT or now_s - self._taken_s > PATIENCE_S

    def _standing(self, component: AutopilotId, now_s: float) -> Standing:
        sensed_s = self._sensed_s.get(component.component_id, {})
        kinds = [kind for kind, at_s in sensed_s.items() if now_s - at_s <= PATIENCE_S]
        return standing(component.component_id, kinds, (component.flavour,))

    def _hand_over(self) -> None:
        """Forget what came of the component that was taken for the autopilot."""
        self.handovers += 1
        self.state = LinkState.SEARCHING
        self._forget_clock()

    def _forget_clock(self) -> None:
        self._answered = 0
        self.clock.reset()
        self.samples.reset()
        self.velocities.reset()
        self._boot, self._doubtful = None, []

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
            self._answered += 1

    def _on_ack(self, message: Message, now_s: float) -> None:
        mine = (self._encoder.system_id, self._encoder.component_id)
        target = (message.target_system, message.target_component)
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and target in (mine, (0, 0)):
            self.rates.on_ack(message.result, now_s)
            self._fall_back()

    def _fall_back(self) -> None:
        """Ask for the next-best message where a better one is refused (older ArduPilot builds, lean links)."""
        assert self.autopilot is not None
        refused, settings = self.rates.refused, self._settings
        if self.autopilot.flavour == "ardupilot" and refused(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU):
            self.rates.add(mavlink.MAVLINK_MSG_ID_RAW_IMU, settings.imu_hz)
        unscaled = self.autopilot.flavour != "ardupilot" and refused(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU)
        if self._asks_pressure and refused(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU):  # which would hold it
            self.rates.add(mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE, PRESSURE_HZ)
        if unscaled or refused(mavlink.MAVLINK_MSG_ID_RAW_IMU):
            self.rates.add(mavlink.MAVLINK_MSG_ID_SCALED_IMU, settings.imu_hz)
        if refused(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION):
            self.rates.add(mavlink.MAVLINK_MSG_ID_ATTITUDE, settings.attitude_hz)

    def _on_boot_time(self, boot_s: float, now_s: float) -> None:
        if self._boot is not None:
            last_s, heard_s = self._boot
            expected_s = last_s + now_s - heard_s
            boot_s += turns(boot_s, expected_s, WRAP_MS_S) * WRAP_MS_S
            if boot_s < last_s - REBOOT_BACKWARDS_S or boot_s > expected_s + AHEAD_S:
                if not self._is_new_clock(boot_s, now_s):
                    return
                self.reboots += 1
                self._forget_clock()
                self.rates.restart(now_s)
                self._boot = None
        self._doubtful = []
        if self._boot is None or boot_s >= self._boot[0]:
            self._boot = boot_s, now_s
        self.clock.on_arrival(boot_s, now_s)

    def _is_new_clock(self, boot_s: float, now_s: float) -> bool:
        """Whether the last stamps that do not fit agree, as those of an autopilot that was rebooted."""
        agreeing = [each for each in self._doubtful if abs((boot_s - each[0]) - (now_s - each[1])) <= AGREE_S]
        self._doubtful = [*agreeing, (boot_s, now_s)]
        return len(self._doubtful) >= REBOOT_CONFIRM

    def _fleet_time_of_boot(self, boot_s: float, arrival_s: float) -> float | None:
        if not self.clock.synchronised:
            self.clock.on_arrival(boot_s, arrival_s - self._fleet_clock.offset_s)
        host_s = self.clock.host_s(boot_s)
        return None if host_s is None else self._fleet_clock.fleet_s(host_s)

    def _stamped_s(self, message: Message, now_s: float) -> float | None:
        boot_s = shown_boot_s(message)
        return None if boot_s is None else self._fleet_time_of_boot(boot_s, self._fleet_clock.fleet_s(now_s))

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


def _wanted(config: FleetConfig, fed: bool) -> dict[int, float]:
    """Streams and rates in Hz, in the order in which they are asked for; more of an autopilot that is ``fed``."""
    settings = config.mavlink
    more = {mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: FED_POSITION_HZ} if fed else {}
    if config.sensors.ground_m is not None:
        more[mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR] = GROUND_HZ
    return {
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: settings.imu_hz,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: settings.attitude_hz,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: settings.gps_hz,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: FED_POSITION_HZ if fed else LOCAL_POSITION_HZ,
    } | more
