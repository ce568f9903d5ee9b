"""The barrier of one consensus round: it collects what neighbours send and always ends by its deadline.

Sans-I/O: `open` a round, `put` what arrives, ask `done`, `close` it. Packets may come before their round is
opened (clocks differ); those of rounds already closed are late, and not used.
"""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum, auto
from typing import Generic, TypeVar

Item = TypeVar("Item")
RoundKey = tuple[int, int]
"""(tick, round)."""


class PacketOutcome(Enum):
    """What became of a packet."""

    KEPT = auto()
    LATE = auto()
    """Its round is closed."""
    DUPLICATE = auto()
    """Its sender's packet of this round is there already; the first stands."""
    WILD = auto()
    """Too far ahead, or of a round that does not exist."""


class RoundBarrier(Generic[Item]):
    """Collects one packet per neighbour and round.

    Parameters
    ----------
    rounds : int
        Rounds per tick; packets of higher rounds are wild.
    ticks_ahead : int
        How many ticks beyond the current one a packet may be; what more a member sends is not stored.
    """

    def __init__(self, rounds: int, *, ticks_ahead: int = 2) -> None:
        self._rounds = rounds
        self._ticks_ahead = ticks_ahead
        self._box: dict[RoundKey, dict[int, Item]] = {}
        self._floor: RoundKey = (-1, -1)
        self._tick = 0
        self._current: RoundKey | None = None
        self._expected: frozenset[int] = frozenset()
        self._missing: set[int] = set()
        self._deadline_s = 0.0

    @property
    def deadline_s(self) -> float:
        """When the open round ends at the latest."""
        return self._deadline_s

    def advance(self, tick: int) -> None:
        """Go on to a tick: packets of earlier ones are late now, those up to `ticks_ahead` later are kept.

        Raises ``ValueError`` while a round is open. `open` does it by itself.
        """
        if self._current is not None:
            raise ValueError(f"round {self._current} is still open")
        self._tick = max(self._tick, tick)
        self._drop_to(max(self._floor, (tick - 1, self._rounds)))

    def open(self, tick: int, round_: int, expected: Collection[int], deadline_s: float) -> None:
        """Begin a round with the neighbours it waits for; rounds only go forward.

        Raises ``ValueError`` for a round that is closed already or does not exist.
        """
        key = (tick, round_)
        if key <= self._floor or not 0 <= round_ < self._rounds or self._current is not None:
            raise ValueError(f"round {key} of {self._rounds} a tick cannot be opened after {self._floor}")
        self.advance(tick)
        self._current, self._deadline_s = key, deadline_s
        here = self._box.get(key, {})
        self._missing = {sender for sender in expected if sender not in here}
        self._expected = frozenset(expected)

    def put(self, sender: int, tick: int, round_: int, item: Item) -> PacketOutcome:
        """Keep a packet for its round, or say why not."""
        key = (tick, round_)
        if tick > self._tick + self._ticks_ahead or not 0 <= round_ < self._rounds:
            return PacketOutcome.WILD
        if key <= self._floor:
            return PacketOutcome.LATE
        items = self._box.setdefault(key, {})
        if sender in items:
            return PacketOutcome.DUPLICATE
        items[sender] = item
        if key == self._current:
            self._missing.discard(sender)
        return PacketOutcome.KEPT

    def forget(self, sender: int) -> None:
        """Stop waiting for a neighbour that is gone."""
        self._missing.discard(sender)

    def complete(self) -> bool:
        """Whether nothing more is to be waited for in the open round."""
        return not self._missing

    def done(self, now: float) -> bool:
        """Whether the open round can be closed: complete, or its deadline has passed."""
        return self.complete() or now >= self._deadline_s

    def close(self) -> dict[int, Item]:
        """End the open round: what came from its expected neighbours, by sender id in ascending order.

        Raises ``ValueError`` if no round is open.
        """
        if self._current is None:
            raise ValueError("no round is open")
        items = self._box.get(self._current, {})
        used = {sender: items[sender] for sender in sorted(items.keys() & self._expected)}
        floor, self._current = self._current, None
        self._missing = set()
        self._drop_to(floor)
        return used

    def abandon(self) -> None:
        """End the round that is open, if one is; what came for it is not used."""
        if self._current is not None:
            self.close()

    def _drop_to(self, floor: RoundKey) -> None:
        self._floor = floor
        for key in [key for key in self._box if key <= floor]:
            del self._box[key]
