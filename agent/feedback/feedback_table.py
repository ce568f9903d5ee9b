"""``[feedback]``: which drones' autopilots are given the estimate, as what, and within which limits."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from agent.config.fields import AgentId, Positive, Table

FeedbackKind = Literal["off", "odometry", "global", "gps_input"]
FEEDBACK_FITS: dict[FeedbackKind, tuple[str, ...]] = {
    "off": (),
    "odometry": ("px4", "ardupilot"),
    "global": ("px4",),
    "gps_input": ("ardupilot",),
}
"""Which autopilots read what."""


class FeedbackTable(Table, frozen=True):
    """``[feedback]``: the estimate for the autopilot, for when its GPS is lost (docs/feedback.md)."""

    kind: FeedbackKind = "off"
    """As what it is given: ODOMETRY (PX4, ArduPilot), GLOBAL_POSITION_SENSOR (PX4 from 1.18 on), GPS_INPUT
    (ArduPilot); off = not at all."""
    agents: tuple[AgentId, ...] | None = None
    """Whose autopilots get it; absent = all."""
    max_horizontal_m: Positive = 3.0
    """With a horizontal protection level above, nothing is fed."""
    max_vertical_m: Positive = 6.0
    """The same of the vertical one."""
    max_step_m: Positive = 1.0
    """The position is corrected by no more than this in a second, or a reset is announced with it."""
    agree_s: Annotated[float, msgspec.Meta(ge=1, le=600)] = 5.0
    """For how long the estimate must be good, and agree with the autopilot's own position by GPS, before it is fed;
    and a returned GPS with the estimate before it is handed back."""
    gps_id: Annotated[int, msgspec.Meta(ge=0, le=1)] = 1
    """Which of the autopilot's receivers GPS_INPUT is, from 0; what comes back of that one is not listened to."""
    switch_source: bool = False
    """Switch ArduPilot to its source set 2 when GPS is lost, and back to 1 after (MAV_CMD_SET_EKF_SOURCE_SET);
    without, the pilot does."""
    tell_spoofing: bool = False
    """Tell ArduPilot that its receiver is off where the fleet knows it (MAV_CMD_USER_1, as its pull request 33167 has
    it); where it acknowledges, the estimate is fed. The ground station is told in any case."""
