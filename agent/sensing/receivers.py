"""Which of an autopilot's GNSS receivers is listened to: the first that has fixes."""

from __future__ import annotations

import math
from collections.abc import Collection

HOLD_S = 2.5
"""A receiver that was silent for so long has no fixes; those of a slow radio come once a second."""


class ReceiverChoice:
    """One stream of fixes out of several receivers, numbered from 0.

    ``known`` are those that will have fixes, where that is known beforehand, as of a log.
    """

    def __init__(self, known: Collection[int] | None = None) -> None:
        self._presumed = (0,) if known is None else tuple(known)
        self._began_s: float | None = None
        self._usable_s: dict[int, float] = {}
        """When each receiver last had a fix, minus infinity if its last word was that it has none."""

    def without_fix(self, receiver: int) -> None:
        """A receiver says that it has no fix, or gives one that cannot be used."""
        self._usable_s[receiver] = -math.inf

    def takes(self, receiver: int, now_s: float) -> bool:
        """Whether the good fix that a receiver gives now is to be used."""
        if self._began_s is None:
            self._began_s = now_s
        self._usable_s[receiver] = now_s
        earlier = dict.fromkeys(self._presumed, self._began_s) | self._usable_s
        return all(now_s - heard_s > HOLD_S for each, heard_s in earlier.items() if each < receiver)
