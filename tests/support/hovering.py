"""Vehicles of either flavour that hover beside their reference."""

from __future__ import annotations

from typing import Any

from sim_bridge.world.scenario import Vehicle

HOVER: dict[str, Any] = {"start_m": (5.0, 0.0, 5.0), "start_velocity_mps": (0.0, 0.0, 0.0)}
PX4 = Vehicle(1, "px4", 7, **HOVER)
ARDUPILOT = Vehicle(1, "ardupilot", 7, **HOVER)
