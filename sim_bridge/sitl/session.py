"""The bridge's own conversation with one simulated autopilot, beside that of the daemon. Sans-I/O.

It finds the autopilot, asks it for its simulator's truth, and keeps its own fit of the autopilot's boot clock. It
speaks as a component of its own, so that answers to it are not taken for answers to the daemon.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from agent.config.tables import FleetConfig
from agent.mavlink.codec import Decoder, Encoder, Message, mavlink
from agent.mavlink.components import FLAVOURS
from agent.mavlink.stream_rates import StreamRates
from agent.mavlink.timesync import BootClock
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Triple
from sim_bridge.sitl.receiver_switch import ReceiverSwitch
from sim_bridge.sitl.sitl_table import COMPONENT_ID, sitl_table
from sim_bridge.sitl.truth import TRUTH_HZ, TRUTH_MESSAGES, TrueSample, TruthTap, boot_time_s

HEARTBEAT_S = 1.0
REBOOT_BACKWARDS_S = 1.0


@dataclass(frozen=True, slots=True)
class TimedTruth:
    """A vehicle's truth at ``host_s`` on the host's monotonic clock; NED m and m/s in the fleet frame."""

    host_s: float
    position_m: Triple
    velocity_mps: Triple
    yaw_rad: float


class SitlSession:
    """One simulated autopilot as the bridge knows it; times are on the host's monotonic clock."""

    def __init__(self, config: FleetConfig, agent_id: int, *, datagrams: bool) -> None:
        self._system = config.system_id(agent_id)
        self._wanted_flavour = config.agent(agent_id).autopilot
        self._settings = config.mavlink
        self._encoder = Encoder(self._system, COMPONENT_ID)
        self.decoder = Decoder(datagrams=datagrams)
        self.tap = TruthTap(FleetFrame.of(config))
        self.clock = BootClock()
        self.rates: StreamRates | None = None
        self.flavour: str | None = None
        """``px4`` or ``ardupilot`` once it is found."""
        self.gps_off = False
        """Whether its autopilot's GPS is to be off now."""
        self._switches_gps = any(outage.agent == agent_id for outage in sitl_table(config).autopilot_gps)
        self.receiver: ReceiverSwitch | None = None
        self.truths = 0
        self.reboots = 0
        self.ignored: Counter[str] = Counter()
        """Heartbeats of others, by what they were."""
        self._component = 0
        self._boot_s: float | None = None
        self._last_truth_s = float("-inf")
        self._heartbeat_s: float | None = None

    @property
    def refusal(self) -> str | None:
        """Why this autopilot will never tell a truth; ``None`` while it may."""
        if self.flavour is None or self.rates is None or self.truths:
            return None
        name = mavlink.mavlink_map[TRUTH_MESSAGES[self.flavour]].msgname
        if self.rates.refused(TRUTH_MESSAGES[self.flavour]):
            return f"it refuses {name}; expected a simulator, which says where its vehicle truly is"
        return None

    def receive(self, data: bytes, now_s: float) -> list[TimedTruth]:
        """Look at bytes that pass by; the truth in them, in order of time."""
        return [truth for message in self.decoder.feed(data) for truth in self._on_message(message, now_s)]

    def to_send(self, now_s: float) -> list[bytes]:
        """Frames of our own that are due: heartbeat, TIMESYNC and requests for messages."""
        if self.rates is None:
            return []  # nobody is there to talk to
        messages: list[Message] = []
        if self._heartbeat_s is None or now_s >= self._heartbeat_s:
            self._heartbeat_s = now_s + HEARTBEAT_S
            messages.append(_heartbeat())
        ts1 = self.clock.request(now_s, self._encoder.component_id)
        if ts1 is not None:
            messages.append(mavlink.MAVLink_timesync_message(0, ts1))
        if self.tap.needs_simstate:
            self.rates.add(mavlink.MAVLINK_MSG_ID_SIMSTATE, TRUTH_HZ)
        request = self.rates.poll(now_s)
        if request is not None:
            messages.append(self._interval(*request))
        if self.receiver is not None:
            switch = self.receiver.due(self.gps_off, self._system, self._component, now_s)
            messages += [] if switch is None else [switch]
        return [self._encoder.encode(message) for message in messages]

    def reconnected(self, now_s: float) -> None:
        """The link was opened anew: whoever answers now has to be asked again."""
        if self.rates is not None:
            self.rates.restart(now_s)

    def _on_message(self, message: Message, now_s: float) -> list[TimedTruth]:
        message_id = message.get_msgId()
        source = (message.get_srcSystem(), message.get_srcComponent())
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            self._on_heartbeat(message, now_s)
        elif self.rates is None or source != (self._system, self._component):
            return []
        elif message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            if message.tc1:
                self.clock.on_reply(message.tc1, message.ts1, now_s)
        elif message_id == mavlink.MAVLINK_MSG_ID_COMMAND_ACK:
            self._on_ack(message, now_s)
        elif message_id == mavlink.MAVLINK_MSG_ID_PARAM_VALUE:
            if self.receiver is not None:
                self.receiver.on_value(message)
        else:
            self.rates.on_message(message_id)
            self.tap.on_message(message, now_s)
            boot_s = boot_time_s(message)
            if boot_s is not None:
                return self._on_boot_time(boot_s, now_s)
        return []

    def _on_heartbeat(self, message: Message, now_s: float) -> None:
        flavour = FLAVOURS.get(message.autopilot)
        if message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1 or self.rates is not None:
            return
        if message.get_srcSystem() != self._system:
            self.ignored[f"system id {message.get_srcSystem()}"] += 1
        elif flavour is None or self._wanted_flavour not in ("auto", flavour):
            self.ignored[f"autopilot {flavour or message.autopilot} instead of {self._wanted_flavour}"] += 1
        else:
            self.flavour, self._component = flavour, message.get_srcComponent()
            # the attitude's rate is the daemon's, so that the two do not fight; its stamps date the truth
            wanted = {
                TRUTH_MESSAGES[flavour]: TRUTH_HZ,
                mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._settings.attitude_hz,
            }
            self.rates = StreamRates(wanted)
            self.rates.restart(now_s)
            self.receiver = ReceiverSwitch(flavour) if self._switches_gps else None

    def _on_ack(self, message: Message, now_s: float) -> None:
        mine = (self._encoder.system_id, self._encoder.component_id)
        target = (message.target_system, message.target_component)
        if self.rates is not None and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and target == mine:
            self.rates.on_ack(message.result, now_s)

    def _on_boot_time(self, boot_s: float, now_s: float) -> list[TimedTruth]:
        if self._boot_s is not None and boot_s < self._boot_s - REBOOT_BACKWARDS_S:
            self.reboots += 1
            self.clock.reset()
            self.tap.reset()
            self._boot_s = None
            self.reconnected(now_s)
        self._boot_s = boot_s if self._boot_s is None else max(self._boot_s, boot_s)
        self.clock.on_arrival(boot_s, now_s)
        timed = (self._timed(sample) for sample in self.tap.on_stamped(boot_s, now_s))
        return [truth for truth in timed if truth is not None]

    def _timed(self, sample: TrueSample) -> TimedTruth | None:
        """On the host's clock; ``None`` if the clock's fit was just moved back by more than a period."""
        host_s = self.clock.host_s(sample.boot_s)
        if host_s is None or host_s <= self._last_truth_s:
            self.tap.ignored["not later than the last"] += 1
            return None
        self._last_truth_s = host_s
        self.truths += 1
        return TimedTruth(host_s, sample.position_m, sample.velocity_mps, sample.yaw_rad)

    def _interval(self, message_id: int, interval_us: float) -> Message:
        return mavlink.MAVLink_command_long_message(
            self._system, self._component, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
            float(message_id), round(interval_us), 0, 0, 0, 0, 0,
        )  # fmt: skip


def _heartbeat() -> Message:
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )


def describe(ignored: Iterable[str]) -> str:
    """What else was heard, for a line that says what was expected."""
    return ", ".join(ignored) or "nothing"
