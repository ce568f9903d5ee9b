"""The ``[sitl]`` table: a fleet of autopilots in software-in-the-loop simulators and the bridge in front of them.

Noise, rate and seed of the synthesised ranges, the duration and GPS outages are those of ``[sim]``.
"""

from __future__ import annotations

from typing import Annotated

import msgspec


class SitlVehicle(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[sitl.vehicles]]``: where the simulated autopilot of one agent is."""

    agent: Annotated[int, msgspec.Meta(ge=1, le=999)]
    simulator: str
    """Address of its MAVLink link, e.g. ``tcp:127.0.0.1:5760`` or ``udpin:127.0.0.1:14540``."""
    gcs: str | None = None
    """A ground station that listens, e.g. ``udpin:127.0.0.1:14550``; it is sent to unasked."""


class SitlTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sitl]``: what `fleetloc sitl` attaches to; no agent reads it."""

    vehicles: tuple[SitlVehicle, ...] = ()
    """An agent that is absent has the n-th default port of its autopilot, n from 0 in order of the file:
    ArduPilot ``tcp:127.0.0.1:5760 + 10 n``, PX4 ``udpin:127.0.0.1:14540 + n``."""
    client_port: Annotated[int, msgspec.Meta(ge=1024, le=64_000)] = 14_590
    """MAVSDK and ground stations reach agent number n (from 0) at UDP 127.0.0.1, this port + n."""
    component_id: Annotated[int, msgspec.Meta(ge=2, le=255)] = 194
    """MAVLink component id of the bridge; another one than the daemon's."""
    truth_hz: Annotated[float, msgspec.Meta(ge=5, le=200)] = 50.0
    """Rate at which the simulators' truth is asked for and recorded."""
    uwb_reach_m: Annotated[float, msgspec.Meta(gt=0)] = 200.0
    """No ranges over longer distances."""
    appear_timeout_s: Annotated[float, msgspec.Meta(gt=0)] = 60.0
    """All simulators have to show themselves within this."""
    silence_s: Annotated[float, msgspec.Meta(gt=0)] = 5.0
    """A simulator that tells no truth for longer than this ends the run."""
    mission: str | None = None
    """File of the mission to fly, relative to the configuration file; absent = the bridge only watches."""
