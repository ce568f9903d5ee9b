"""``fleetloc bench integrity``: what is promised under the faults of ``bench faults``, in fleets of several sizes.

An epoch is a drone's tick. *Misleading*: the error is beyond the protection level and no alert says so.
*Hazardously*: it is beyond the alert limit besides. *Detected*: the first alert, or anything said to be off, of any
drone since the fault began; *named*: the first time that it was the right one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.config.tables import FleetConfig
from estimators.integrity.thresholds import FEWEST_RECEIVERS
from fleetloc.bench.fault_flights import Flight
from fleetloc.bench.fault_rows import FaultRow
from fleetloc.bench.integrity.flights import KeptFlight, Promises, first_drones, promises_of
from fleetloc.errors import InputError
from fleetloc.output import print_table, progress_bar
from sim_bridge.faults.fault_tables import GpsDrift, GpsStuck, GpsWrong, MemberStuck, MemberWrong, RangeFault, about
from sim_bridge.studies.monte_carlo import Hangar

Figures = dict[str, Any]
SETTLED_S = 10.0
CLEAN = "none"
OF_FIXES = GpsDrift | GpsStuck | GpsWrong | MemberStuck | MemberWrong


@dataclass(frozen=True, slots=True)
class SizedRow:
    """A row in a fleet of some size; no row: nothing is wrong."""

    config: FleetConfig
    row: FaultRow | None
    duration_s: float

    @property
    def culprits(self) -> tuple[frozenset[int], frozenset[int]]:
        """Slots of those whose fixes are wrong, and of those with wrong ranges."""
        faults = () if self.row is None else self.row.faults
        fixes = frozenset().union(*(about(each) for each in faults if isinstance(each, OF_FIXES)))
        ranges = frozenset().union(*(about(each) for each in faults if isinstance(each, RangeFault)))
        ids = self.config.ids
        return frozenset(map(ids.index, fixes)), frozenset(map(ids.index, ranges))

    @property
    def undetectable(self) -> bool:
        """Whether nobody can tell who is wrong: of few drones, or where all are alike."""
        count, (fixes, _) = len(self.config.ids), self.culprits
        if self.row is None or count < self.row.attributable_from:
            return self.row is not None
        return bool(fixes) and (count < FEWEST_RECEIVERS or len(fixes) == count)

    def flights(self, seeds: Sequence[int]) -> list[Flight]:
        """One of each seed."""
        faults, radio = ((), None) if self.row is None else (self.row.faults, self.row.radio)
        return [Flight(self.config, seed, faults, self.duration_s, radio) for seed in seeds]


def cases(config: FleetConfig, rows: Sequence[FaultRow], sizes: Sequence[int], clean_s: float) -> list[SizedRow]:
    """All rows that make sense in each size, after a flight without any."""
    found = []
    for size in sizes:
        if not 1 < size <= len(config.ids):
            raise InputError("--sizes", "", f"fleets of 2 to the {len(config.ids)} drones of the file", str(size))
        fleet = first_drones(config, size)
        found.append(SizedRow(fleet, None, clean_s))
        placed = [each for row in rows if (each := row.placed(fleet.ids)) is not None]
        found += [SizedRow(fleet, row, row.duration_s) for row in placed]
    return found


def integrity(
    flown: Sequence[SizedRow], *, runs: int, seed: int, jobs: int, folder: Path | None
) -> tuple[list[Figures], list[list[Promises]]]:
    """Fly, print, and return the figures and what they are of; flights kept in ``folder`` are not flown again."""
    seeds = range(seed, seed + runs)
    kept = None if folder is None else folder / "flights"
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
    plans = [KeptFlight(flight, kept) for case in flown for flight in case.flights(seeds)]
    made: list[Promises] = []
    with Hangar(min(jobs, len(plans))) as hangar, progress_bar("flights", len(plans)) as advance:
        for each in hangar.map(promises_of, plans):
            made.append(each)
            advance()
    grouped = [made[at * runs : (at + 1) * runs] for at in range(len(flown))]
    results = [case_figures(case, each) for case, each in zip(flown, grouped, strict=True)]
    _show([each for each in results if not each["undetectable"]], "detectable")
    _show([each for each in results if each["undetectable"]], "not attributable, or not detectable")
    return results, grouped


def case_figures(case: SizedRow, flown: Sequence[Promises]) -> Figures:
    """Of one case over its seeds; times in s since the fault began, ``None`` where it never was."""
    period_s, limits = case.config.fleet.period_s, case.config.integrity
    settled = round(SETTLED_S / period_s)
    error, level = (np.stack([getattr(each, name)[settled:] for each in flown]) for name in ("error_m", "level_m"))
    alert = np.stack([each.alert[settled:] for each in flown])
    limit = np.array([limits.alert_horizontal_m, limits.alert_vertical_m])
    misleading = ((error > level).any(-1)) & ~alert
    begin, end = (0.0, 0.0) if case.row is None else (case.row.begin_s, case.row.end_s)
    times = [_times(case, each, round(begin / period_s), round(end / period_s)) for each in flown]
    ticks, count = alert.shape[1], len(case.config.ids)
    return {
        "row": CLEAN if case.row is None else case.row.name,
        "drones": count,
        "seeds": len(flown),
        "undetectable": case.undetectable,
        "epochs": int(alert.size),
        "drone_hours": alert.size * period_s / 3600.0,
        "availability": float(1.0 - alert.mean()),
        "misleading": int(misleading.sum()),
        "hazardously_misleading": int((misleading & (error > limit).any(-1)).sum()),
        "longest_alert_delay_s": period_s * max(_longest_beyond(each, limit, settled) for each in flown),
        "flight_s": (ticks + settled) * period_s,
        "detected_after_s": [each["detected"] for each in times],
        "named_after_s": [each["named"] for each in times],
        "wrong_named_seeds": sum(each["wrong"] for each in times),
        "false_alarm_seeds": sum(each["early"] for each in times),
    }


def _times(case: SizedRow, flown: Promises, begin: int, end: int) -> dict[str, Any]:
    """When a fault was detected and named, and whether somebody else was, or somebody before it began."""
    period_s = case.config.fleet.period_s
    fixes, ranges = case.culprits
    off = [np.any(each, axis=1) for each in (flown.fixes_off, flown.ranges_off)]  # (T, n): by any drone
    wrong = np.zeros(len(flown.alert), np.bool_)
    right = np.zeros(len(flown.alert), np.bool_)
    for said, culprits in zip(off, (fixes, ranges), strict=True):
        named = np.isin(np.arange(said.shape[1]), list(culprits))
        right |= said[:, named].any(1)
    wrong |= off[0][:, [slot for slot in range(off[0].shape[1]) if slot not in fixes]].any(1)
    if not ranges and not (case.row is not None and any(isinstance(each, RangeFault) for each in case.row.faults)):
        wrong |= off[1][:, [slot for slot in range(off[1].shape[1]) if slot not in fixes]].any(1) & ~right
    anything = off[0].any(1) | off[1].any(1) | flown.somebody.any(1)
    since = slice(begin, None)
    early = anything if case.row is None else anything[:begin]
    return {
        "detected": _first(anything[since] | flown.alert[since].any(1), period_s) if end else None,
        "named": _first(right[since], period_s) if end else None,
        "wrong": bool(wrong[since].any()),
        "early": bool(early.any()),
    }


def _first(said: Any, period_s: float) -> float | None:
    return round(float(np.argmax(said)) * period_s, 6) if said.any() else None


def _longest_beyond(flown: Promises, limit: Any, settled: int) -> int:
    """Ticks, the most in a row, with an error beyond an alert limit and no alert."""
    beyond = ((flown.error_m[settled:] > limit).any(-1)) & ~flown.alert[settled:]
    longest = now = np.zeros(beyond.shape[1], np.int64)
    for tick in beyond:
        now = np.where(tick, now + 1, 0)
        longest = np.maximum(longest, now)
    return int(longest.max(initial=0))


def _show(results: Sequence[Figures], title: str) -> None:
    if not results:
        return
    print_table(
        ["fault", "drones", "epochs", "avail. %", "misleading", "hazardously", "late s", "detected s", "named s",
         "at most", "wrong", "early"],
        [
            [
                each["row"], str(each["drones"]), str(each["epochs"]), f"{100 * each['availability']:.1f}",
                str(each["misleading"]), str(each["hazardously_misleading"]), f"{each['longest_alert_delay_s']:.1f}",
                _middle(each["detected_after_s"]), _middle(each["named_after_s"]), _most(each["named_after_s"]),
                str(each["wrong_named_seeds"]), str(each["false_alarm_seeds"]),
            ]
            for each in results
        ],
        title=title,
    )  # fmt: skip


def _middle(times: Sequence[float | None]) -> str:
    known = [each for each in times if each is not None]
    return f"{np.median(known):.1f}" if known else "-"


def _most(times: Sequence[float | None]) -> str:
    known = [each for each in times if each is not None]
    return "-" if not known else f"{max(known):.1f}" if len(known) == len(times) else "never"
