"""The messages that an autopilot streams, built from its state and its vehicle's sensors at one moment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from agent.mavlink.dialect import mavlink
from sim_bridge.autopilot import mavlink_wire as wire
from sim_bridge.autopilot.mavlink_wire import Message
from sim_bridge.autopilot.state import AutopilotState, AutopilotVehicle
from sim_bridge.autopilot.truth_messages import Geodetic, TrueState, hil_state_quaternion, sim_state, simstate
from sim_bridge.world import quaternions
from sim_bridge.world.sensors import SensedAttitude

SENSORS_PRESENT = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
)
EKF_ATTITUDE_ONLY, EKF_ALL_GOOD = 0x25, 0x33F
BATTERY_MV, BATTERY_PERCENT = 16000, 80

Builder = Callable[[float], Message | None]


class StreamMessages:
    """Builds the messages; ``None`` where the autopilot has nothing to say yet."""

    def __init__(
        self, state: AutopilotState, vehicle: AutopilotVehicle, unix_offset_s: float, system_id: int
    ) -> None:
        """``unix_offset_s``: Unix time minus the clock of ``now``."""
        self._state, self._vehicle, self._unix_offset_s = state, vehicle, unix_offset_s
        self._system_id = system_id
        self._builders: dict[int, Builder] = {
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: self._system_time,
            mavlink.MAVLINK_MSG_ID_SCALED_IMU: lambda now: wire.scaled_imu(self._ms(now), vehicle.imu()),
            mavlink.MAVLINK_MSG_ID_SCALED_IMU2: lambda now: wire.scaled_imu2(self._ms(now), vehicle.imu()),
            mavlink.MAVLINK_MSG_ID_RAW_IMU: lambda now: wire.raw_imu(self._us(now), vehicle.imu()),
            mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: lambda now: wire.highres_imu(self._us(now), vehicle.imu()),
            mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: lambda now: wire.scaled_pressure(self._ms(now), vehicle.imu()),
            mavlink.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position,
            mavlink.MAVLINK_MSG_ID_ODOMETRY: self._odometry,
            mavlink.MAVLINK_MSG_ID_HOME_POSITION: self._home,
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._origin,
            mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: self._estimator_status,
            mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: self._ekf_status,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended_state,
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._version,
            mavlink.MAVLINK_MSG_ID_SIM_STATE: lambda _now: self._truth(sim_state),
            mavlink.MAVLINK_MSG_ID_SIMSTATE: lambda _now: self._truth(simstate),
            mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: lambda _now: self._truth(hil_state_quaternion),
        }

    def build(self, message_id: int, now: float) -> Message | None:
        """The message as of now; ``None`` if there is none."""
        builder = self._builders.get(message_id)
        return None if builder is None else builder(now)

    def offers(self, message_id: int) -> bool:
        """Whether this autopilot can send the message at all when asked once."""
        always = message_id in (
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        )
        return always or message_id in self._state.flavour.default_rates_hz

    def heartbeat(self) -> Message:
        """HEARTBEAT of a quadrotor, flying or standing by."""
        state = self._state
        base_mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if state.armed:
            base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR,
            state.flavour.autopilot,
            base_mode,
            state.flavour.modes.get(state.mode, 0),
            mavlink.MAV_STATE_ACTIVE if state.armed else mavlink.MAV_STATE_STANDBY,
            3,
        )

    def _us(self, now: float) -> int:
        return self._state.clock.us(now)

    def _ms(self, now: float) -> int:
        return self._state.clock.ms(now)

    def _sys_status(self, _now: float) -> Message:
        sensors = SENSORS_PRESENT
        return mavlink.MAVLink_sys_status_message(
            sensors, sensors, sensors, 200, BATTERY_MV, 1000, BATTERY_PERCENT, 0, 0, 0, 0, 0, 0
        )

    def _system_time(self, now: float) -> Message:
        # Unix time comes with the GPS: zero until the first fix, as in the recorded flights
        known = self._state.navigation.origin_m is not None
        unix_us = round(1e6 * (now + self._unix_offset_s)) if known else 0
        return mavlink.MAVLink_system_time_message(unix_us, self._ms(now))

    def _attitude_now(self) -> SensedAttitude:
        return self._state.navigation.attitude(self._vehicle.attitude())

    def _attitude(self, now: float) -> Message:
        return wire.attitude_euler(self._ms(now), self._attitude_now())

    def _attitude_quaternion(self, now: float) -> Message:
        return wire.attitude_quaternion(self._ms(now), self._attitude_now())

    def _local_position(self, now: float) -> Message | None:
        navigation = self._state.navigation
        if navigation.origin_m is None:
            return None
        position_m = navigation.position_m - navigation.origin_m
        return wire.local_position_ned(self._ms(now), position_m, navigation.velocity_mps)

    def _global_position(self, now: float) -> Message | None:
        state, navigation = self._state, self._state.navigation
        if navigation.origin_m is None:
            if state.flavour.name == "px4":
                return None
            # ArduPilot sends zeros while it has no position
            return wire.global_position_int(self._ms(now), (0.0, 0.0, 0.0), 0.0, np.zeros(3), 0.0)
        home_m = navigation.origin_m if state.home_m is None else state.home_m
        _, _, heading_rad = quaternions.to_euler(self._attitude_now().quaternion)
        return wire.global_position_int(
            self._ms(now),
            state.geodetic(navigation.position_m),
            float(home_m[2] - navigation.position_m[2]),
            navigation.velocity_mps,
            heading_rad,
        )

    def _odometry(self, now: float) -> Message | None:
        navigation = self._state.navigation
        if navigation.origin_m is None:
            return None
        attitude = self._attitude_now()
        inverse = quaternions.conjugate(attitude.quaternion[None])
        velocity_body = quaternions.rotate(inverse, navigation.velocity_mps[None])[0]
        return wire.odometry(self._us(now), navigation.position_m - navigation.origin_m, velocity_body, attitude)

    def _home(self, now: float) -> Message | None:
        state = self._state
        if state.home_m is None or state.navigation.origin_m is None:
            return None
        return wire.home_position(
            state.geodetic(state.home_m),
            state.home_m - state.navigation.origin_m,
            self._attitude_now().quaternion,
            self._us(now),
        )

    def _origin(self, now: float) -> Message | None:
        origin_m = self._state.navigation.origin_m
        if origin_m is None:
            return None
        return wire.gps_global_origin(self._state.geodetic(origin_m), self._us(now))

    def _flags(self, now: float) -> tuple[int, float]:
        """EKF_STATUS flags and test ratio; ESTIMATOR_STATUS uses the same bits for what we simulate."""
        navigation = self._state.navigation
        return (EKF_ALL_GOOD if navigation.aided(now) else EKF_ATTITUDE_ONLY), navigation.ratio(now)

    def _estimator_status(self, now: float) -> Message:
        flags, ratio = self._flags(now)
        return mavlink.MAVLink_estimator_status_message(
            self._us(now), flags, ratio, ratio, ratio, 0.1, 0.0, 0.0, ratio, ratio
        )

    def _ekf_status(self, now: float) -> Message:
        flags, ratio = self._flags(now)
        return mavlink.MAVLink_ekf_status_report_message(flags, ratio, ratio, ratio, 0.1, 0.0)

    def _extended_state(self, _now: float) -> Message:
        states = (mavlink.MAV_LANDED_STATE_IN_AIR, mavlink.MAV_LANDED_STATE_ON_GROUND)
        return mavlink.MAVLink_extended_sys_state_message(
            mavlink.MAV_VTOL_STATE_UNDEFINED, states[self._vehicle.landed]
        )

    def _truth(self, message: Callable[[TrueState, Geodetic], Message]) -> Message:
        state = self._vehicle.true_state()
        return message(state, self._state.geodetic(state.position_m))

    def _version(self, _now: float) -> Message:
        flavour = self._state.flavour
        return wire.autopilot_version(flavour.capabilities, flavour.software_version, self._system_id)
