"""Log lines on stderr: state changes and faults; details only when asked for."""

from __future__ import annotations

import logging
import sys

LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)


def configure_logging(verbosity: int = 1) -> None:
    """Send the log to stderr; 0 = faults only, 1 = state changes too, 2 = everything."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger = logging.getLogger("fleetloc")
    logger.handlers[:] = [handler]
    logger.setLevel(LEVELS[min(max(verbosity, 0), len(LEVELS) - 1)])
    logger.propagate = False
