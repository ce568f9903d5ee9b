"""Faults of the program that a daemon flies on with: each is counted, and said once of its kind, with its trace."""

from __future__ import annotations

import logging
import traceback
from types import TracebackType

LOG = logging.getLogger("fleetloc.agent")
MAX_KINDS = 50
"""Said at most; more are counted only."""


class ProgramFaults:
    """The faults of one daemon; ``count`` of all."""

    def __init__(self, agent_id: int) -> None:
        self._agent_id = agent_id
        self._said: set[tuple[str, str]] = set()
        self.count = 0

    def survived(self, doing: str) -> _Survived:
        """A context in which whatever is raised ends, noted; ``doing`` says what failed."""
        return _Survived(self, doing)

    def note(self, message: str, error: BaseException | None) -> None:
        """Count a fault; of a kind (what was raised, and where) that was not said yet, say it."""
        self.count += 1
        kind = (message[:40], "") if error is None else (type(error).__name__, _origin(error))
        if kind not in self._said and len(self._said) < MAX_KINDS:
            self._said.add(kind)
            LOG.error("agent %d: %s", self._agent_id, message, exc_info=error)


class _Survived:
    """Lets a fault pass no further; what ends a program (a cancelled task, Ctrl-C) does."""

    def __init__(self, faults: ProgramFaults, doing: str) -> None:
        self._faults, self._doing = faults, doing

    def __enter__(self) -> None:
        """Nothing to be done before."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, Exception):
            return False
        self._faults.note(f"{self._doing} failed", error)
        return True


def _origin(error: BaseException) -> str:
    """File and line that raised it."""
    origin = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        origin = f"{frame.f_code.co_filename}:{line}"
    return origin
