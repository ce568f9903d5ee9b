"""How much a record may take of the disk."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

MIN_FREE_BYTES = 100_000_000
"""What a record or a log leaves of the disk to the rest of the drone."""


def free_bytes(directory: Path) -> int:
    """What the disk of a folder has left for us; raises `OSError`."""
    return shutil.disk_usage(directory).free


def too_little_left(directory: Path, free: Callable[[Path], int] = free_bytes) -> str:
    """Why a record may take no more of a folder's disk, empty if it may; raises `OSError`."""
    left = free(directory)
    if left < MIN_FREE_BYTES:
        return f"the disk has {left / 1e6:.0f} MB left, and {MIN_FREE_BYTES / 1e6:g} MB stay free"
    return ""


class DiskLimit:
    """Says when a record has to end: it is as large as it may be, or the disk is nearly full.

    A disk that other programs fill up ends the record too: what is left belongs to those that need it more.
    """

    def __init__(
        self,
        directory: Path,
        max_bytes: int,
        min_free_bytes: int = MIN_FREE_BYTES,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        self._directory = directory
        self._max_bytes = max_bytes
        self._min_free_bytes = min_free_bytes
        self._free = free

    def is_reached_by(self, size_bytes: int) -> bool:
        """Whether a record of this size is as large as it may be, whatever the disk has left."""
        return size_bytes >= self._max_bytes

    def reached(self, size_bytes: int) -> str:
        """Why a record of this size may not grow, empty if it may; raises `OSError`."""
        if self.is_reached_by(size_bytes):
            return f"it has the {self._max_bytes / 1e6:g} MB of record.flight_max_mb"
        free = self._free(self._directory)
        if free < self._min_free_bytes:
            return f"the disk has {free / 1e6:.0f} MB left, and {self._min_free_bytes / 1e6:g} MB stay free"
        return ""
