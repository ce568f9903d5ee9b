"""Which component of a system is its autopilot.

Gimbals, cameras, payloads and companions share its system id, and the heartbeats of some look like a vehicle's: with
the autopilot's kind, or with a vehicle's type. An autopilot is what has sensors, as a rule under component id 1.
"""

from __future__ import annotations

from collections.abc import Collection

from agent.mavlink.codec import Message, mavlink

AUTOPILOT_COMPONENT = mavlink.MAV_COMP_ID_AUTOPILOT1
FLAVOURS = {mavlink.MAV_AUTOPILOT_PX4: "px4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot"}
_NOT_VEHICLES = frozenset(
    getattr(mavlink, f"MAV_TYPE_{name}")
    for name in (
        "GCS", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB", "CAMERA", "ANTENNA_TRACKER", "CHARGING_STATION", "FLARM",
        "SERVO", "ODID", "BATTERY", "PARACHUTE", "LOG", "OSD", "IMU", "GPS", "WINCH", "ILLUMINATOR", "GRIPPER",
    )
    if hasattr(mavlink, f"MAV_TYPE_{name}")
)  # fmt: skip
SENSORS = {
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: "imu",
    mavlink.MAVLINK_MSG_ID_RAW_IMU: "imu",
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: "imu",
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2: "imu",
    mavlink.MAVLINK_MSG_ID_SCALED_IMU3: "imu",
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: "attitude",
    mavlink.MAVLINK_MSG_ID_ATTITUDE: "attitude",
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: "gps",
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: "gps",
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: "baro",
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE2: "baro",
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE3: "baro",
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: "ground",
}
"""Messages that show that their sender has sensors, by id: the kind."""

Standing = tuple[bool, bool, int, bool, bool]
"""How much speaks for a component; the greater, the more."""


def speaks_for_vehicle(heartbeat: Message) -> bool:
    """Whether a heartbeat may be that of an autopilot."""
    return heartbeat.autopilot != mavlink.MAV_AUTOPILOT_INVALID and heartbeat.type not in _NOT_VEHICLES


def standing(component_id: int, kinds: Collection[str], flavours: Collection[str]) -> Standing:
    """What speaks for a component as the autopilot: the kinds of `SENSORS` that it sends, what it says it is.

    Component 1 with any sensor is it. A gimbal has an IMU and an attitude as well, but no receiver.
    """
    first = component_id == AUTOPILOT_COMPONENT
    known = any(flavour in FLAVOURS.values() for flavour in flavours)
    return first and bool(kinds), "gps" in kinds, len(kinds), first, known
