"""Replay protection: each sender's start and sequence numbers, per kind of packet.

A packet is new if its boot is later than any seen of its sender, or equal to the latest with a sequence number
that is higher than all seen of its kind, or within the window of the last 64 and not seen yet. Boots must
therefore rise with every start (`transport.security.keys.next_boot`), and a receiver that wants protection
across its own restart keeps `ReplayGuard.state` (or checks the clock, see `transport.security.opening.Opener`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from transport.errors import Reason, Rejected
from transport.messages.header import Header, PacketKind

WINDOW = 64

StreamOf = tuple[int, PacketKind]
"""(sender, kind)."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What was seen of one stream: bit i of ``window`` is the packet with number ``newest - i``."""

    boot: int
    newest: int
    window: int


class ReplayGuard:
    """Says whether a packet was seen before; `check` first, `commit` once its signature is good."""

    def __init__(self, state: Mapping[StreamOf, Seen] | None = None) -> None:
        self._seen: dict[StreamOf, Seen] = dict(state or {})
        self._boots: dict[int, int] = {}
        for (sender, _), seen in self._seen.items():
            self._boots[sender] = max(self._boots.get(sender, 0), seen.boot)

    @property
    def state(self) -> dict[StreamOf, Seen]:
        """What to keep for the next start."""
        return dict(self._seen)

    def is_of_earlier_start(self, header: Header) -> bool:
        """Whether its sender has been started anew since."""
        return header.boot < self._boots.get(header.sender, 0)

    def check(self, header: Header) -> None:
        """Raises `Rejected` (DUPLICATE or REPLAY) if the packet is not new."""
        boot = self._boots.get(header.sender, 0)
        if header.boot < boot:
            raise Rejected(Reason.REPLAY, f"boot {header.boot}, now {boot}")
        seen = self._seen.get((header.sender, header.kind))
        if seen is None or header.boot > seen.boot:
            return
        behind = seen.newest - header.seq
        if behind >= WINDOW:
            raise Rejected(Reason.REPLAY, f"number {header.seq}, newest {seen.newest}")
        if behind >= 0 and seen.window >> behind & 1:
            raise Rejected(Reason.DUPLICATE, f"number {header.seq}")

    def commit(self, header: Header) -> None:
        """Remember a packet that `check` let pass and that is authentic."""
        self._boots[header.sender] = header.boot
        stream = (header.sender, header.kind)
        seen = self._seen.get(stream)
        if seen is None or header.boot > seen.boot:
            self._seen[stream] = Seen(header.boot, header.seq, 1)
            return
        ahead = header.seq - seen.newest
        if ahead > 0:
            # a signed jump by 2^32 must not become a shift by 2^32 bits
            shifted = 0 if ahead >= WINDOW else (seen.window << ahead) & ((1 << WINDOW) - 1)
            self._seen[stream] = Seen(seen.boot, header.seq, shifted | 1)
        else:
            self._seen[stream] = Seen(seen.boot, seen.newest, seen.window | 1 << -ahead)
