"""The configuration of a fleet of both flavours over simulators."""

from __future__ import annotations

from typing import Any

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from tests.support.loopback_sitl import FRAME


def fleet_config(*, ids: tuple[int, ...] = (1, 2, 3), **tables: Any) -> FleetConfig:
    """Agents 1 (PX4), 2 (ArduPilot), 3 (PX4), others of either; ``tables`` are further ones of the document."""
    flavours = {1: "px4", 2: "ardupilot", 3: "px4"}
    entries = [
        {"id": agent, "autopilot": flavours.get(agent, "auto"), "mavlink": f"udpin:127.0.0.1:{14650 + agent}"}
        for agent in ids
    ]
    return config_from(
        {
            "fleet": {
                "name": "sitl",
                "origin": {"lat_deg": FRAME.lat_deg, "lon_deg": FRAME.lon_deg, "alt_m": FRAME.alt_m},
                "epoch_unix_s": 0.0,
            },
            "agents": entries,
            **tables,
        },
        "test",
    )
