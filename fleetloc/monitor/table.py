"""The picture in a terminal, and as lines where the output is none."""

from __future__ import annotations

import time

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fleetloc.monitor.views import Alarm, Drone, Level, Link, Picture, Target

STYLES: dict[Level, str] = {"ok": "green", "info": "cyan", "warning": "yellow", "bad": "bold red"}
COLUMNS = (
    "drone",
    "status",
    "N m",
    "E m",
    "up m",
    "3 sigma horiz/vert m",
    "protection m",
    "age s",
    "GPS",
    "hears (age s, loss)",
    "tick p99 ms",
)
UNKNOWN = "?"
MAX_ALARMS = 12


def cells(drone: Drone, links: tuple[Link, ...]) -> tuple[str, ...]:
    """What is shown of a drone after its id and status; of one that is not heard what another has of it."""
    place = (UNKNOWN,) * 3
    position_m, age_s = drone.position_m, drone.estimate_age_s
    if position_m is None and drone.seen_by is not None:
        position_m, age_s = drone.seen_by.position_m, drone.seen_by.age_s
    if position_m is not None:
        north, east, down = position_m
        place = (f"{north:.1f}", f"{east:.1f}", f"{-down:.1f}")
    ellipse = drone.ellipse
    heard = (_heard(link) for link in links if link.receiver == drone.agent_id and link.age_s is not None)
    return (
        *place,
        UNKNOWN if ellipse is None else f"{ellipse.major_m:.2f}/{ellipse.up_m:.2f}",
        UNKNOWN if drone.protection_m is None else f"{drone.protection_m[0]:.1f}/{drone.protection_m[1]:.1f}",
        _number(age_s, 1.0),
        " ".join(part for part in (drone.gps, _gps_age(drone)) if part) or UNKNOWN,
        ", ".join(heard) or UNKNOWN,
        _number(drone.tick_p99_s, 1e3),
    )


def _gps_age(drone: Drone) -> str:
    return "" if drone.gps_age_s is None else f"{drone.gps_age_s:.1f} s"


def _number(value: float | None, scale: float) -> str:
    return UNKNOWN if value is None else f"{scale * value:.1f}"


def _heard(link: Link) -> str:
    loss = "" if link.loss is None else f", {100 * link.loss:.0f} %"
    return f"{link.sender} ({link.age_s:.1f}{loss})"


def table(picture: Picture, where: str) -> RenderableType:
    """The picture for a terminal; ``where`` the web page is."""
    shown = Table(title=f"{picture.fleet}  {_clock(picture.unix_s)} UTC  {where}", title_justify="left")
    for index, column in enumerate(COLUMNS):
        shown.add_column(column, justify="left" if index in (1, 8, 9) else "right")
    for drone in picture.drones:
        status = Text(drone.status, style=STYLES[drone.level])
        shown.add_row(_label(drone), status, *cells(drone, picture.links))
    alarms = [Text(f"{_alarm(picture, alarm)}", style=STYLES[alarm.level]) for alarm in picture.alarms[:MAX_ALARMS]]
    targets = [Text(_target(target)) for target in picture.targets]
    return Group(shown, *targets, *(alarms or [Text("no alarms", style="green")]))


def lines(picture: Picture) -> list[str]:
    """The picture for a log."""
    drones = [
        f"  drone {_label(drone)}: {drone.status}; "
        + "; ".join(f"{name} {cell}" for name, cell in zip(COLUMNS[2:], cells(drone, picture.links), strict=True))
        for drone in picture.drones
    ]
    alarms = [f"  {alarm.level}: {_alarm(picture, alarm)}" for alarm in picture.alarms]
    targets = [f"  {_target(target)}" for target in picture.targets]
    return [f"{picture.fleet} {_clock(picture.unix_s)} UTC", *drones, *targets, *alarms]


def _target(target: Target) -> str:
    label, seen, ellipse = f"target {target.target_id} {target.name}".strip(), target.seen_by, target.ellipse
    if seen is None or ellipse is None:
        return f"{label}: no drone has it"
    north, east, down = seen.position_m
    return (
        f"{label}: N {north:.1f} E {east:.1f} up {-down:.1f} m, 3 sigma {ellipse.major_m:.2f}/{ellipse.up_m:.2f} m, "
        f"age {seen.age_s:.1f} s, by drone {seen.agent_id}{target.state and ': ' + target.state}"
    )


def _label(drone: Drone) -> str:
    return f"{drone.agent_id} {drone.name}".strip()


def _alarm(picture: Picture, alarm: Alarm) -> str:
    who = f"drone {alarm.agent_id}" if alarm.agent_id else picture.fleet
    return f"{who}: {alarm.text} (since {_clock(alarm.since_unix_s)})"


def _clock(unix_s: float) -> str:
    return time.strftime("%H:%M:%S", time.gmtime(unix_s))
