"""What a daemon keeps on disk for its next start: saved every ten seconds and at the end, off its loop."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod

from agent.watch.observers import DaemonState, Observer

SAVE_EVERY_S = 10
"""A daemon that is killed forgets at most this much."""


class Saver(Observer, ABC):
    """Saves now and then, one save at a time; what is saved, and how a full disk is said, is in `save`."""

    def __init__(self) -> None:
        self._seconds = 0
        self._saving: asyncio.Task[None] | None = None

    @abstractmethod
    async def save(self) -> None:
        """Write what there is to keep; a disk that does not take it ends no flight."""

    def on_second(self, state: DaemonState) -> None:
        """Save every tenth time."""
        self._seconds += 1
        if self._seconds % SAVE_EVERY_S == 0 and (self._saving is None or self._saving.done()):
            self._saving = asyncio.get_running_loop().create_task(self.save())

    async def close(self, state: DaemonState) -> None:
        """Save for the next start."""
        if self._saving is not None:
            await self._saving
        await self.save()
