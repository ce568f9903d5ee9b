"""One drone's agent as tests of its parts want it: unsigned, its monotonic clock being fleet time."""

from __future__ import annotations

from typing import Any

from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from estimators.factory import make_estimator
from transport.security.auth import Identity

CONNECTED = "connected"
"""State of the autopilot's link, as a core is told it."""


def onboard_of(
    config: FleetConfig,
    factory: Any = make_estimator,
    *,
    agent_id: int = 1,
    linked: bool = False,
    fleet_offset_s: float = 0.0,
) -> OnboardAgent:
    """An agent; ``fleet_offset_s`` is fleet time less its monotonic clock."""
    unix_s = config.fleet.epoch_unix_s + fleet_offset_s
    return OnboardAgent(config, agent_id, factory, Identity(), unix_s=unix_s, host_s=0.0, linked=linked)
