"""What a simulated autopilot says of the truth of its own simulator, as the real SITLs say it.

ArduPilot has SIM_STATE and SIMSTATE, PX4 has HIL_STATE_QUATERNION. None of them carries a usable time: the first
two have no stamp, the third sends zero.
"""

from __future__ import annotations

from dataclasses import dataclass

from agent.mavlink.dialect import mavlink
from sim_bridge.autopilot.mavlink_wire import STANDARD_GRAVITY_MPS2, Message, int16, millimetres
from sim_bridge.world.quaternions import Array, to_euler


@dataclass(frozen=True, slots=True)
class TrueState:
    """A vehicle as it really is.

    ``position_m`` and ``velocity_mps`` ``(3,)`` NED in the fleet frame, ``quaternion`` ``(4,)`` w x y z body FRD
    into NED, ``force_mps2`` (specific force) and ``rates_rps`` ``(3,)`` body.
    """

    position_m: Array
    velocity_mps: Array
    quaternion: Array
    force_mps2: Array
    rates_rps: Array


Geodetic = tuple[float, float, float]
"""Latitude and longitude in deg, height above mean sea level in m."""


def _motion(state: TrueState) -> tuple[float, ...]:
    angles = (float(angle) for angle in to_euler(state.quaternion))
    return (*angles, *(float(axis) for axis in state.force_mps2), *(float(axis) for axis in state.rates_rps))


def sim_state(state: TrueState, place: Geodetic) -> Message:
    """SIM_STATE: its float latitude and longitude are coarse (0.4 m), the integer ones are exact."""
    lat_deg, lon_deg, alt_m = place
    return mavlink.MAVLink_sim_state_message(
        *(float(part) for part in state.quaternion),
        *_motion(state),
        lat_deg,
        lon_deg,
        alt_m,
        0.0,
        0.0,
        *(float(axis) for axis in state.velocity_mps),
        lat_int=round(1e7 * lat_deg),
        lon_int=round(1e7 * lon_deg),
    )


def simstate(state: TrueState, place: Geodetic) -> Message:
    """SIMSTATE: no height and no velocity."""
    lat_deg, lon_deg, _ = place
    return mavlink.MAVLink_simstate_message(*_motion(state), round(1e7 * lat_deg), round(1e7 * lon_deg))


def hil_state_quaternion(state: TrueState, place: Geodetic) -> Message:
    """HIL_STATE_QUATERNION with the time of zero that PX4 sends."""
    lat_deg, lon_deg, alt_m = place
    return mavlink.MAVLink_hil_state_quaternion_message(
        0,
        [float(part) for part in state.quaternion],
        *(float(axis) for axis in state.rates_rps),
        round(1e7 * lat_deg),
        round(1e7 * lon_deg),
        millimetres(alt_m),
        *(int16(100.0 * float(axis)) for axis in state.velocity_mps),
        0,
        0,
        *(int16(1000.0 * float(axis) / STANDARD_GRAVITY_MPS2) for axis in state.force_mps2),
    )
