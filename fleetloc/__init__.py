"""Onboard cooperative localization for fleets of drones: the command ``fleetloc``, and its public Python API.

What ``__all__`` names is public and documented in ``docs/python.md``; everything else in the five packages may change
without notice. A name is loaded when it is first used, so that ``import fleetloc`` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agent.config.tables import FleetConfig
    from agent.errors import ConfigError, LogFileError
    from estimators.estimator import Status
    from fleetloc.api.logs import EstimateLog, read_estimate_log, read_flight_estimates, read_truth, replay_flight_log
    from fleetloc.api.observer import FleetObserver, Heard
    from fleetloc.api.uwb import UwbDriver
    from fleetloc.whole_config import load_whole as load_config
    from sim_bridge.replay.flight_log_replay import FlightLogReplay
    from sim_bridge.world.truth import Truth, TruthError
    from transport.errors import EncodeError, KeyFileError, SessionError
    from transport.messages.detection_body import Detection
    from transport.messages.estimate_body import FleetEstimate
    from transport.messages.report_body import Diagnostics
    from transport.messages.uwb_body import UwbFrame, UwbRange, encode_uwb_json

    __version__: str

__all__ = [
    "ConfigError",
    "Detection",
    "Diagnostics",
    "EncodeError",
    "EstimateLog",
    "FleetConfig",
    "FleetEstimate",
    "FleetObserver",
    "FlightLogReplay",
    "Heard",
    "KeyFileError",
    "LogFileError",
    "SessionError",
    "Status",
    "Truth",
    "TruthError",
    "UwbDriver",
    "UwbFrame",
    "UwbRange",
    "__version__",
    "encode_uwb_json",
    "load_config",
    "read_estimate_log",
    "read_flight_estimates",
    "read_truth",
    "replay_flight_log",
]

_PLACES = {
    "agent.config.tables": ("FleetConfig",),
    "agent.errors": ("ConfigError", "LogFileError"),
    "estimators.estimator": ("Status",),
    "fleetloc.api.logs": (
        "EstimateLog", "read_estimate_log", "read_flight_estimates", "read_truth", "replay_flight_log",
    ),
    "fleetloc.api.observer": ("FleetObserver", "Heard"),
    "fleetloc.api.uwb": ("UwbDriver",),
    "sim_bridge.replay.flight_log_replay": ("FlightLogReplay",),
    "sim_bridge.world.truth": ("Truth", "TruthError"),
    "transport.errors": ("EncodeError", "KeyFileError", "SessionError"),
    "transport.messages.detection_body": ("Detection",),
    "transport.messages.estimate_body": ("FleetEstimate",),
    "transport.messages.report_body": ("Diagnostics",),
    "transport.messages.uwb_body": ("UwbFrame", "UwbRange", "encode_uwb_json"),
}  # fmt: skip
_PLACE_OF = {name: place for place, names in _PLACES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value: Any = _version()
    elif name == "load_config":
        value = importlib.import_module("fleetloc.whole_config").load_whole
    elif name in _PLACE_OF:
        value = getattr(importlib.import_module(_PLACE_OF[name]), name)
    else:
        raise AttributeError(f"module 'fleetloc' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__


def _version() -> str:
    """Of the installed package, or ``unknown`` where it runs from sources without installation."""
    from importlib import metadata

    try:
        return metadata.version("fleetloc")
    except metadata.PackageNotFoundError:
        return "unknown"
