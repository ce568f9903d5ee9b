"""Joins the parts of split information packets; bounded memory per sender, old partial sets expire."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from transport.errors import Reason, Rejected
from transport.messages.information_body import Information, InformationPart, decode_content

Key = tuple[int, int]
"""(tick, round)."""


@dataclass(slots=True)
class _PartialSet:
    first: InformationPart
    since_s: float
    shares: dict[int, bytes] = field(default_factory=dict)


class Reassembler:
    """Collects parts by (sender, tick, round).

    A sender has at most ``max_sets`` incomplete sets, so what one floods costs only itself. Sets that are
    given up, by age or for newer ones, are reported to ``on_expired(sender, parts)``.
    """

    def __init__(
        self,
        roster: Collection[int],
        on_expired: Callable[[int, int], None],
        *,
        max_sets: int = 8,
        expiry_s: float = 1.0,
    ) -> None:
        self._roster = roster
        self._on_expired = on_expired
        self._max_sets = max_sets
        self._expiry_s = expiry_s
        self._sets: dict[int, OrderedDict[Key, _PartialSet]] = {}

    def add(
        self, sender: int, tick: int, round_: int, part: InformationPart, now: float
    ) -> Information | None:
        """The pair if this part completes it, else ``None``; raises `Rejected` for a bad part or pair."""
        if part.count == 1:
            return decode_content(part.share, part, tick=tick, round_=round_, roster=self._roster)
        self.expire(now)
        sets = self._sets.setdefault(sender, OrderedDict())
        key = (tick, round_)
        partial = sets.get(key)
        if partial is None:
            partial = sets[key] = _PartialSet(part, now)
            while len(sets) > self._max_sets:
                self._give_up(sender, next(iter(sets)))
        elif _description(partial.first) != _description(part):
            raise Rejected(Reason.PART_MISMATCH, f"part {part.index} of tick {tick} round {round_}")
        if part.index in partial.shares:
            raise Rejected(Reason.DUPLICATE, f"part {part.index} of tick {tick} round {round_}")
        partial.shares[part.index] = part.share
        if len(partial.shares) < part.count:
            return None
        del sets[key]
        content = b"".join(partial.shares[index] for index in range(part.count))
        return decode_content(content, part, tick=tick, round_=round_, roster=self._roster)

    def expire(self, now: float) -> None:
        """Give up the sets whose first part came more than ``expiry_s`` before ``now``."""
        for sender, sets in self._sets.items():
            for key in [key for key, partial in sets.items() if now - partial.since_s > self._expiry_s]:
                self._give_up(sender, key)

    def _give_up(self, sender: int, key: Key) -> None:
        partial = self._sets[sender].pop(key)
        self._on_expired(sender, len(partial.shares))


def _description(part: InformationPart) -> tuple[int, int, int, int, bool]:
    return part.count, part.rank, part.state_tick, part.agents, part.double
