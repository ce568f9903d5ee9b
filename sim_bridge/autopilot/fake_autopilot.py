"""A fake autopilot: MAVLink bytes in, MAVLink bytes out, time as an argument. PX4 and ArduPilot flavours.

It streams what its vehicle's sensors say at the rates it was told, answers commands, parameters, time and
mission requests, and judges outside positions as strictly as the real ones do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from agent.mavlink.codec import Decoder, Encoder
from agent.mavlink.dialect import mavlink
from agent.mavlink.signing import LinkSigning
from agent.sensing.frames import FleetFrame, rotated
from sim_bridge.autopilot import mavlink_wire as wire
from sim_bridge.autopilot.commands import Command, CommandHandler
from sim_bridge.autopilot.external_feed import Refused
from sim_bridge.autopilot.flavours import FLAVOURS, STREAM_GROUPS, FlightMode
from sim_bridge.autopilot.mavlink_wire import Message
from sim_bridge.autopilot.navigation import OutsideState
from sim_bridge.autopilot.state import AutopilotState, AutopilotVehicle, CrystalClock, ParameterTable
from sim_bridge.autopilot.stream_messages import StreamMessages
from sim_bridge.autopilot.streams import StreamTable
from sim_bridge.world.noise import FlavourName
from sim_bridge.world.sensors import GpsFix, quaternion_of, vector_of

COMPONENT = int(mavlink.MAV_COMP_ID_AUTOPILOT1)
HEARTBEAT_S = 1.0
SIM_GPS: dict[FlavourName, str] = {"px4": "SIM_GPS_USED", "ardupilot": "SIM_GPS1_ENABLE"}
"""With this parameter at zero their simulators take GPS away."""
GPS_TIMEOUT_S = 4.0
"""ArduPilot takes a receiver that is silent for so long for one without a fix."""
GPS_SILENCE_S = 1.0
"""PX4 says that its receiver is gone after this long without a fix."""
WGS84_INT_SCALE = 1e-7


@dataclass(frozen=True, slots=True)
class AutopilotSetup:
    """What does not change over reboots.

    ``sensor_rates_hz`` by message id bounds the streams; ``gravity_mps2`` is what the autopilot takes from
    its accelerometers; ``unix_offset_s`` is Unix time minus the clock of ``now``; ``gps_time_unknown`` sends
    GPS stamps of zero, as PX4 does when it has no UTC; ``fusing`` navigates by a filter with the firmware's
    figures (`sim_bridge.autopilot.fusing`). With a ``signing_key`` it signs, and takes signed frames only.
    """

    flavour: FlavourName
    system_id: int
    frame: FleetFrame
    gravity_mps2: float
    unix_offset_s: float = 0.0
    clock_skew_ppm: float = 0.0
    stamp_quantum_us: int = 1
    gps_time_unknown: bool = False
    fusing: bool = False
    signing_key: bytes | None = None
    sensor_rates_hz: dict[int, float] = field(default_factory=dict)


@dataclass(slots=True)
class AutopilotCounters:
    """What was received and not used, by reason, and what was answered."""

    ignored: Counter[str] = field(default_factory=Counter)
    """Messages by type that are not simulated, or for another system."""
    commands: Counter[tuple[int, int]] = field(default_factory=Counter)
    """By command and result."""
    timesync_replies: int = 0
    """Answers to this autopilot's own TIMESYNC requests."""


class FakeAutopilot:
    """One autopilot. Feed it bytes and time; take its frames."""

    def __init__(self, setup: AutopilotSetup, vehicle: AutopilotVehicle, now: float) -> None:
        """Boots at ``now``; in the air it is armed and on its mission."""
        self.setup = setup
        self.counters = AutopilotCounters()
        self._vehicle = vehicle
        self._parameters = ParameterTable(FLAVOURS[setup.flavour], setup.system_id)
        self._signing: LinkSigning | None = None
        if setup.signing_key is not None:
            self._signing = LinkSigning(setup.signing_key, unix_s=now + setup.unix_offset_s)
        self._decoder = Decoder(datagrams=True, signing=self._signing)
        self._out: list[bytes] = []
        self._down_until_s: float | None = None
        self._handlers: dict[str, Callable[[Message, float], None]] = {
            "COMMAND_LONG": self._on_command,
            "COMMAND_INT": self._on_command,
            "TIMESYNC": self._on_timesync,
            "PING": self._on_ping,
            "PARAM_REQUEST_LIST": self._on_param_list,
            "PARAM_REQUEST_READ": self._on_param_read,
            "PARAM_SET": self._on_param_set,
            "MISSION_REQUEST_LIST": self._on_mission_list,
            "MISSION_COUNT": self._on_mission_change,
            "MISSION_CLEAR_ALL": self._on_mission_change,
            "REQUEST_DATA_STREAM": self._on_stream_group,
            "SET_GPS_GLOBAL_ORIGIN": self._on_set_origin,
            "ODOMETRY": self._on_feed,
            "VISION_POSITION_ESTIMATE": self._on_feed,
            "VISION_SPEED_ESTIMATE": self._on_feed,
            "GPS_INPUT": self._on_receiver,
            "GLOBAL_POSITION_SENSOR": self._on_global_sensor,
            "HEARTBEAT": lambda _message, _now: None,
        }
        self._boot(now)

    def _boot(self, now: float) -> None:
        setup, flavour = self.setup, FLAVOURS[self.setup.flavour]
        limits = {mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 10.0} | setup.sensor_rates_hz
        self.state = AutopilotState(
            flavour,
            setup.frame,
            CrystalClock(now, setup.clock_skew_ppm, setup.stamp_quantum_us),
            self._parameters,
            StreamTable(flavour, limits),
            airborne=not self._vehicle.landed,
            fusing=setup.fusing,
        )
        self._encoder = Encoder(setup.system_id, COMPONENT, self._signing)
        self._messages = StreamMessages(self.state, self._vehicle, setup.unix_offset_s, setup.system_id)
        self._commands = CommandHandler(self.state, self._vehicle, self._send_now, self._send)
        self._heartbeat_s = self._timesync_s = now
        self._last_fix: tuple[GpsFix, float] | None = None
        self._last_fix_s = now
        self._has_barometer = False
        self._first_is_valid = False
        """Whether the own receiver's last word was a fix."""
        self._now = now

    @property
    def link(self) -> Decoder:
        """Counters of the link: received, lost, bad."""
        return self._decoder

    def reboot(self, now: float, down_s: float = 1.0) -> None:
        """Go silent and start again after ``down_s`` with the boot clock at zero and the default streams."""
        self._out.clear()
        self._down_until_s = now + down_s

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take one datagram; the frames sent in answer."""
        if self._is_down(now):
            return []
        self._set_time(now)
        for message in self._decoder.feed(data):
            self._handle(message, now)
        frames = self._drain()
        if self.state.reboot_asked:
            self.reboot(now)
        return frames

    def advance(self, now: float) -> list[bytes]:
        """The frames due by now: streams, heartbeat, own TIMESYNC requests."""
        if self._is_down(now):
            return []
        self._set_time(now)
        self._navigate(now)
        self._look_after_position(now)
        if now >= self._heartbeat_s:
            self._send(self._messages.heartbeat())
            self._heartbeat_s = max(self._heartbeat_s + HEARTBEAT_S, now)
        if now >= self._timesync_s:
            # the system id in the low digits keeps the stamps of several autopilots on one link apart
            stamp_ns = self.state.clock.ns(now) // 1000 * 1000 + self.setup.system_id
            self._send(mavlink.MAVLink_timesync_message(0, stamp_ns))
            self._timesync_s = max(self._timesync_s + self.state.flavour.timesync_request_s, now)
        for message_id in self.state.streams.due(now):
            message = self._messages.build(message_id, now)
            if message is not None:
                self._send(message)
        self._report_lost_gps(now)
        return self._drain()

    def on_fix(self, fix: GpsFix, taken_s: float, now: float) -> None:
        """The receiver delivers a fix (or its word that it has none), stamped ``taken_s`` on the clock of now."""
        if self._is_down(now):
            return
        state = self.state
        if self._parameters.value(SIM_GPS[state.flavour.name]) == 0.0:
            fix = GpsFix(fix.time_s, False)
        self._last_fix = (fix, taken_s)
        self._first_is_valid = fix.valid
        if fix.valid:
            self._last_fix_s = now
            if not self.setup.fusing or state.feed.uses_gps():
                state.navigation.on_fix(fix, now)
            if state.home_m is None:
                state.home_m = np.array(fix.position_ned_m)
        elif state.flavour.name == "px4":
            return  # it waits for the receiver's silence to be long enough
        if state.streams.take(mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, now):
            self._send(self._gps_message(fix, taken_s))

    def _set_time(self, now: float) -> None:
        self._now = now
        if self._signing is not None:
            self._signing.unix_s = now + self.setup.unix_offset_s

    def _gps_message(self, fix: GpsFix, taken_s: float) -> Message:
        stamp_us = 0 if self.setup.gps_time_unknown else self.state.clock.us(taken_s)
        return wire.gps_raw_int(stamp_us, fix) if fix.valid else wire.gps_raw_int_lost(stamp_us, wire.FIX_NONE)

    def _report_lost_gps(self, now: float) -> None:
        lost = self.state.flavour.name == "px4" and now - self._last_fix_s >= GPS_SILENCE_S
        if lost and self.state.streams.take(mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, now):
            self._send(wire.gps_raw_int_lost(0, wire.FIX_NO_GPS))

    def _is_down(self, now: float) -> bool:
        if self._down_until_s is None:
            return False
        if now < self._down_until_s:
            return True
        self._boot(self._down_until_s)
        self._down_until_s = None
        return False

    def _navigate(self, now: float) -> None:
        navigation = self.state.navigation
        if navigation.due(now):
            attitude, imu = navigation.attitude(self._vehicle.attitude()), self._vehicle.imu()
            north, east, down = rotated(quaternion_of(attitude), vector_of(imu.accel_mps2))
            navigation.predict(np.array((north, east, down + self.setup.gravity_mps2)), now)
            self._has_barometer = imu.pressure_hpa is not None
            if self._has_barometer:
                navigation.on_height(self.state.down_of_msl(imu.pressure_alt_m), now)

    def _look_after_position(self, now: float) -> None:
        """The estimator's failsafe, where it has one: of an armed vehicle that was once located and is in the air."""
        state = self.state
        flies = state.armed and not self._vehicle.landed and state.navigation.origin_m is not None
        if state.failsafe is None or not flies:
            return
        mode = state.failsafe.step(state.mode, state.navigation.unaided_s(now), now)
        if mode is not None:
            self._commands.enter(mode)
            text = "EKF Failsafe: LAND" if mode is FlightMode.LAND else "EKF failsafe cleared"
            self._send(wire.statustext(mavlink.MAV_SEVERITY_CRITICAL, text))

    def _send(self, message: Message) -> None:
        self._out.append(self._encoder.encode(message))

    def _send_now(self, message_id: int) -> int:
        if not self._messages.offers(message_id):
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        if message_id == mavlink.MAVLINK_MSG_ID_GPS_RAW_INT:
            message = None if self._last_fix is None else self._gps_message(*self._last_fix)
        else:
            message = self._messages.build(message_id, self._now)
        if message is None:  # it exists, but there is nothing to say yet
            return self.state.flavour.refuse_now
        self._send(message)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _drain(self) -> list[bytes]:
        frames, self._out = self._out, []
        return frames

    def _handle(self, message: Message, now: float) -> None:
        kind = message.get_type()
        handler = self._handlers.get(kind)
        if handler is None:
            self.counters.ignored[kind] += 1
        elif getattr(message, "target_system", 0) not in (0, self.setup.system_id):
            self.counters.ignored[f"{kind} for another system"] += 1
        elif getattr(message, "target_component", 0) not in (0, COMPONENT):
            self.counters.ignored[f"{kind} for another component"] += 1
        else:
            handler(message, now)

    def _on_command(self, message: Message, now: float) -> None:
        params = (message.param1, message.param2, message.param3, message.param4)
        if message.get_type() == "COMMAND_INT":
            place = (message.x * WGS84_INT_SCALE, message.y * WGS84_INT_SCALE, message.z)
            command = Command(message.command, (*params, *place), message.frame)
        else:
            command = Command(message.command, (*params, message.param5, message.param6, message.param7))
        result = self._commands.handle(command, now)
        self.counters.commands[(command.number, result)] += 1
        self._send(
            mavlink.MAVLink_command_ack_message(
                command.number,
                result,
                target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(),
            )
        )

    def _on_timesync(self, message: Message, now: float) -> None:
        if message.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(self.state.clock.ns(now), message.ts1))
        else:
            self.counters.timesync_replies += 1
            self.state.feed_clock.on_timesync(message.tc1 * 1e-9, now)

    def _on_ping(self, message: Message, now: float) -> None:
        if message.target_system == 0 and message.target_component == 0:
            answer = (message.get_srcSystem(), message.get_srcComponent())
            self._send(mavlink.MAVLink_ping_message(self.state.clock.us(now), message.seq, *answer))

    def _send_parameter(self, name: str) -> None:
        value, integer = self._parameters.encoded(name)
        kind = mavlink.MAV_PARAM_TYPE_INT32 if integer else mavlink.MAV_PARAM_TYPE_REAL32
        names = self._parameters.names()
        self._send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(names), names.index(name)))

    def _on_param_list(self, _message: Message, _now: float) -> None:
        for name in self._parameters.names():
            self._send_parameter(name)

    def _on_param_read(self, message: Message, _now: float) -> None:
        names = self._parameters.names()
        index = message.param_index
        name = names[index] if 0 <= index < len(names) else _text(message.param_id)
        if name in names:
            self._send_parameter(name)
        else:
            self.counters.ignored["unknown parameter"] += 1

    def _on_param_set(self, message: Message, _now: float) -> None:
        name = _text(message.param_id)
        if self._parameters.store(name, message.param_value):
            self._send_parameter(name)
        else:
            self.counters.ignored["unknown parameter or value"] += 1

    def _on_mission_list(self, message: Message, _now: float) -> None:
        self._send(
            mavlink.MAVLink_mission_count_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, message.mission_type
            )
        )

    def _on_mission_change(self, message: Message, _now: float) -> None:
        cleared = message.get_type() == "MISSION_CLEAR_ALL"
        result = mavlink.MAV_MISSION_ACCEPTED if cleared else mavlink.MAV_MISSION_UNSUPPORTED
        self._send(
            mavlink.MAVLink_mission_ack_message(
                message.get_srcSystem(), message.get_srcComponent(), result, message.mission_type
            )
        )

    def _on_stream_group(self, message: Message, _now: float) -> None:
        group = STREAM_GROUPS.get(message.req_stream_id)
        if self.setup.flavour != "ardupilot" or group is None:
            self.counters.ignored["REQUEST_DATA_STREAM not served"] += 1
            return
        on = message.start_stop == 1 and message.req_message_rate > 0
        for message_id in group:
            self.state.streams.set_interval(message_id, 1e6 / message.req_message_rate if on else -1.0)

    def _on_set_origin(self, message: Message, _now: float) -> None:
        """Only an autopilot without position takes an origin (a real PX4 would move one that is set)."""
        state = self.state
        lat_deg, lon_deg = message.latitude * WGS84_INT_SCALE, message.longitude * WGS84_INT_SCALE
        nowhere = message.latitude == 0 and message.longitude == 0
        possible = not nowhere and abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0
        if not possible or state.navigation.origin_m is not None:
            self.counters.ignored["SET_GPS_GLOBAL_ORIGIN refused"] += 1
            return
        state.navigation.set_origin(np.array(state.fleet_ned(lat_deg, lon_deg, 1e-3 * message.altitude)))
        self._send_now(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)

    def _on_feed(self, message: Message, now: float) -> None:
        state = self.state
        try:
            fed = state.feed.accept(message, state.navigation.attitude(self._vehicle.attitude()).quaternion, now)
        except Refused as refused:
            self._send(wire.statustext(mavlink.MAV_SEVERITY_CRITICAL, f"ODOMETRY: {refused.reason} rejected"))
            return
        origin_m = state.navigation.origin_m
        held_by_gps = now - self._last_fix_s < GPS_SILENCE_S and not self.setup.fusing
        taken_s = state.feed_clock.taken_s(getattr(message, "time_usec", getattr(message, "usec", 0)), now)
        if fed is not None and origin_m is not None and state.feed.fused(now) and not held_by_gps:
            position_m = origin_m + fed.position_m
            if self._has_barometer and not state.feed.uses_height():
                position_m[2] = np.nan
            outside = OutsideState(
                position_m,
                fed.velocity_mps,
                fed.position_sigma_m,
                fed.velocity_sigma_mps,
                taken_s,
                int(message.reset_counter),
                relative=state.flavour.name == "px4",
            )
            state.navigation.on_outside(outside, now)


    def _on_global_sensor(self, message: Message, now: float) -> None:
        outside = self.state.global_feed.of_sensor(message, now)
        if outside is not None and self.setup.fusing:
            self.state.navigation.on_outside(outside, now)

    def _on_receiver(self, message: Message, now: float) -> None:
        first_has_fix = self._first_is_valid and now - self._last_fix_s < GPS_TIMEOUT_S
        fix = self.state.global_feed.of_receiver(message, now, first_has_fix)
        if fix is not None and self.setup.fusing:
            self.state.navigation.on_fix(fix, now)


def _text(name: bytes | str) -> str:
    """A parameter's name, which the codec may give as bytes with trailing zeros."""
    text = name if isinstance(name, str) else name.decode("ascii", "replace")
    return text.rstrip("\0")
