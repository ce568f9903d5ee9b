"""The extras of an installation: which package each brings, and the sentence where one is missing."""

from __future__ import annotations

import importlib.util

from fleetloc.errors import EnvironmentFault

PACKAGES = {"report": "matplotlib", "studies": "casadi", "ulog": "pyulog", "sitl": "mavsdk"}
"""Extra -> the package that the code imports."""


def is_installed(extra: str) -> bool:
    """Whether an extra's package is there; imports nothing."""
    return importlib.util.find_spec(PACKAGES[extra]) is not None


def remedy(extra: str) -> str:
    """What to type to install an extra."""
    return f"pip install 'fleetloc[{extra}]'"


def sentence(extra: str, without: str) -> str:
    """What is missing, what that means (``without``), and what to type; one line."""
    return f"{without}: {PACKAGES[extra]} is not installed ({remedy(extra)})"


def require_extra(extra: str, without: str) -> None:
    """Raise `EnvironmentFault` if an extra is not installed; ``without`` says what is impossible then."""
    if not is_installed(extra):
        raise EnvironmentFault(sentence(extra, without))
