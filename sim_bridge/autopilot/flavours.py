"""What tells a PX4 from an ArduPilot on the wire: streams, refusals, modes, parameters."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from agent.mavlink.dialect import mavlink
from sim_bridge.world.noise import FlavourName


class FlightMode(Enum):
    """What the vehicle is doing, as far as the simulator distinguishes."""

    HOLD = "hold"
    MISSION = "mission"
    """Flies the scenario's path."""
    GUIDED = "guided"
    TAKEOFF = "takeoff"
    LAND = "land"


@dataclass(frozen=True, slots=True)
class Parameter:
    """An autopilot parameter; integers are whole numbers in ``value``."""

    value: float
    integer: bool = True


@dataclass(frozen=True, slots=True)
class Flavour:
    """One family of autopilots.

    ``default_rates_hz`` by message id: all that can be streamed, zero = only when asked.
    ``interval_quantum_us`` and ``max_rate_hz`` limit what SET_MESSAGE_INTERVAL gives. ``refuse_stream``
    answers a request for a message that cannot be streamed, ``refuse_now`` a command that does not fit the
    vehicle's state.
    """

    name: FlavourName
    autopilot: int
    default_rates_hz: dict[int, float]
    interval_quantum_us: int
    max_rate_hz: float
    refuse_stream: int
    refuse_now: int
    timesync_request_s: float
    integers_bytewise: bool
    """Integer parameters travel as the bytes of an int32 in the float (PX4), not as its value."""
    modes: dict[FlightMode, int]
    """Mode to ``custom_mode``."""
    capabilities: int
    software_version: int
    parameters: dict[str, Parameter]
    takeoff_height_parameter: str | None = None

    def mode_of(self, custom_mode: int) -> FlightMode | None:
        """The mode a ``custom_mode`` stands for, if it is one of ours."""
        return next((mode for mode, number in self.modes.items() if number == custom_mode), None)


def px4_mode(main: int, sub: int = 0) -> int:
    """PX4's ``custom_mode``: main mode in bits 16-23, sub mode in bits 24-31."""
    return main << 16 | sub << 24


PX4 = Flavour(
    name="px4",
    autopilot=mavlink.MAV_AUTOPILOT_PX4,
    default_rates_hz={
        mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU: 0.0,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 1.0,
        mavlink.MAVLINK_MSG_ID_ATTITUDE: 50.0,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
        mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 2.0,
        mavlink.MAVLINK_MSG_ID_ODOMETRY: 30.0,
        mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: 0.0,
    },
    interval_quantum_us=1,
    max_rate_hz=1000.0,
    refuse_stream=mavlink.MAV_RESULT_FAILED,
    refuse_now=mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    timesync_request_s=0.1,
    integers_bytewise=True,
    modes={
        FlightMode.HOLD: px4_mode(4, 3),
        FlightMode.MISSION: px4_mode(4, 4),
        FlightMode.GUIDED: px4_mode(6),
        FlightMode.TAKEOFF: px4_mode(4, 2),
        FlightMode.LAND: px4_mode(4, 6),
    },
    capabilities=(
        mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    ),
    software_version=0x011200FF,
    parameters={
        "MAV_SYS_ID": Parameter(1),
        "MIS_TAKEOFF_ALT": Parameter(2.5, integer=False),
        "EKF2_EV_CTRL": Parameter(7),
        "EKF2_EV_DELAY": Parameter(0.0, integer=False),
        "EKF2_DELAY_MAX": Parameter(300.0, integer=False),
        "EKF2_EV_NOISE_MD": Parameter(0),
        "EKF2_EV_QMIN": Parameter(0),
        "EKF2_GPS_CTRL": Parameter(7),
        "EKF2_AGP0_ID": Parameter(1),
        "EKF2_AGP0_CTRL": Parameter(1),
        "EKF2_AGP0_NOISE": Parameter(1.0, integer=False),
        "EKF2_AGP0_DELAY": Parameter(150.0, integer=False),
        "EKF2_HGT_REF": Parameter(1),
        "SIM_GPS_USED": Parameter(10),
    },
    takeoff_height_parameter="MIS_TAKEOFF_ALT",
)
"""PX4 1.18 on an onboard link: it streams by itself."""

ARDUPILOT = Flavour(
    name="ardupilot",
    autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    default_rates_hz=dict.fromkeys(
        (
            mavlink.MAVLINK_MSG_ID_SYS_STATUS,
            mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
            mavlink.MAVLINK_MSG_ID_RAW_IMU,
            mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
            mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
            mavlink.MAVLINK_MSG_ID_ATTITUDE,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
            mavlink.MAVLINK_MSG_ID_HOME_POSITION,
            mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
            mavlink.MAVLINK_MSG_ID_SIM_STATE,
            mavlink.MAVLINK_MSG_ID_SIMSTATE,
        ),
        0.0,
    ),
    interval_quantum_us=1000,
    max_rate_hz=320.0,
    refuse_stream=mavlink.MAV_RESULT_DENIED,
    refuse_now=mavlink.MAV_RESULT_FAILED,
    timesync_request_s=10.0,
    integers_bytewise=False,
    modes={
        FlightMode.HOLD: 5,
        FlightMode.MISSION: 3,
        FlightMode.GUIDED: 4,
        FlightMode.LAND: 9,
    },
    capabilities=(
        mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
        | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    ),
    software_version=0x04060000,
    parameters={
        "SYSID_THISMAV": Parameter(1),
        "GPS1_TYPE": Parameter(1),
        "GPS2_TYPE": Parameter(14),
        "SIM_GPS1_ENABLE": Parameter(1),
        "GPS_AUTO_SWITCH": Parameter(4),
        "VISO_TYPE": Parameter(1),
        "VISO_POS_M_NSE": Parameter(0.2, integer=False),
        "VISO_VEL_M_NSE": Parameter(0.1, integer=False),
        "VISO_QUAL_MIN": Parameter(0),
        "VISO_DELAY_MS": Parameter(150),
        "EK3_SRC1_POSXY": Parameter(3),
        "EK3_SRC2_POSXY": Parameter(6),
        "EK3_SRC2_VELXY": Parameter(6),
        "EK3_SRC2_POSZ": Parameter(1),
        "EK3_SRC2_YAW": Parameter(1),
    },
)
"""ArduCopter 4.6 without HIGHRES_IMU, its stream groups (SRx) at zero: nothing comes unless asked for."""

FLAVOURS: dict[FlavourName, Flavour] = {"px4": PX4, "ardupilot": ARDUPILOT}

STREAM_GROUPS: dict[int, tuple[int, ...]] = {
    mavlink.MAV_DATA_STREAM_RAW_SENSORS: (
        mavlink.MAVLINK_MSG_ID_RAW_IMU,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
    ),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: (
        mavlink.MAVLINK_MSG_ID_SYS_STATUS,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
    ),
    mavlink.MAV_DATA_STREAM_POSITION: (
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    ),
    mavlink.MAV_DATA_STREAM_EXTRA1: (mavlink.MAVLINK_MSG_ID_ATTITUDE,),
    mavlink.MAV_DATA_STREAM_EXTRA3: (
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
        mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    ),
}
"""ArduPilot's groups of REQUEST_DATA_STREAM, as far as we have their messages."""
