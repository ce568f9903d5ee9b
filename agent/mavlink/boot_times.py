"""Boot times in messages: which show the autopilot's clock, and what becomes of those that wrap.

Stamps in milliseconds are 32 bits wide and begin anew every 49.7 days; so do some in microseconds, every 71.6 minutes
(RAW_IMU of ArduPilot up to 4.0). Which turn a stamp is of, the other messages tell.
"""

from __future__ import annotations

from agent.mavlink.codec import Message, mavlink

WRAP_US_S = 2**32 * 1e-6
WRAP_MS_S = 2**32 * 1e-3
NEAR_S = 30.0
"""A stamp whose turn brings it no nearer than this to where it should be was wrong, not wrapped."""
SHOW_MS = {
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 8,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 0,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: 0,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2: 0,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU3: 0,
}
"""Messages whose ``time_boot_ms`` is the boot clock, by id: where it is in the payload. In others (NAMED_VALUE_FLOAT)
it is whatever a script on board wrote."""


def shown_boot_s(message: Message) -> float | None:
    """The boot clock that a message shows, in s; ``None`` if it shows none."""
    return message.time_boot_ms * 1e-3 if message.get_msgId() in SHOW_MS else None


def turns(value_s: float, expected_s: float, wrap_s: float, near_s: float = NEAR_S) -> int:
    """How often a clock that wraps has done so, when it shows a value that should be about ``expected_s``.

    0 as well if no number of turns brings it as near to that as ``near_s``.
    """
    number = round((expected_s - value_s) / wrap_s)
    return number if number > 0 and abs(value_s + number * wrap_s - expected_s) <= near_s else 0
