"""A first configuration as text, with the comments that its reader needs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Literal

Autopilot = Literal["px4", "ardupilot", "auto"]
Module = Literal["none", "linktrack", "uci", "dwm1001", "dwm3001-cli"]
RadioKind = Literal["wired", "mixed", "lossy_radio"]
FIRST_PORT = 14_550
"""`{port}` in a link is this plus the drone's id."""

_RADIO: dict[RadioKind, tuple[str, ...]] = {
    "wired": ('link = "tcp"',),
    "mixed": ('link = "multilink"', "open_timeout_s = 1.0", "retry_max_s = 0.5"),
    "lossy_radio": ('link = "udp"', "open_timeout_s = 0.5", "retry_max_s = 0.3"),
}
"""As in configs/links."""


@dataclass(frozen=True, slots=True)
class NewFleet:
    """What `fleetloc init` is told.

    ``link`` is an autopilot's address, ``address`` a drone's on the radio; in both ``{id}`` is the drone's id, and in
    the first ``{port}`` a port of its own. Without ``address`` all daemons are on this computer.
    """

    name: str
    drones: int
    lat_deg: float
    lon_deg: float
    alt_m: float
    autopilot: Autopilot = "auto"
    link: str = "udpin:127.0.0.1:{port}"
    uwb: Module = "none"
    radio: RadioKind = "wired"
    address: str | None = None
    feedback: bool = False


def as_toml(fleet: NewFleet, file_name: str) -> str:
    """The configuration of a new fleet; nothing in it has been checked."""
    parts = [
        f"# Written by `fleetloc init`. Check it: `fleetloc check {file_name}`. All keys: docs/configuration.md.",
        "",
        "[fleet]",
        f"name = {_quoted(fleet.name)}",
        "# In the middle of the field: all positions count from here. alt_m is above mean sea level.",
        f"origin = {{ lat_deg = {fleet.lat_deg}, lon_deg = {fleet.lon_deg}, alt_m = {fleet.alt_m} }}",
    ]
    parts += ["", "# A drone's id is the MAVLink system id of its autopilot, delivered as 1: change it there."]
    for agent_id in range(1, fleet.drones + 1):
        parts += [*([""] if agent_id > 1 else []), *_agent(fleet, agent_id)]
    parts += ["", *_uwb(fleet, file_name)]
    parts += ["", "[transport]", *_RADIO[fleet.radio]]
    if fleet.feedback:
        parts += [
            "",
            "# The estimate for the autopilots, for when their GPS is lost. Read docs/feedback.md first.",
            "[feedback]",
            'kind = "odometry"',
        ]
    parts += [
        "",
        "# For the desk. Before the fleet flies: delete this table, then `fleetloc keys init` (docs/security.md).",
        "[security]",
        'mode = "unsigned"',
    ]
    return "\n".join(parts) + "\n"


def next_steps(fleet: NewFleet, file_name: str) -> list[str]:
    """What to do with it, one command a line."""
    steps = [
        f"fleetloc check {file_name}",
        f"fleetloc fleet {file_name} --lockstep --duration 20 --out out/first    # in the simulator",
        f"fleetloc doctor {file_name} --id 1    # on drone 1, its autopilot on",
    ]
    if fleet.uwb != "none":
        steps.append(f"fleetloc uwb {fleet.uwb} auto {file_name} --id 1    # on drone 1, beside its daemon")
    return [*steps, f"fleetloc agent {file_name} --id 1 --out records    # on drone 1"]


def _agent(fleet: NewFleet, agent_id: int) -> list[str]:
    lines = [
        "[[agents]]",
        f"id = {agent_id}",
        f"autopilot = {_quoted(fleet.autopilot)}",
        f"mavlink = {_quoted(_filled(fleet.link, agent_id))}",
    ]
    if fleet.address is not None:
        lines.append(f"radio = {_quoted(_filled(fleet.address, agent_id))}")
    return lines


def _uwb(fleet: NewFleet, file_name: str) -> list[str]:
    if fleet.uwb == "none":
        return ["# Without UWB modules a drone that loses GPS is not held by its neighbours."]
    lines = [f"# Ranges come from `fleetloc uwb {fleet.uwb} PORT {file_name} --id I`, beside each daemon."]
    if fleet.uwb == "dwm3001-cli":
        lines += ["# Initiator and responder report the same exchange.", "[estimator]"]
        lines.append('reciprocal_ranges = "shared"')
    return lines


def _filled(pattern: str, agent_id: int) -> str:
    return pattern.replace("{id}", str(agent_id)).replace("{port}", str(FIRST_PORT + agent_id))


def _quoted(text: str) -> str:
    """A TOML string of one line; quotes and control characters escaped as in JSON."""
    return json.dumps(text, ensure_ascii=False)
