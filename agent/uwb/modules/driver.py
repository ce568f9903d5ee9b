"""What a driver process does with the bytes of its module, as one sans-I/O machine: bytes and time in, ranges out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from agent.uwb.modules.dwm1001 import Dwm1001Parser
from agent.uwb.modules.kinds import ModuleKind
from agent.uwb.modules.module_clock import ModuleClock
from agent.uwb.modules.reading import ByteCounts, Reading
from transport.messages.uwb_body import UwbRange

PAUSE_S = 0.1
"""After so long a silence a module begins anew."""
QUIET_S = 1.0
"""A module that has said nothing of use for so long is woken, where its kind can be."""

STRANGE_NAMED = 16
"""So many unknown modules are remembered by their ids."""


@dataclass(frozen=True, slots=True)
class TakenRanges:
    """Ranges of one instant, s on the clock of the arrivals."""

    taken_s: float
    ranges: tuple[UwbRange, ...]


class ModuleDriver:
    """One module's bytes to ranges between drones.

    ``drone_of`` says which drone carries which module, by the modules' own ids; ``sigma_m`` is given with every
    range, ``lag_s`` is how much older a range is than its arrival, or than its module's stamp.
    """

    def __init__(
        self,
        kind: ModuleKind,
        own: int,
        drone_of: Mapping[int, int],
        *,
        sigma_m: float | None = None,
        lag_s: float = 0.0,
    ) -> None:
        self._own, self._drone_of, self._sigma_m, self._lag_s = own, drone_of, sigma_m, lag_s
        self._parser = kind.parser()
        self._clock: ModuleClock | None = None
        self._heard_s: float | None = None
        self._of_use_s: float | None = None
        self.ranges = 0
        """Handed on."""
        self.left_out: Counter[str] = Counter()
        """Ranges left out, by reason, besides those that the module itself says nothing about."""
        self.strange: Counter[int] = Counter()
        """Modules that nobody is known to carry, and how often they were ranged."""

    @property
    def counts(self) -> ByteCounts:
        """What became of the bytes."""
        return self._parser.counts

    def plugged(self, now_s: float) -> None:
        """The port was opened: what was begun before is gone, and the module's clock may be another."""
        self._parser.pause()
        self._clock = None
        self._heard_s = self._of_use_s = now_s

    def feed(self, data: bytes, arrival_s: float) -> list[TakenRanges]:
        """Take in bytes that have just arrived; ranges that can be handed on."""
        readings: list[Reading] = []
        if self._heard_s is not None and arrival_s - self._heard_s > PAUSE_S:
            readings += self._parser.pause()
        self._heard_s = arrival_s
        readings += self._parser.feed(data)
        taken = [each for each in (self._taken(reading, arrival_s) for reading in readings) if each is not None]
        if readings:
            self._of_use_s = arrival_s
        return taken

    def to_send(self, now_s: float) -> bytes:
        """What the module is to be sent now, mostly nothing."""
        if not isinstance(self._parser, Dwm1001Parser) or self._of_use_s is None:
            return b""
        if now_s - self._of_use_s < QUIET_S:
            return b""
        self._of_use_s = now_s
        return self._parser.wake()

    def _taken(self, reading: Reading, arrival_s: float) -> TakenRanges | None:
        if reading.own is not None and self._drone_of.get(reading.own) != self._own:
            self._note_strange(reading.own)
            self._leave_out("of another module", len(reading.ranges))
            return None
        taken_s: float | None = arrival_s
        if reading.clock_s is not None:
            if self._clock is None:
                self._clock = ModuleClock(reading.wrap_s)
            taken_s = self._clock.taken_s(reading.clock_s, arrival_s)
        if taken_s is None:
            self._leave_out("clock not known", len(reading.ranges))
            return None
        ranges = []
        for each in reading.ranges:
            other = self._drone_of.get(each.module)
            if other is None:
                self._note_strange(each.module)
                self._leave_out("unknown module", 1)
            elif other == self._own:
                self._leave_out("of itself", 1)
            else:
                ranges.append(
                    UwbRange(other, each.range_m, self._sigma_m, each.nlos, each.rx_dbm, each.first_path_dbm)
                )
        if not ranges:
            return None
        self.ranges += len(ranges)
        return TakenRanges(taken_s - self._lag_s, tuple(ranges))

    def _note_strange(self, module: int) -> None:
        if module in self.strange or len(self.strange) < STRANGE_NAMED:
            self.strange[module] += 1

    def _leave_out(self, reason: str, count: int) -> None:
        self.left_out[reason] += count
