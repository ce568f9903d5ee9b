"""``[integrity]``: alert limits, and what bounds the sensors certainly keep."""

from __future__ import annotations

from agent.config.fields import Positive, Table


class IntegrityTable(Table, frozen=True):
    """``[integrity]``: what is promised of positions, and to whom (docs/integrity.md)."""

    alert_horizontal_m: Positive = 4.0
    """Largest horizontal error that whoever uses the position can do with; a protection level above is an alert."""
    alert_vertical_m: Positive = 6.0
    """The same of the height."""
    exclude: bool = True
    """Whether fixes of a receiver, and ranges, that are named as off never reach the estimator. Without, they are
    told of, and the estimator weighs them by its own residuals."""
    position_bound_m: Positive | None = None
    """Hard bound of a fix, north and east, for the guaranteed sets; absent = ``sensors.gps_position_half_width_m``,
    or none: then fixes say nothing for certain."""
    height_bound_m: Positive | None = None
    """The same of its height; absent = ``position_bound_m``."""
    velocity_bound_mps: Positive | None = None
    """Hard bound of a fix's velocity, per axis; absent = ``sensors.gps_speed_half_width_mps`` or none."""
    range_bound_m: Positive | None = None
    """Hard bound of a range; absent = ``sensors.uwb_bound_m`` or none."""
    acceleration_bound_mps2: Positive | None = None
    """No drone accelerates by more; absent = not known, and velocities say nothing of the way between two ticks.
    ``estimator.limits.vehicle.speed_mps`` bounds that way besides."""
