"""Log lines on stderr, and in files where they are asked for: state changes and faults, details on demand."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from logging.handlers import RotatingFileHandler
from pathlib import Path

from agent.config.observer_tables import LogTable
from agent.errors import LogFileError
from agent.log.disk import MIN_FREE_BYTES, free_bytes
from agent.watch.health import Health, State

LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)
LINE = "%(asctime)s %(levelname)s %(message)s"
DISK_CHECK_PERIOD_S = 1.0
KEEP = 5
"""Files put aside that are kept."""
MAX_BYTES = 10_000_000
"""A file that has grown to this is put aside as ``.1``, what was ``.1`` as ``.2``."""


def configure_logging(verbosity: int = 1, file: logging.Handler | None = None) -> None:
    """Send the log to stderr, and to ``file``; 0 = faults only, 1 = state changes too, 2 = everything."""
    logger = logging.getLogger("fleetloc")
    for former in logger.handlers:
        former.close()
    logger.handlers[:] = [logging.StreamHandler(sys.stderr), *([file] if file else [])]
    for handler in logger.handlers:
        handler.setFormatter(logging.Formatter(LINE))
    logger.setLevel(LEVELS[min(max(verbosity, 0), len(LEVELS) - 1)])
    logger.propagate = False


def log_file(table: LogTable, agent_id: int, free: Callable[[Path], int] = free_bytes) -> logging.Handler | None:
    """The log file of an agent, ``None`` where none is asked for; raises `LogFileError` if it cannot be written."""
    if table.directory is None:
        return None
    path = Path(table.directory) / f"agent_{agent_id:03d}.log"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        limits = MAX_BYTES, KEEP, MIN_FREE_BYTES
        return LimitedLogFile(path, *limits, free)
    except OSError as error:
        raise LogFileError(f"log {path}: cannot be written: {error.strerror or error}") from error


def level_of(health: Health) -> int:
    """How loud a health is told: what may not be used, or may be wrong unnoticed, is an error."""
    if health.state in (State.INIT, State.ALIGNING):  # nothing is to be used yet
        return logging.WARNING if health.alarm else logging.INFO
    if health.alarm or health.state is State.FAULT:
        return logging.ERROR
    return logging.WARNING if health.state is State.DEGRADED else logging.INFO


class LimitedLogFile(RotatingFileHandler):
    """A log file that is put aside at a size, and that gives way when the disk fills up.

    With less than ``min_free_bytes`` left, files put aside go, the oldest first; if that is not enough, lines are
    dropped (and counted in ``dropped``) until there is room again, which the file then says.
    """

    def __init__(
        self, path: Path, max_bytes: int, keep: int, min_free_bytes: int, free: Callable[[Path], int] = free_bytes
    ) -> None:
        """Open it for appending; raises `OSError`."""
        super().__init__(path, maxBytes=max_bytes, backupCount=keep, encoding="utf-8")
        self._path = path
        self._min_free_bytes = min_free_bytes
        self._free = free
        self._room = True
        self._checked_s = float("-inf")
        self.dropped = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line, unless the disk is nearly full."""
        if abs(record.created - self._checked_s) >= DISK_CHECK_PERIOD_S:  # either way: clocks step
            self._checked_s = record.created
            self._room = self._make_room()
        if not self._room:
            self.dropped += 1
            return
        if self.dropped:
            lost = f"{self.dropped} lines lost: the disk was nearly full"
            self.dropped = 0
            super().emit(logging.LogRecord(record.name, logging.WARNING, "", 0, lost, None, None))
        super().emit(record)

    def _make_room(self) -> bool:
        """Whether enough is left, after files put aside were deleted if need be."""
        try:
            for number in range(self.backupCount, -1, -1):
                if self._free(self._path.parent) >= self._min_free_bytes:
                    return True
                if number:
                    Path(f"{self._path}.{number}").unlink(missing_ok=True)
        except OSError:
            return False  # a folder that is gone has no room either
        return False
