"""Velocities that other sensors than the receiver measured, in messages of companions and of the autopilot.

A velocity that the autopilot's filter, or another one, made of fixes is no measurement of its own: it is left out and
counted, by the component that says it and by the estimator type. Optical flow is a sensor's, whoever passes it on.
Our own frames are left out before they come here.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

from agent.mavlink.codec import Message, mavlink
from agent.mavlink.utc_stamps import UtcStamps, clocks_agree
from agent.sensing.frames import normalised, rotated
from agent.sensing.samples import FlowSample, Triple, VelocitySample

SIGMA_MPS = 0.3
"""1-sigma where the message tells none."""
MAX_MPS = 200.0
FLOW_SIGMA_RADPS = 0.15, 0.5
"""1-sigma of flow of the best quality and of the worst, as PX4 takes it (EKF2_OF_N_MIN, EKF2_OF_N_MAX)."""
BEST_FLOW = 255
LONGEST_FLOW_S = 0.5
HOLD_S = 1.0
"""A message serves once those that are better have been silent for this long."""
MAX_STAMP_AGE_S, MAX_STAMP_LEAD_S = 5.0, 0.5
UNIX_US = 10**15
VELOCITY_MESSAGES = {
    mavlink.MAVLINK_MSG_ID_ODOMETRY: "odometry",
    mavlink.MAVLINK_MSG_ID_VISION_SPEED_ESTIMATE: "odometry",
    mavlink.MAVLINK_MSG_ID_OPTICAL_FLOW_RAD: "flow",
}
"""Messages that hold velocities, by id: the kind. The first of a kind is the best one."""
_PLACES = {message_id: place for place, message_id in enumerate(VELOCITY_MESSAGES)}
_NOT_MEASURED = {
    mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT: "an autopilot's estimate",
    mavlink.MAV_ESTIMATOR_TYPE_GPS: "made of fixes",
    mavlink.MAV_ESTIMATOR_TYPE_GPS_INS: "made of fixes",
}
_BODY = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)
_FAILED = -1
_VARIANCES_OF_SIX, _VARIANCES_OF_THREE = (0, 6, 11), (0, 4, 8)
"""Where the variances of a velocity stand in upper triangles of 6 x 6 and in 3 x 3."""

Velocity = VelocitySample | FlowSample


class VelocityAdapter:
    """The velocities of one system's components.

    ``received`` and ``skipped`` count messages by kind and by reason; fleet times of the autopilot's boot clock come
    from ``fleet_time_of_boot`` (boot time, arrival).
    """

    def __init__(self, epoch_unix_s: float, fleet_time_of_boot: Callable[[float, float], float | None]) -> None:
        self._epoch_unix_s = epoch_unix_s
        self._fleet_time_of_boot = fleet_time_of_boot
        self._heard_s: dict[str, dict[tuple[int, int], float]] = {}
        self._clocks: dict[int, UtcStamps] = {}
        self.received: Counter[str] = Counter()
        self.skipped: Counter[str] = Counter()

    def reset(self) -> None:
        """Forget the streams seen, as after a reboot."""
        self._heard_s.clear()
        self._clocks.clear()

    def convert(self, message: Message, arrival_s: float, component: int, *, of_autopilot: bool) -> Velocity | None:
        """The sample of one of the `VELOCITY_MESSAGES` of a component; ``None``, and counted, if it gives none."""
        kind = VELOCITY_MESSAGES[message.get_msgId()]
        self.received[kind] += 1
        if kind == "odometry" and of_autopilot:
            return self._skip("odometry: the autopilot's own")
        if message.get_msgId() == mavlink.MAVLINK_MSG_ID_OPTICAL_FLOW_RAD:
            made: Velocity | str = _flow(message)
        elif message.get_msgId() == mavlink.MAVLINK_MSG_ID_ODOMETRY:
            made = _odometry(message)
        else:
            told = (message.x, message.y, message.z)
            made = _sample(told, _sigmas(message.covariance, _VARIANCES_OF_THREE), in_body=False)
        if isinstance(made, str):
            return self._skip(f"{kind}: {made}")
        if not self._serves(kind, (_PLACES[message.get_msgId()], component), arrival_s):
            return self._skip(f"{kind}: a better one comes")
        time_usec = message.usec if hasattr(message, "usec") else message.time_usec
        stamped_s = self._stamp_s(time_usec, arrival_s, component)
        if not -MAX_STAMP_LEAD_S <= arrival_s - stamped_s <= MAX_STAMP_AGE_S:
            return self._skip(f"{kind}: wrong time")
        if isinstance(made, FlowSample):  # the stamp is of the end of what was integrated
            return FlowSample(stamped_s + made.t_s, made.passing_radps, made.sigma_radps, made.distance_m)
        return VelocitySample(stamped_s, made.velocity_mps, made.sigma_mps, made.in_body)

    def _serves(self, kind: str, place: tuple[int, int], arrival_s: float) -> bool:
        """Whether a message is the best of its kind that comes of late."""
        heard_s = self._heard_s.setdefault(kind, {})
        heard_s[place] = arrival_s
        return not any(better < place and arrival_s - at_s <= HOLD_S for better, at_s in heard_s.items())

    def _stamp_s(self, time_usec: int, arrival_s: float, component: int) -> float:
        """Fleet time of a stamp: Unix time, time since the autopilot's boot, or that of the component's own clock.

        The latter is put to where the quickest messages would have come at once.
        """
        if not time_usec:
            return arrival_s
        stamp_s = time_usec * 1e-6
        if time_usec <= UNIX_US:
            of_autopilot_s = self._fleet_time_of_boot(stamp_s, arrival_s)
            if of_autopilot_s is not None and clocks_agree(arrival_s - of_autopilot_s):
                return of_autopilot_s
        else:
            stamp_s -= self._epoch_unix_s
        shift_s = self._clocks.setdefault(component, UtcStamps()).shift_s(stamp_s, arrival_s)
        return arrival_s if shift_s is None else stamp_s + shift_s

    def _skip(self, reason: str) -> Velocity | None:
        self.skipped[reason] += 1
        return None


def _odometry(message: Message) -> VelocitySample | str:
    reason = _NOT_MEASURED.get(message.estimator_type)
    if reason is not None:
        return reason
    if message.quality == _FAILED:
        return "says that it failed"
    velocity, frame = (message.vx, message.vy, message.vz), message.child_frame_id
    sigma = _sigmas(message.velocity_covariance, _VARIANCES_OF_SIX)
    if frame in _BODY:
        return _sample(velocity, sigma, in_body=True)
    if frame == mavlink.MAV_FRAME_LOCAL_NED:
        return _sample(velocity, sigma, in_body=False)
    if frame == mavlink.MAV_FRAME_LOCAL_FRD and message.frame_id == frame:  # its heading is anything: to the body
        w, x, y, z = message.q
        attitude = normalised((w, -x, -y, -z))
        if attitude is None or not all(map(math.isfinite, velocity)):
            return "no attitude in its frame"
        return _sample(rotated(attitude, velocity), (max(sigma),) * 3, in_body=True)
    return "in no frame that is known"


def _sample(velocity: Triple, sigma: Triple, *, in_body: bool) -> VelocitySample | str:
    """A sample without its time; NaN in an axis means that it was not measured."""
    measured = [math.isfinite(value) for value in velocity]
    if not any(measured):
        return "not finite"
    if max(abs(value) for value in velocity if math.isfinite(value)) > MAX_MPS:
        return "out of range"
    x, y, z = (value if known else 0.0 for value, known in zip(velocity, measured, strict=True))
    a, b, c = (value if known else math.inf for value, known in zip(sigma, measured, strict=True))
    return VelocitySample(0.0, (x, y, z), (a, b, c), in_body)


def _sigmas(covariance: list[float], places: tuple[int, int, int]) -> Triple:
    """1-sigma per axis of a covariance on the wire, where it tells: NaN and zero say that it is not known."""
    a, b, c = (
        math.sqrt(covariance[at]) if math.isfinite(covariance[at]) and covariance[at] > 0.0 else SIGMA_MPS
        for at in places
    )
    return a, b, c


def _flow(message: Message) -> FlowSample | str:
    """OPTICAL_FLOW_RAD, its time that of the middle of what was integrated, from the stamp."""
    return integrated_flow(
        0.0,
        message.integration_time_us * 1e-6,
        (message.integrated_x, message.integrated_y),
        (message.integrated_xgyro, message.integrated_ygyro),
        message.quality,
        message.distance,
    )


def integrated_flow(
    end_s: float,
    duration_s: float,
    flow_rad: tuple[float, float],
    turned_rad: tuple[float, float],
    quality: float,
    distance_m: float,
) -> FlowSample | str:
    """What a flow sensor integrated until ``end_s`` about its axes x and y, and how far the body turned meanwhile.

    Gives why it tells nothing otherwise.
    """
    if not 0.0 < duration_s <= LONGEST_FLOW_S:
        return "integrated over no time"
    x, y = (each / duration_s for each in flow_rad)
    about_x, about_y = (each / duration_s for each in turned_rad)
    return flow_of(end_s - 0.5 * duration_s, (x, y), (about_x, about_y), quality, distance_m)


def flow_of(
    t_s: float,
    flow_radps: tuple[float, float],
    turning_radps: tuple[float, float],
    quality: float,
    distance_m: float = math.nan,
) -> FlowSample | str:
    """Rates about a sensor's axes x and y, as PX4 and ArduPilot have them; gives why they tell nothing otherwise.

    Turning about x to the right gives positive flow about x, moving along y negative flow; moving along x gives
    positive flow about y. ``quality`` from 0, nothing was seen, to 255; a distance that is NaN or 0 was not measured.
    """
    if not all(map(math.isfinite, (*flow_radps, *turning_radps))):
        return "not finite"
    if not quality > 0.0:
        return "no quality"
    forward, right = flow_radps[1] - turning_radps[1], turning_radps[0] - flow_radps[0]
    best, worst = FLOW_SIGMA_RADPS
    sigma = worst + (best - worst) * min(quality / BEST_FLOW, 1.0)
    known = math.isfinite(distance_m) and distance_m > 0.0
    return FlowSample(t_s, (forward, right), sigma, distance_m if known else None)
