"""One drone's feed, put together: what the autopilot says, the gatekeeper, the encoding, and what is told of it.

`agent.onboard` hands it the autopilot's messages, samples and every estimate, and sends what it gives. Sans-I/O.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from agent.config.tables import FleetConfig
from agent.feedback.autopilot_watch import AutopilotWatch
from agent.feedback.encoding import (
    FedState,
    GlobalPlace,
    ardupilot_odometry,
    global_position_sensor,
    gps_input,
    px4_odometry,
)
from agent.feedback.feedback_table import FEEDBACK_FITS
from agent.feedback.fusion import FusionWatch
from agent.feedback.gatekeeper import FeedPhase, FeedVerdict, Gatekeeper, Offer
from agent.feedback.handover import PX4_COUNTS_ON_GPS_S
from agent.feedback.requirements import ParameterReader, Requirement, requirements
from agent.feedback.spoofing import COMMAND, SpoofedReceiver
from agent.mavlink.codec import Message, mavlink
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import AutopilotEstimate, GpsSample, Quaternion, Sample
from estimators.estimator import Status
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.protection.levels import ProtectionLevel
from estimators.integrity.protection.statement import IntegrityState, Statement
from estimators.model.measurements import Matrix, Vector

ASK_ORIGIN_S, CONFIRM_ORIGIN_S = 1.0, 5.0
"""How often its origin is asked for: until it is known, and after."""
SWITCH_RETRY_S, SWITCH_ATTEMPTS = 1.0, 5
TELL_S = 5.0
"""A ground station is told of changes no more often than this."""
TEXT_CHARACTERS = 50
GOOD_STATES = (IntegrityState.NOMINAL, IntegrityState.DEGRADED)
GPS_SOURCES, OUR_SOURCES = 1, 2
"""ArduPilot's source sets."""


@dataclass(frozen=True, slots=True)
class FedAutopilot:
    """The autopilot at this moment: who it is, and whether it is there; ``flavour`` as `AutopilotId` has it."""

    connected: bool
    flavour: str
    system_id: int
    component_id: int


@dataclass(frozen=True, slots=True)
class Ready:
    """An estimate of the own drone at fleet time ``t_s``, ``now_s`` when it is out.

    ``mean`` ``(6,)`` and ``covariance`` ``(6, 6)`` NED in the fleet frame; ``quaternion`` is the autopilot's own
    attitude at ``t_s``; ``stamp_us`` that instant (and ``ahead_s``) on the clock which the autopilot expects,
    ``None`` if unknown.
    """

    t_s: float
    now_s: float
    unix_s: float
    mean: Vector
    covariance: Matrix
    status: Status
    statement: Statement | None
    quaternion: Quaternion | None
    stamp_us: int | None
    gps_lost: bool
    ahead_s: float = 0.0
    """What is sent is where it will be so much later than ``t_s``, to an autopilot that does not read stamps yet."""


class Feeder:
    """The feed of one drone; ``counters`` says how many estimates were fed and why others were not."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._table, self._agent_id = config.feedback, agent_id
        self._frame = FleetFrame.of(config)
        self._component_id = config.mavlink.component_id
        self.watch = AutopilotWatch(self._frame)
        self.parameters = ParameterReader()
        self.fusion = FusionWatch()
        self.receiver = SpoofedReceiver()
        self.verdict = FeedVerdict(FeedPhase.CHECKING, False, 0, "no estimate yet")
        self.unused = ""
        """Why the autopilot does not use what it is given, or would not."""
        self.counters: Counter[str] = Counter()
        self._gate = Gatekeeper(config.feedback)
        self._flavour = ""
        self._moves = 0
        self._life: tuple[object, ...] | None = None
        """What must stay the same for what was checked to hold."""
        self._origin_asked_s = self._told_s = self._switch_asked_s = float("-inf")
        self._told: FeedPhase | None = None
        self._sources = GPS_SOURCES
        """The source set that is to be in use, by us."""
        self._switched = GPS_SOURCES
        """The one that was acknowledged."""
        self._switch_attempts = 0
        self._out: list[Message] = []

    # --- what comes in ------------------------------------------------------------------------------------------

    def on_message(self, message: Message, t_s: float | None, host_s: float) -> None:
        """A message of the autopilot, ``t_s`` its stamp in fleet time where it has one."""
        message_id = message.get_msgId()
        if message_id == mavlink.MAVLINK_MSG_ID_PARAM_VALUE:
            self.parameters.on_value(message, self._flavour)
        elif message_id == mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
            if t_s is not None:
                self.watch.on_global(message, t_s, host_s)
        elif message_id == mavlink.MAVLINK_MSG_ID_COMMAND_ACK:
            self._on_ack(message)
        else:
            self.watch.on_message(message, host_s)

    def on_sample(self, sample: Sample) -> None:
        """A sample made of its messages."""
        if isinstance(sample, AutopilotEstimate):
            self.watch.on_own(sample)
        elif isinstance(sample, GpsSample):
            self.watch.on_fix(sample)

    def on_life(self, link: FedAutopilot, life: tuple[object, ...]) -> None:
        """Who the autopilot is; ``life`` changes when it reboots, is another one, or when we begin anew."""
        if link.flavour != self._flavour:
            self._flavour = link.flavour
            # ArduPilot's source set, or its choice of receivers, keeps what it is given in standby unused.
            self._gate = Gatekeeper(self._table, standby=link.flavour == "ardupilot")
        if self._life is not None and life != self._life:
            self.watch.reset()
            self.parameters.reset()
            self.receiver.reset()
            self._gate.forget("begun anew")
            self._moves = 0
            self._origin_asked_s = float("-inf")
        self._life = life

    # --- what goes out ------------------------------------------------------------------------------------------

    @property
    def wanted(self) -> tuple[Requirement, ...]:
        """The parameters that matter with this autopilot."""
        return requirements(self._flavour, self._table.kind, self._table.gps_id)

    def to_send(self, link: FedAutopilot, host_s: float) -> list[Message]:
        """Questions for the autopilot that are due: its origin, its parameters, the source set."""
        out, self._out = self._out, []
        if not link.connected:
            return out
        apart = self.watch.origin_is_wrong(host_s)
        pause_s = ASK_ORIGIN_S if self.watch.origin_m is None or apart else CONFIRM_ORIGIN_S
        if host_s - self._origin_asked_s >= pause_s:
            self._origin_asked_s = host_s
            out.append(_command(link, mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN))
        name = self.parameters.due(self.wanted, host_s)
        if name is not None:
            out.append(
                mavlink.MAVLink_param_request_read_message(link.system_id, link.component_id, name.encode(), -1)
            )
        told = self._table.tell_spoofing and self._flavour == "ardupilot"
        if told and self.receiver.due(host_s):
            out.append(_command(link, COMMAND, self.receiver.is_off, self._own_receiver))
        unswitched = self._sources != self._switched and self._switch_attempts < SWITCH_ATTEMPTS
        if unswitched and host_s - self._switch_asked_s >= SWITCH_RETRY_S:
            self._switch_asked_s = host_s
            self._switch_attempts += 1
            out.append(_command(link, mavlink.MAV_CMD_SET_EKF_SOURCE_SET, self._sources))
        return out

    def on_estimate(self, ready: Ready, link: FedAutopilot, host_s: float) -> list[Message]:
        """An estimate is out; the message that the autopilot is to have of it, if any."""
        if self.watch.moves != self._moves:
            self._moves = self.watch.moves
            self._gate.forget("its origin moved")
        self.verdict = self._gate.judge(self._offer(ready, link, host_s))
        if self.receiver.observe(self._receiver_off_m(ready), ready.now_s):
            self._out.append(self._told_of_receiver())
        messages = self._encoded(ready, link) if self.verdict.feed else []
        if messages:
            self.fusion.on_sent(ready.t_s, ready.now_s, ready.mean[:3] + self.verdict.shift_m)
        self._count(bool(messages))
        self.unused = self.fusion.observe(
            self.verdict.phase, self._flavour, self.wanted, self.parameters.values, self.watch, ready.now_s, host_s
        )
        self._choose_sources()
        return [*messages, *self._told_ground(host_s)]

    def findings(self) -> tuple[Finding, ...]:
        """What people are to know."""
        verdict, found = self.verdict, []
        if verdict.phase is FeedPhase.WITHHELD:
            found.append(Finding(What.NOT_FED, Gravity.DEGRADED, detail=verdict.reason))
        elif verdict.phase is FeedPhase.CHECKING and verdict.reason:
            found.append(Finding(What.NOT_READY, Gravity.NOTED, detail=verdict.reason))
        if self.unused:
            found.append(Finding(What.NOT_FUSED, Gravity.DEGRADED, detail=self.unused))
        if verdict.gps_off_m is not None:
            found.append(Finding(What.GPS_BACK_WRONG, Gravity.DEGRADED, value=verdict.gps_off_m))
        return tuple(found)

    def __str__(self) -> str:
        verdict = self.verdict
        text = f"{verdict.phase}: {verdict.reason}" if verdict.reason else str(verdict.phase)
        return f"{text}; not used: {self.unused}" if self.unused else text

    # --- common -------------------------------------------------------------------------------------------------

    def _offer(self, ready: Ready, link: FedAutopilot, host_s: float) -> Offer:
        watch, statement = self.watch, ready.statement
        position, velocity = ready.mean[:3], ready.mean[3:]
        fix_off_m = None
        if watch.fix is not None:
            true_s = watch.fix.t_s - watch.fix.latency.latency_s
            off = np.array(watch.fix.position_m) - position - (true_s - ready.t_s) * velocity
            fix_off_m = float(np.hypot(off[0], off[1]))
        origin_m = watch.origin_m
        return Offer(
            t_s=ready.t_s,
            now_s=ready.now_s,
            position_m=position,
            velocity_mps=velocity,
            level=ProtectionLevel(np.inf, np.inf) if statement is None else statement.own,
            bad=self._why_not_good(ready),
            autopilot=self._why_not_usable(link, host_s),
            origin_m=None if origin_m is None else np.array(origin_m),
            own_m=watch.own_at(ready.t_s),
            gps_lost=ready.gps_lost,
            fix_off_m=fix_off_m,
            gps_off=self.receiver.is_off,
            gps_unused=self.receiver.left_out,
            counts_on_gps=self._counts_on_gps(ready),
        )

    def _counts_on_gps(self, ready: Ready) -> bool:
        """Whether the autopilot may still count on a receiver whose fixes have ended: PX4, of local positions.

        Not where they are back: until they agree with the estimate, that is what it is to be fed.
        """
        fix, takes_motion = self.watch.fix, self._flavour == "px4" and self._table.kind == "odometry"
        if fix is None or not (takes_motion and ready.gps_lost):
            return False
        return ready.t_s - fix.t_s < PX4_COUNTS_ON_GPS_S

    def _why_not_good(self, ready: Ready) -> str:
        if ready.statement is None:
            return "nothing is promised of the estimate"
        if ready.statement.state not in GOOD_STATES:
            return str(ready.statement)
        if ready.status not in (Status.OK, Status.NOT_CONVERGED):
            return f"estimate {ready.status.name.lower().replace('_', ' ')}"
        return "" if ready.stamp_us is not None else "the autopilot's clock is not known"

    def _why_not_usable(self, link: FedAutopilot, host_s: float) -> str:
        kind = self._table.kind
        if not link.connected:
            return "no autopilot with the configured system id"
        if link.flavour not in FEEDBACK_FITS[kind]:
            return f'feedback.kind = "{kind}" is for {" and ".join(FEEDBACK_FITS[kind])}, not {link.flavour}'
        if self.watch.origin_fault:
            return f"its origin: {self.watch.origin_fault}"
        if self.watch.origin_is_wrong(host_s):
            return f"its origin is another one: its positions are {self.watch.apart_m:.0f} m apart by the one we know"
        return ""

    def _encoded(self, ready: Ready, link: FedAutopilot) -> list[Message]:
        """The message for this autopilot; none where it cannot be made."""
        assert ready.stamp_us is not None
        velocity = ready.mean[3:] + self.verdict.shift_rate_mps
        fed_m = ready.mean[:3] + self.verdict.shift_m + ready.ahead_s * velocity
        north, east, down = (float(each) for each in fed_m)
        about_m = np.zeros(3) if self.watch.origin_m is None else np.array(self.watch.origin_m)
        local = fed_m - about_m
        ahead = np.eye(6) + ready.ahead_s * np.eye(6, k=3)
        covariance = ahead @ ready.covariance @ ahead.T
        state = FedState(
            ready.stamp_us,
            (float(local[0]), float(local[1]), float(local[2])),
            (float(velocity[0]), float(velocity[1]), float(velocity[2])),
            covariance,
            self.verdict.reset_counter,
            ready.quaternion,
        )
        if self._table.kind == "odometry":
            message = px4_odometry(state) if link.flavour == "px4" else ardupilot_odometry(state)
        else:
            place = GlobalPlace.of((north, east, down), self._frame)
            if place is None:
                message = None
            elif self._table.kind == "global":
                age_s = ready.now_s - ready.t_s
                ids = {"system_id": link.system_id, "component_id": link.component_id}
                message = global_position_sensor(state, place, **ids, age_s=age_s)
            else:
                message = gps_input(state, place, gps_id=self._table.gps_id, unix_s=ready.unix_s)
        if message is None:
            self.counters["feedback: not encoded (attitude or height above sea level unknown)"] += 1
            return []
        return [message]

    def _count(self, fed: bool) -> None:
        self.counters[f"feedback: {self.verdict.phase}"] += 1
        self.counters["feedback: sent"] += fed

    def _choose_sources(self) -> None:
        """The source set that ArduPilot should fly by, where we are to switch it."""
        if not (self._table.switch_source and self._flavour == "ardupilot" and self._table.kind == "odometry"):
            return
        wanted = OUR_SOURCES if self.verdict.phase is FeedPhase.FEEDING else GPS_SOURCES
        if wanted != self._sources:
            self._sources, self._switch_attempts = wanted, 0

    @property
    def _own_receiver(self) -> int:
        """The number of the receiver that is not ours."""
        return 1 if self._table.kind == "gps_input" and self._table.gps_id == 0 else 0

    def _receiver_off_m(self, ready: Ready) -> float | None:
        """How far its fixes are off, by integrity or against what it is fed; ``None`` if nothing is known of that."""
        statement = ready.statement
        if statement is not None and statement.state in GOOD_STATES and self._agent_id in statement.off:
            return statement.off[self._agent_id]
        return self.verdict.gps_off_m if self.verdict.phase is FeedPhase.FEEDING else None

    def _told_of_receiver(self) -> Message:
        """What the ground station is told when its receiver is found to be off, or no longer."""
        receiver = self.receiver
        text = f"GPS {receiver.off_m:.0f} m off, spoofed or faulty" if receiver.is_off else "GPS agrees again"
        severity = mavlink.MAV_SEVERITY_CRITICAL if receiver.is_off else mavlink.MAV_SEVERITY_INFO
        return mavlink.MAVLink_statustext_message(severity, f"fleetloc: {text}"[:TEXT_CHARACTERS].encode())

    def _on_ack(self, message: Message) -> None:
        if message.command == COMMAND:
            accepted = message.result == mavlink.MAV_RESULT_ACCEPTED
            self.receiver.on_ack(accepted)
            self.counters[f"feedback: word on its receiver {'taken' if accepted else 'refused'}"] += 1
        if message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET and self._switch_attempts:
            accepted = message.result == mavlink.MAV_RESULT_ACCEPTED
            self.counters[f"feedback: source set {'switched' if accepted else 'refused'}"] += 1
            if accepted:
                self._switched = self._sources

    def _told_ground(self, host_s: float) -> list[Message]:
        """A text for the ground station when something changed."""
        if self.verdict.phase is self._told or host_s - self._told_s < TELL_S:
            return []
        first, self._told, self._told_s = self._told is None, self.verdict.phase, host_s
        if first and self.verdict.phase is not FeedPhase.FEEDING:
            return []
        grave = self.verdict.phase is FeedPhase.WITHHELD
        severity = mavlink.MAV_SEVERITY_WARNING if grave else mavlink.MAV_SEVERITY_INFO
        text = f"fleetloc: {self}"[:TEXT_CHARACTERS]
        return [mavlink.MAVLink_statustext_message(severity, text.encode("ascii", "replace"))]


def _command(link: FedAutopilot, number: int, parameter: float, second: float = 0.0) -> Message:
    return mavlink.MAVLink_command_long_message(
        link.system_id, link.component_id, number, 0, float(parameter), float(second), 0, 0, 0, 0, 0
    )
