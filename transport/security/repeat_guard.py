"""A member that says the same again and again: its process hangs, or somebody plays with its key.

Measurements and information have noise in them: what an honest drone says of one tick it never says of the next, bit
by bit. A body counts as repeated if it equals the one that came before it in its place, of an earlier tick. The third
in a row is refused, and all that repeat after it, with their numbering and signatures as good as they may be. Bodies
that hold a single record, or accelerations alone, are let through: a drone without sensors has nothing new to say.
One that stands still, its IMU silent and the output of its receiver filtered, is refused until something changes.
"""

from __future__ import annotations

from dataclasses import dataclass

from transport.errors import Reason, Rejected
from transport.messages.header import Header, PacketKind
from transport.messages.measurement_body import AccelerationMeasurement, Measurements

FEWEST_RECORDS = 2
MOST_TIMES = 2
"""So often a body may come."""
PLACES = 64
"""Of one sender that are remembered; a tick has no more."""

FIRST_PART = bytes(2)
"""What a body of information begins with that holds the mean; the parts behind it may stay what they are."""

_Place = tuple[PacketKind, int]
"""Kind and round."""


@dataclass(slots=True)
class _Last:
    """The body that came last in a place, the newest tick it came for, and how often it has come."""

    body: bytes
    tick: int
    times: int


class RepeatGuard:
    """Says whether a packet whose signature is good says what its sender has said before."""

    def __init__(self) -> None:
        self._last: dict[int, dict[_Place, _Last]] = {}

    def check_measurements(self, header: Header, body: bytes, message: Measurements) -> None:
        """Raises `Rejected` (REPEATED) if so."""
        told = len(message.records)
        if told >= FEWEST_RECORDS and not all(isinstance(each, AccelerationMeasurement) for each in message.records):
            end = sum(len(record.wire or b"") for record in message.records)
            self._check(header, body[:end])  # a proof behind them is another one for every tick

    def check_information(self, header: Header, body: bytes) -> None:
        """The same of one part of a pair."""
        if body.startswith(FIRST_PART):
            self._check(header, body)

    def _check(self, header: Header, body: bytes) -> None:
        places = self._last.setdefault(header.sender, {})
        place = header.kind, header.round
        last = places.get(place)
        if last is None and len(places) >= PLACES:
            places.clear()
        if last is None or last.body != body:
            places[place] = _Last(body, header.tick, 1)
            return
        if header.tick > last.tick:
            last.tick, last.times = header.tick, last.times + 1
        if last.times > MOST_TIMES:
            raise Rejected(Reason.REPEATED, f"what was said of {last.times} ticks")
