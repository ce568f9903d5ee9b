"""The rows of ``fleetloc bench faults``: what is injected, and what a fleet should make of it. They are data.

``fault_rows.toml`` beside this file holds those that come with the installation; a file of one's own is like it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec

from agent.config.fields import Fraction, NotNegative, Table
from agent.config.structs import read_struct
from agent.config.tables import TransportTable
from agent.radio.radio_faults import RadioOutage
from fleetloc.errors import InputError
from sim_bridge.faults.fault_tables import FaultTable, OfRanges, UwbSwapped

ROWS_FILE = Path(__file__).with_name("fault_rows.toml")


class RadioSpell(Table, frozen=True, kw_only=True):
    """What the radio does to packets: loss, delay and copies from the begin of the flight on, cuts in their time."""

    from_s: NotNegative
    """From here on, to ``to_s``, the row is looked at."""
    to_s: NotNegative
    loss: Fraction = 0.0
    delay_s: NotNegative = 0.0
    duplicate: Fraction = 0.0
    outages: tuple[RadioOutage, ...] = ()
    """As in ``[transport.faults]``, but with places in the fleet's file."""

    def laid_over(self, transport: TransportTable) -> TransportTable:
        """The settings of a fleet's radio with it."""
        replaced = msgspec.structs.replace
        outages = (*transport.faults.outages, *self.outages)
        duplicate = max(self.duplicate, transport.faults.duplicate)
        faults = replaced(transport.faults, duplicate=duplicate, outages=outages)
        loss, delay_s = max(self.loss, transport.loss), max(self.delay_s, transport.delay_s)
        return replaced(transport, loss=loss, delay_s=delay_s, faults=faults)


class FaultRow(Table, frozen=True):
    """One row of the matrix. In its faults, agents are places in the fleet's file, from 1 on."""

    name: str
    """One word, for ``--rows``."""
    title: str
    """What happens, in a line."""
    faults: tuple[FaultTable, ...] = ()
    """All with an end: what comes after it is looked at too."""
    radio: RadioSpell | None = None
    """What happens to packets, in place of faults of drones or besides."""
    after_s: NotNegative = 20.0
    """How long the flight goes on after the last fault."""
    smallest_fleet: int = 1
    """Fleets with fewer drones leave the row out."""
    attributable_from: int = 1
    """Fleets with fewer drones cannot tell whose fault it is, or have too few ranges to hold a drone without its
    receiver: they are held to `told_within_s` and not to the ratio."""
    told_within_s: float = 3.0
    """Bound of the time to a flag of a drone that is hit, in those fleets; from then on the sigmas count, where no
    alarm stands."""
    ratio_at_most: float | None = None
    """Bound of the fleet's position RMSE while it lasts, over that of the same seeds without it; absent = none."""
    sigmas_at_most: float = 3.0
    """Bound of the error in sigmas that 99 % of epochs keep, from the begin on."""
    back_within_s: float = 10.0
    """Bound of the time from the end until the fleet is as good as without."""
    flag_within_s: float | None = None
    """Bound of the time from the begin to a flag of a drone that is hit; absent = none."""
    claim_at_most: float | None = None
    """Bound of the claimed sigma over the actual error, rms of the hit drones while it lasts; absent = none."""

    @property
    def begin_s(self) -> float:
        """When the first fault begins."""
        return min(each.from_s for each in (*self.faults, *self._spells))

    @property
    def end_s(self) -> float:
        """When the last fault ends."""
        return max([*(fault.end_s for fault in self.faults), *(spell.to_s for spell in self._spells)])

    @property
    def _spells(self) -> tuple[RadioSpell, ...]:
        return () if self.radio is None else (self.radio,)

    @property
    def duration_s(self) -> float:
        """Of the flight."""
        return self.end_s + self.after_s

    def placed(self, ids: Sequence[int]) -> FaultRow | None:
        """The row with a fleet's ids in place of places; ``None`` if it makes no sense for that fleet."""
        found = [_placed(fault, ids) for fault in self.faults]
        faults = tuple(fault for fault in found if fault is not None)
        if (not faults and self.radio is None) or len(ids) < self.smallest_fleet:
            return None
        radio = None if self.radio is None else _radio_placed(self.radio, ids)
        return msgspec.structs.replace(self, faults=faults, radio=radio)


class _Rows(Table, frozen=True):
    rows: Annotated[tuple[FaultRow, ...], msgspec.Meta(min_length=1)]


def _placed(fault: FaultTable, ids: Sequence[int]) -> FaultTable | None:
    """A fault with ids in place of places; ``None`` if none of the drones that it names is there."""
    agents = tuple(ids[place - 1] for place in fault.agents if place <= len(ids))
    if isinstance(fault, UwbSwapped):
        if max(fault.between) > len(ids):
            return None
        one, other = fault.between
        fault = msgspec.structs.replace(fault, between=(ids[one - 1], ids[other - 1]))
    if not isinstance(fault, OfRanges):
        return msgspec.structs.replace(fault, agents=agents) if agents else None
    pairs = tuple((ids[a - 1], ids[b - 1]) for a, b in fault.pairs if max(a, b) <= len(ids))
    named = fault.agents or fault.pairs
    return msgspec.structs.replace(fault, agents=agents, pairs=pairs) if agents or pairs or not named else None


def _radio_placed(radio: RadioSpell, ids: Sequence[int]) -> RadioSpell:
    """With ids in place of places, those that are not there left out."""
    outages = tuple(
        msgspec.structs.replace(
            outage,
            receivers=tuple(ids[place - 1] for place in outage.receivers if place <= len(ids)),
            senders=tuple(ids[place - 1] for place in outage.senders if place <= len(ids)),
        )
        for outage in radio.outages
    )
    return msgspec.structs.replace(radio, outages=outages)


def read_rows(path: Path) -> tuple[FaultRow, ...]:
    """The rows of a file; raises `InputError`, `OSError`."""
    try:
        document: Any = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(str(path), "", "TOML", str(error)) from None
    table, wrong = read_struct(document, _Rows)
    if table is None:
        raise InputError(str(path), wrong[0].key, wrong[0].expected, wrong[0].found)
    for index, row in enumerate(table.rows):
        if not row.faults and row.radio is None:
            raise InputError(str(path), f"rows[{index}]", "faults or a radio", "neither")
        if row.radio is not None and row.radio.to_s <= row.radio.from_s:
            expected = f"later than from_s = {row.radio.from_s:g}"
            raise InputError(str(path), f"rows[{index}].radio.to_s", expected, f"{row.radio.to_s:g}")
        for number, fault in enumerate(row.faults):
            if fault.to_s is None or fault.to_s <= fault.from_s:
                key = f"rows[{index}].faults[{number}].to_s"
                raise InputError(str(path), key, f"an end after from_s = {fault.from_s:g}", str(fault.to_s))
    names = [row.name for row in table.rows]
    if len(set(names)) < len(names):
        raise InputError(str(path), "rows.name", "a name of its own for each", ", ".join(names))
    return table.rows


def chosen_rows(rows: Iterable[FaultRow], names: str) -> tuple[FaultRow, ...]:
    """Those with the names, separated by commas, in the order of the rows; empty: all. Raises `InputError`."""
    by_name = {row.name: row for row in rows}
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    if not set(wanted) <= by_name.keys():
        raise InputError("--rows", "", f"some of {', '.join(by_name)}", names)
    return tuple(row for name, row in by_name.items() if name in wanted or not wanted)
