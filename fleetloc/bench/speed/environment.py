"""What a timing depends on besides the code: threads, processor, versions. Imports nothing heavy."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from typing import Any

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
PACKAGES = ("numpy", "scipy", "numba", "osqp", "daqp", "casadi", "gtsam")


def use_one_thread(*, unless_set: bool = False) -> None:
    """One thread for every BLAS of this process; it has to happen before numpy is imported.

    Small matrices lose by threads, and a daemon shares its processor with the autopilot's companions. ``unless_set``:
    what the user has set stays.
    """
    for variable in THREAD_VARIABLES:
        if not (unless_set and variable in os.environ):
            os.environ[variable] = "1"


def describe() -> dict[str, Any]:
    """Processor, interpreter, versions of what is compared, and the settings that change timings."""
    return {
        "processor": _processor(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "blas_threads": os.environ.get("OMP_NUM_THREADS", "default"),
        "kernels_compiled_for": os.environ.get("FLEETLOC_CPU", "generic"),
    }


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    """Model name where the system tells it, else the architecture."""
    if sys.platform == "linux":
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as stream:
            for line in stream:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
