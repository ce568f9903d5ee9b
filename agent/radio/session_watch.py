"""When to open the session anew: neighbours that were there are silent, and the session may be to blame. Sans-I/O.

A datagram link of Zenoh 1.10 may go deaf for good: two peers that are suspended at the same time, longer than the
lease, and the one that is dialled never takes anyone again. Only a new session helps. From here that looks like a
neighbour that has crashed or flown away, so it is tried, at growing intervals: whoever is still heard is missed for a
moment.
"""

from __future__ import annotations

from collections.abc import Mapping

SILENT_S = 5.0
"""Nothing well formed and authentic of a neighbour for so long."""
LONGEST_PAUSE_S = 60.0
"""Between attempts while nobody is heard."""
LONGEST_PAUSE_HEARING_S = 300.0
"""The same while somebody is."""


class SessionWatch:
    """``dials_us``: the neighbours whose links are ours to accept; only those can have gone deaf alone."""

    def __init__(self, dials_us: frozenset[int]) -> None:
        self._dials_us = dials_us
        self._pause_s = SILENT_S
        self._last_s: float | None = None

    def is_due(self, now_s: float, heard_s: Mapping[int, float]) -> bool:
        """Whether to open the session anew now; ``heard_s``: when each neighbour that ever was heard was so last."""
        silent = {neighbour for neighbour, at_s in heard_s.items() if now_s - at_s >= SILENT_S}
        if not silent:
            self._pause_s, self._last_s = SILENT_S, None
            return False
        somebody = len(silent) < len(heard_s)
        if somebody and not silent & self._dials_us:
            return False
        if self._last_s is not None and now_s - self._last_s < self._pause_s:
            return False
        if self._last_s is not None:
            longest_s = LONGEST_PAUSE_HEARING_S if somebody else LONGEST_PAUSE_S
            self._pause_s = min(2.0 * self._pause_s, longest_s)
        self._last_s = now_s
        return True
