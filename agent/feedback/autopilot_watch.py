"""Where an autopilot believes it is and whether its estimator says that it is well, out of its messages. Sans-I/O.

To compare and to be told of, never a measurement: what is fed comes back in these messages.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from agent.mavlink.codec import Message, mavlink
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import AutopilotEstimate, GpsSample, Triple
from estimators.model.measurements import Vector

KEPT_S = 2.0
"""Own positions are kept for so long, to be compared with estimates of their instant."""
NEAR_S = 0.3
"""An own position of more than this beside an instant says nothing of it."""
SAME_PLACE_M = 2.0
"""Local and global position of an autopilot are no further apart than this, or it flies by another origin."""
AFAR_S = 1.0
"""So long must they be apart before it is believed."""
MOVED_M = 0.05
"""An origin that comes again no further off is the same."""
TEXTS_KEPT = 8
AIDED_FLAGS = mavlink.ESTIMATOR_PRED_POS_HORIZ_REL | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
"""An aided estimator has one of them; both autopilots use the same bits."""


@dataclass(frozen=True, slots=True)
class EstimatorWord:
    """What the autopilot's estimator said of itself, by host time: flags, and how much of the gate the innovations of
    horizontal position use (above 1 they are refused)."""

    host_s: float
    flags: int
    position_ratio: float

    @property
    def aided(self) -> bool:
        """Whether it has horizontal positions."""
        return bool(self.flags & AIDED_FLAGS)


class AutopilotWatch:
    """Follows one autopilot; ``origin_m`` is where its local positions count from, in the fleet frame."""

    def __init__(self, frame: FleetFrame) -> None:
        self._frame = frame
        self.reset()

    def reset(self) -> None:
        """Forget everything, as after a reboot."""
        self.origin_m: Triple | None = None
        self.origin_fault = ""
        """Why an origin that came cannot be used."""
        self.moves = 0
        """How often another origin came than before."""
        self.word: EstimatorWord | None = None
        self.fix: GpsSample | None = None
        self.texts: deque[tuple[float, str]] = deque(maxlen=TEXTS_KEPT)
        """Its latest texts of warning or worse, with the host time."""
        self._own: deque[AutopilotEstimate] = deque()
        self._apart_since_s: float | None = None
        self.apart_m = 0.0
        """How far its local and global positions are apart by the origin that we know."""

    # --- what comes in ------------------------------------------------------------------------------------------

    def on_message(self, message: Message, host_s: float) -> None:
        """A message of the autopilot."""
        match message.get_msgId():
            case mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
                self._on_origin(message)
            case mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS:
                self.word = EstimatorWord(host_s, message.flags, message.pos_horiz_ratio)
            case mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT:
                self.word = EstimatorWord(host_s, message.flags, message.pos_horiz_variance)
            case mavlink.MAVLINK_MSG_ID_STATUSTEXT:
                if message.severity <= mavlink.MAV_SEVERITY_WARNING:
                    self.texts.append((host_s, str(message.text)))

    def on_own(self, own: AutopilotEstimate) -> None:
        """Its own local position (LOCAL_POSITION_NED)."""
        self._own.append(own)
        while own.t_s - self._own[0].t_s > KEPT_S:
            self._own.popleft()

    def on_global(self, message: Message, t_s: float, host_s: float) -> None:
        """Its GLOBAL_POSITION_INT of fleet time ``t_s``: is the origin still the one that it flies by?"""
        height_m = self._frame.height(message.alt * 1e-3, None)
        own = self.own_at(t_s)
        nowhere = message.lat == 0 and message.lon == 0  # ArduPilot's, while it has no position
        if height_m is None or own is None or nowhere or not _on_earth(message.lat, message.lon):
            return
        north, east, _ = self._frame.ned(message.lat * 1e-7, message.lon * 1e-7, height_m)
        self.apart_m = math.hypot(north - own[0], east - own[1])
        if self.apart_m <= SAME_PLACE_M:
            self._apart_since_s = None
        elif self._apart_since_s is None:
            self._apart_since_s = host_s

    def on_fix(self, fix: GpsSample) -> None:
        """A fix of its receiver."""
        self.fix = fix

    # --- what is known ------------------------------------------------------------------------------------------

    def own_at(self, t_s: float) -> Vector | None:
        """Its own position at fleet time ``t_s`` in the fleet frame, ``(3,)``; ``None`` if it cannot be told."""
        if self.origin_m is None or not self._own:
            return None
        own = min(self._own, key=lambda each: abs(each.t_s - t_s))
        if abs(own.t_s - t_s) > NEAR_S:
            return None
        return np.array(self.origin_m) + own.position_m + (t_s - own.t_s) * np.array(own.velocity_mps)

    def origin_is_wrong(self, host_s: float) -> bool:
        """Whether it no longer flies by the origin that we know."""
        return self._apart_since_s is not None and host_s - self._apart_since_s >= AFAR_S

    def _on_origin(self, message: Message) -> None:
        height_m = self._frame.height(message.altitude * 1e-3, None)
        if height_m is None:
            self.origin_fault = "sensors.geoid_separation_m is needed for its height"
            return
        if not _on_earth(message.latitude, message.longitude):
            self.origin_fault = "it is no place on earth"
            return
        self.origin_fault = ""
        origin_m = self._frame.ned(message.latitude * 1e-7, message.longitude * 1e-7, height_m)
        if self.origin_m is not None and math.dist(origin_m, self.origin_m) > MOVED_M:
            self.moves += 1
        elif self.origin_m is not None:
            return
        self.origin_m = origin_m


def _on_earth(lat_e7: int, lon_e7: int) -> bool:
    return abs(lat_e7) <= 900_000_000 and abs(lon_e7) <= 1_800_000_000
