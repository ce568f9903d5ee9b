"""Injected link faults, applied by the receiver after reception and before anything is looked at.

Sans-I/O and seeded: the same packets at the same times meet the same fate, in the daemon (which asks for
`next_due` and sets a timer) as in virtual time. Each directed link has its own generator, and every packet
draws the same number of variates from it whatever the settings, so two runs that differ in one setting stay
comparable packet by packet.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Generic, TypeVar

import msgspec
import numpy as np

Item = TypeVar("Item")
Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=3600)]

_DRAWS = 8
_DRAWN_AT_ONCE = 64
"""Packets for which variates are drawn together; one by one they would be the same."""


class Outage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A partition: nothing is received from these neighbours (all, if empty) from ``from_s`` to ``until_s``.

    Times on the clock that `Channel.offer` is given. One-way, as everything here: the other direction is the
    other agent's setting.
    """

    from_s: float
    until_s: float
    neighbours: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not self.from_s < self.until_s:
            raise ValueError(f"outage from {self.from_s} s until {self.until_s} s: expected from < until")

    def covers(self, neighbour: int, now: float) -> bool:
        """Whether the neighbour cannot be heard at ``now``."""
        return self.from_s <= now < self.until_s and (not self.neighbours or neighbour in self.neighbours)


class LinkFaults(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the link from one neighbour does to packets."""

    loss: Probability = 0.0
    """Bernoulli loss (in the good state of the burst model)."""

    burst_start: Probability = 0.0
    """Gilbert-Elliott: probability per packet to go from the good to the bad state."""

    burst_end: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.25
    """Gilbert-Elliott: probability per packet to return; a burst lasts 1/burst_end packets on average."""

    burst_loss: Probability = 1.0
    """Loss in the bad state."""

    delay_s: Seconds = 0.0
    """Constant delay."""

    delay_exponential_s: Seconds = 0.0
    """Mean of an exponentially distributed delay on top."""

    delay_uniform_s: Seconds = 0.0
    """Width of a delay on top that is uniform from zero."""

    in_order: bool = False
    """Whether a packet waits for those before it, as on a stream; else random delays reorder."""

    reorder: Probability = 0.0
    """Probability that a packet is held back by ``reorder_delay_s`` and overtaken."""

    reorder_delay_s: Seconds = 0.02
    """How long such a packet is held back."""

    duplicate: Probability = 0.0
    """Probability that a packet comes twice, the copy with a delay of its own."""

    outages: tuple[Outage, ...] = ()
    """Windows in which nothing is received."""


class ChannelSettings(LinkFaults, frozen=True, forbid_unknown_fields=True):
    """The faults of all links into one agent: those here, but for neighbours with an entry of their own."""

    per_neighbour: dict[str, LinkFaults] = {}
    """Faults by neighbour id (as text, since TOML keys are) in place of the common ones."""

    def __post_init__(self) -> None:
        for name in self.per_neighbour:
            if not name.isascii() or not name.isdigit():
                raise ValueError(f"per_neighbour.{name}: expected an agent id")

    def faults_of(self, neighbour: int) -> LinkFaults:
        """The faults of the link from a neighbour."""
        return self.per_neighbour.get(str(neighbour), self)


class _Link:
    """State of one directed link."""

    def __init__(self, neighbour: int, faults: LinkFaults, rng: np.random.Generator) -> None:
        self._neighbour = neighbour
        self.faults = faults
        self._rng = rng
        self._drawn: list[list[float]] = []
        """Variates of the packets to come, the next one's last."""
        self._bad = False
        self._last_due = -math.inf

    def arrivals(self, now: float) -> tuple[float, ...]:
        """When a packet received at ``now`` is delivered: never, once, or twice."""
        f = self.faults
        if not self._drawn:
            self._drawn = self._rng.random((_DRAWN_AT_ONCE, _DRAWS)).tolist()[::-1]
        burst, loss, held, twice, *spread = self._drawn.pop()
        self._bad = burst >= f.burst_end if self._bad else burst < f.burst_start
        lost = loss < (f.burst_loss if self._bad else f.loss)
        if lost or any(outage.covers(self._neighbour, now) for outage in f.outages):
            return ()
        first = now + self._delay(*spread[:2]) + (f.reorder_delay_s if held < f.reorder else 0.0)
        if f.in_order:
            first = self._last_due = max(first, self._last_due)
        if twice >= f.duplicate:
            return (first,)
        return first, max(first, now + self._delay(*spread[2:]))

    def _delay(self, first: float, second: float) -> float:
        f = self.faults
        return f.delay_s - f.delay_exponential_s * math.log1p(-first) + f.delay_uniform_s * second


class Channel(Generic[Item]):
    """All links into one agent; a packet offered comes out of `due` as late as its link decides, or never."""

    def __init__(self, links: Mapping[int, LinkFaults], rngs: Mapping[int, np.random.Generator]) -> None:
        self._links = {neighbour: _Link(neighbour, f, rngs[neighbour]) for neighbour, f in links.items()}
        self._queue: list[tuple[float, int, int, Item]] = []
        self._order = 0
        self.lost: dict[int, int] = dict.fromkeys(links, 0)
        """Packets dropped, by neighbour."""

    @classmethod
    def seeded(
        cls, settings: ChannelSettings, *, seed: int, receiver: int, neighbours: Iterable[int]
    ) -> Channel[Item]:
        """The channel into ``receiver``: one generator per directed link, all from the fleet's seed."""
        ids = sorted(neighbours)
        links = {neighbour: settings.faults_of(neighbour) for neighbour in ids}
        rngs = {neighbour: np.random.default_rng([seed, receiver, neighbour]) for neighbour in ids}
        return cls(links, rngs)

    def change(self, settings: ChannelSettings) -> None:
        """Other faults from now on; what is under way and the links' generators go on as they are."""
        for neighbour, link in self._links.items():
            link.faults = settings.faults_of(neighbour)

    def offer(self, neighbour: int, item: Item, now: float) -> None:
        """A packet from a neighbour was received at ``now``; one from elsewhere passes without faults."""
        link = self._links.get(neighbour)
        arrivals = (now,) if link is None else link.arrivals(now)
        if not arrivals:
            self.lost[neighbour] += 1
        for due_s in arrivals:
            self._order += 1
            heapq.heappush(self._queue, (due_s, self._order, neighbour, item))

    def due(self, now: float) -> list[tuple[int, Item]]:
        """Packets (neighbour, item) to be delivered by ``now``, in the order of their times."""
        out: list[tuple[int, Item]] = []
        while self._queue and self._queue[0][0] <= now:
            _, _, neighbour, item = heapq.heappop(self._queue)
            out.append((neighbour, item))
        return out

    def next_due(self) -> float | None:
        """Time of the next delivery; ``None`` if nothing is under way."""
        return self._queue[0][0] if self._queue else None
