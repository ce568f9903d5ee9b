"""COMMAND_LONG and COMMAND_INT: what the fake autopilots do when told, and how they answer.

Every command is answered; what is not simulated is UNSUPPORTED. Arming, take-off, flying to a point and
landing move the simulated vehicle; nothing else of a real autopilot's checks is imitated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from agent.mavlink.dialect import mavlink
from sim_bridge.autopilot.flavours import FlightMode
from sim_bridge.autopilot.mavlink_wire import Message
from sim_bridge.autopilot.state import AutopilotState, AutopilotVehicle

ACCEPTED = int(mavlink.MAV_RESULT_ACCEPTED)
DENIED = int(mavlink.MAV_RESULT_DENIED)
UNSUPPORTED = int(mavlink.MAV_RESULT_UNSUPPORTED)
FORCE_REBOOT = 20190226
DEFAULT_TAKEOFF_M = 2.5
GLOBAL_FRAMES = frozenset({mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT})
RELATIVE_FRAMES = frozenset({mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT})


@dataclass(frozen=True, slots=True)
class Command:
    """A command in either spelling: its seven parameters, of which 5 to 7 may be a place; NaN = not given."""

    number: int
    params: tuple[float, float, float, float, float, float, float]
    frame: int = mavlink.MAV_FRAME_GLOBAL

    @property
    def place(self) -> tuple[float, float, float]:
        """Latitude and longitude in deg and height in m."""
        return self.params[4], self.params[5], self.params[6]


class CommandHandler:
    """Carries commands out.

    ``send_now(message_id)`` sends a message of the autopilot at once and gives the MAV_RESULT of the request;
    ``send(message)`` sends any.
    """

    def __init__(
        self,
        state: AutopilotState,
        vehicle: AutopilotVehicle,
        send_now: Callable[[int], int],
        send: Callable[[Message], None],
    ) -> None:
        self._state, self._vehicle = state, vehicle
        self._send_now, self._send = send_now, send
        self._handlers: dict[int, Callable[[Command, float], int]] = {
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mavlink.MAV_CMD_NAV_LAND: self._land,
            mavlink.MAV_CMD_DO_REPOSITION: self._go_to,
            mavlink.MAV_CMD_MISSION_START: self._start_mission,
            mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
        }
        if state.flavour.name == "ardupilot":  # PX4 1.18 has none of these
            self._handlers |= {
                mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._request_capabilities,
                mavlink.MAV_CMD_GET_HOME_POSITION: self._request_home,
                mavlink.MAV_CMD_SET_EKF_SOURCE_SET: self._set_source,
                mavlink.MAV_CMD_USER_1: self._hear_of_spoofing,
            }

    def handle(self, command: Command, now: float) -> int:
        """Carry a command out; the MAV_RESULT of its acknowledgement."""
        handler = self._handlers.get(command.number)
        return UNSUPPORTED if handler is None else handler(command, now)

    def _message_id(self, command: Command) -> int:
        return int(command.params[0]) if math.isfinite(command.params[0]) else -1

    def _set_interval(self, command: Command, _now: float) -> int:
        return self._state.streams.set_interval(self._message_id(command), command.params[1])

    def _get_interval(self, command: Command, _now: float) -> int:
        message_id = self._message_id(command)
        if not 0 <= message_id <= 0xFFFF:
            return DENIED
        interval_us = self._state.streams.interval_us(message_id)
        self._send(mavlink.MAVLink_message_interval_message(message_id, interval_us))
        return ACCEPTED

    def _request_message(self, command: Command, _now: float) -> int:
        return self._send_now(self._message_id(command))

    def _request_capabilities(self, _command: Command, _now: float) -> int:
        return self._send_now(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)

    def _request_home(self, _command: Command, _now: float) -> int:
        return self._send_now(mavlink.MAVLINK_MSG_ID_HOME_POSITION)

    def _arm(self, command: Command, now: float) -> int:
        state, wanted = self._state, command.params[0]
        if wanted not in (0.0, 1.0):
            return DENIED
        if wanted and not state.armed and not state.navigation.aided(now):
            return state.flavour.refuse_now
        if not wanted and not self._vehicle.landed:
            # motors off in flight would be a crash, which this world does not have: forced or not, no
            return state.flavour.refuse_now
        state.armed = bool(wanted)
        return ACCEPTED

    def _set_mode(self, command: Command, _now: float) -> int:
        number = command.params[1]
        if not (math.isfinite(number) and math.isfinite(command.params[2])):
            return DENIED
        custom = int(number)
        if self._state.flavour.name == "px4":
            custom = int(number) << 16 | int(command.params[2]) << 24
        mode = self._state.flavour.mode_of(custom)
        if mode is None:
            return DENIED
        if mode is FlightMode.TAKEOFF:
            return self._climb(self._takeoff_height_m())
        return self.enter(mode)

    def enter(self, mode: FlightMode) -> int:
        """Go over to a mode, whoever wants it; the MAV_RESULT."""
        if not self._vehicle.landed:
            if mode is FlightMode.MISSION:
                self._vehicle.follow_path()
            elif mode is FlightMode.LAND:
                self._vehicle.land()
            else:
                self._vehicle.hold()
        self._state.mode = mode
        return ACCEPTED

    def _takeoff_height_m(self) -> float:
        name = self._state.flavour.takeoff_height_parameter
        return DEFAULT_TAKEOFF_M if name is None else self._state.parameters.value(name)

    def _take_off(self, command: Command, _now: float) -> int:
        """PX4's height is above mean sea level or absent; ArduPilot's is above home, in guided mode only."""
        state = self._state
        alt_m = command.place[2]
        height_m = alt_m if math.isfinite(alt_m) else self._takeoff_height_m()
        if state.flavour.name == "ardupilot" and state.mode is not FlightMode.GUIDED:
            return state.flavour.refuse_now
        if state.flavour.name == "px4" and math.isfinite(alt_m):
            height_m = alt_m - state.geodetic(state.navigation.position_m)[2]
        return self._climb(height_m)

    def _climb(self, height_m: float) -> int:
        if not (self._state.armed and self._vehicle.landed and height_m > 0.0):
            return self._state.flavour.refuse_now
        self._vehicle.climb(height_m)
        if FlightMode.TAKEOFF in self._state.flavour.modes:
            self._state.mode = FlightMode.TAKEOFF
        return ACCEPTED

    def _land(self, _command: Command, _now: float) -> int:
        return self._state.flavour.refuse_now if self._vehicle.landed else self.enter(FlightMode.LAND)

    def _go_to(self, command: Command, now: float) -> int:
        state = self._state
        if command.frame not in GLOBAL_FRAMES | RELATIVE_FRAMES:
            return DENIED
        lat_deg, lon_deg, alt_m = command.place
        if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and math.isfinite(alt_m)):
            return DENIED
        if self._vehicle.landed or not state.navigation.aided(now):
            return state.flavour.refuse_now
        if command.frame in RELATIVE_FRAMES:
            if state.home_m is None:
                return state.flavour.refuse_now
            alt_m += state.geodetic(state.home_m)[2]
        self._vehicle.go_to(state.fleet_ned(lat_deg, lon_deg, alt_m))
        state.mode = FlightMode.GUIDED if state.flavour.name == "ardupilot" else FlightMode.HOLD
        return ACCEPTED

    def _start_mission(self, _command: Command, _now: float) -> int:
        if self._vehicle.landed:
            return self._state.flavour.refuse_now
        return self.enter(FlightMode.MISSION)

    def _reboot(self, command: Command, _now: float) -> int:
        wanted, force = command.params[0], command.params[5]
        if wanted != 1.0:
            return UNSUPPORTED
        if self._state.armed and not self._vehicle.landed and force != FORCE_REBOOT:
            return self._state.flavour.refuse_now
        self._state.reboot_asked = True
        return ACCEPTED

    def _set_source(self, command: Command, _now: float) -> int:
        if command.params[0] not in (1.0, 2.0, 3.0):
            return DENIED
        self._state.feed.source_set = int(command.params[0])
        return ACCEPTED

    def _hear_of_spoofing(self, command: Command, _now: float) -> int:
        """As ArduPilot's pull request 33167 has it; released firmware knows no such command."""
        if not self._state.hears_of_spoofing:
            return UNSUPPORTED
        spoofed, receiver = command.params[:2]
        if spoofed not in (0.0, 1.0) or receiver not in (0.0, 1.0):
            return DENIED
        if receiver == 0.0:
            self._state.feed.spoofed = bool(spoofed)
        return ACCEPTED
