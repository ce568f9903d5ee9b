"""What deserves a look: alarms out of what drones say, and out of their silence; sans-I/O.

An alarm is ``(key, level, text)``: the text may change with every second, the key says that it is still the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from estimators.estimator import Status
from estimators.integrity.thresholds import GPS_LOST_S
from fleetloc.monitor.views import Drone, Level
from transport.messages.report_body import Diagnostics

Found = tuple[str, Level, str]
GRAVE = ("not observable", "position unknown")
"""Begins of reasons that put the position itself in doubt."""
NO_GPS = "no GPS"
STATUS_TEXTS = {
    Status.NOT_CONVERGED: "solver did not converge",
    Status.FELL_BACK: "solver failed, pre-estimate shown",
    Status.NOT_OBSERVABLE: "not observable",
    Status.NO_DATA: "no data, prediction shown",
}
DISAGREEMENT_SIGMAS = 5.0
MIN_DISAGREEMENT_M = 1.0


@dataclass(frozen=True, slots=True)
class DroneFacts:
    """What alarms of a drone follow from; ``diagnostics`` only if they are fresh, ``status`` of a fresh estimate."""

    drone: Drone
    diagnostics: Diagnostics | None
    status: int | None
    left: bool


def alarms_of_drone(facts: DroneFacts) -> Iterator[Found]:
    """All alarms of one drone."""
    drone = facts.drone
    if drone.status == "unseen":
        yield "unseen", "info", "not seen yet"
        return
    if drone.status == "lost":
        heard = "" if drone.heard_age_s is None else f", last heard {_ago(drone.heard_age_s)}"
        yield "lost", "bad", f"lost: {'left or link broken' if facts.left else 'silent'}{heard}"
        return
    if drone.status == "stale":
        yield "stale", "warning", f"no estimate for {drone.estimate_age_s:.1f} s"
    yield from _reasons(facts)
    yield from _integrity(facts)
    yield from _gps(facts)
    yield from _disagreement(drone)


def _reasons(facts: DroneFacts) -> Iterator[Found]:
    """What the drone says of itself, and the status of its estimate where that says more."""
    diagnostics = facts.diagnostics
    reasons = () if diagnostics is None else diagnostics.reasons
    if diagnostics is None and facts.drone.status not in ("there", "stale"):
        yield "quiet", "warning", "no report of its state"
    if diagnostics is not None and diagnostics.state == "fault" and not reasons:
        yield "fault", "bad", "fault"
    for number, reason in enumerate(reasons):
        if reason == NO_GPS and facts.drone.gps_age_s is not None:
            continue  # said with its age
        yield reason.partition(":")[0], _level(facts, number, reason), reason
    if facts.status in STATUS_TEXTS and facts.drone.status != "init":
        status = Status(facts.status)
        said = f"estimate {status.name.lower().replace('_', ' ')}"
        if status is Status.NOT_OBSERVABLE:
            said = "not observable"
        if not any(reason.startswith(said) for reason in reasons):
            level: Level = "bad" if status is Status.NOT_OBSERVABLE else "warning"
            yield said, level, STATUS_TEXTS[status]


def _integrity(facts: DroneFacts) -> Iterator[Found]:
    """An alert of what is promised of the position, where none of the reasons says it already."""
    diagnostics = facts.diagnostics
    if diagnostics is None or not diagnostics.integrity.startswith("ALERT: "):
        return
    reason = diagnostics.integrity.removeprefix("ALERT: ")
    if reason not in diagnostics.reasons:
        yield "integrity", "warning", reason


def _level(facts: DroneFacts, number: int, reason: str) -> Level:
    """Of a reason; the first is the gravest. What a drone waits for before its first estimate is no alarm."""
    state = "" if facts.diagnostics is None else facts.diagnostics.state
    if state == "init":
        return "info"
    return "bad" if reason.startswith(GRAVE) or (state == "fault" and number == 0) else "warning"


def _gps(facts: DroneFacts) -> Iterator[Found]:
    age_s = facts.drone.gps_age_s
    if facts.diagnostics is not None and age_s is not None:
        reported_s = facts.diagnostics.gauges.get("gps_age_s", 0.0)  # without what the report has aged since
        if reported_s > GPS_LOST_S:
            fix = f", receiver says {facts.drone.gps}" if facts.drone.gps else ""
            yield "gps", "warning", f"no GPS fix for {age_s:.0f} s{fix}"


def _disagreement(drone: Drone) -> Iterator[Found]:
    """A neighbour has the drone elsewhere than it has itself, by more than both admit."""
    seen, place, ellipse = drone.seen_by, drone.position_m, drone.ellipse
    if seen is None or place is None or ellipse is None or drone.velocity_mps is None or drone.status == "stale":
        return
    apart_m = sum((a - b) ** 2 for a, b in zip(place, seen.position_m, strict=True)) ** 0.5
    own_sigma_m = (ellipse.major_m**2 + ellipse.minor_m**2 + ellipse.up_m**2) ** 0.5 / 3
    speed_mps = sum(v * v for v in drone.velocity_mps) ** 0.5
    moved_m = speed_mps * (seen.age_s + (drone.estimate_age_s or 0.0))
    if apart_m - moved_m > max(DISAGREEMENT_SIGMAS * (own_sigma_m**2 + seen.sigma_m**2) ** 0.5, MIN_DISAGREEMENT_M):
        yield "apart", "bad", f"drone {seen.agent_id} has it {apart_m:.1f} m from where it has itself"


def alarms_of_fleet(drones: Sequence[Drone], refused: int, refusals: Mapping[str, int]) -> Iterator[Found]:
    """Alarms that belong to no drone: nobody heard, and packets refused in the last seconds."""
    if all(drone.status == "unseen" for drone in drones):
        yield "nobody", "warning", "no drone heard: are the endpoints right, and is the radio in reach?"
    if refused:
        most = max(refusals, key=lambda reason: refusals[reason])
        hint = "; are this machine's clock and the drones' set?" if most == "stale" else ""
        yield "refused", "warning", f"{refused} packets refused in the last seconds, mostly {most}{hint}"


def _ago(age_s: float) -> str:
    return f"{age_s:.1f} s ago" if age_s < 100 else f"{age_s / 60:.0f} min ago"
