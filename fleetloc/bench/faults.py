"""``fleetloc bench faults``: what injected faults make of a fleet, beside the same seeds without them.

A row's figures are pooled over its seeds. *Before* is the last 10 s before the fault, *during* until its end, *after*
from there to the end of the flight. *Hit* are the drones that the fault names (all, if it names none).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from fleetloc.bench.fault_flights import Bools, Flight, Floats, History, fly
from fleetloc.bench.fault_rows import FaultRow
from fleetloc.errors import InputError
from fleetloc.output import print_table, progress_bar
from sim_bridge.faults.fault_tables import about
from sim_bridge.studies.monte_carlo import Hangar

Figures = dict[str, Any]
BEFORE_S = 10.0
BACK = 1.5
"""Over the error without the fault at which a fleet is back."""
BACK_MEAN_S = 1.0
"""Errors are averaged over so long for that: single ticks scatter."""
MISLED_M = 3.0
"""An error above it, with five sigmas below it, misleads."""
P99 = 99.0
ROUNDS_TICKS = 1
"""What is said of a tick is said in the next one, so that a lie reaches the estimate of the tick before it."""
SPANS = ("before", "during", "after")


def faults(config: FleetConfig, rows: Sequence[FaultRow], *, runs: int, seed: int, jobs: int) -> list[Figures]:
    """Fly ``runs`` seeds from ``seed`` on with each row's faults and without, print the matrix, return figures."""
    placed = [(row, found) for row in rows if (found := row.placed(config.ids)) is not None]
    if not placed:
        raise InputError("--rows", "", f"rows for a fleet of {len(config.ids)}", ", ".join(row.name for row in rows))
    seeds = range(seed, seed + runs)
    longest_s = max(row.duration_s for _, row in placed)
    flights = [Flight(config, each, (), longest_s) for each in seeds]
    flights += [Flight(config, each, row.faults, row.duration_s, row.radio) for _, row in placed for each in seeds]
    histories = []
    with Hangar(min(jobs, len(flights))) as hangar, progress_bar("flights", len(flights)) as advance:
        for history in hangar.map(fly, flights):
            histories.append(history)
            advance()
    clean, flown = histories[:runs], histories[runs:]
    results = [
        row_figures(row, Pooled(config.ids, config.fleet.period_s, clean, flown[k * runs : (k + 1) * runs]))
        for k, (_, row) in enumerate(placed)
    ]
    _show(config.fleet.name, results, runs)
    return results


@dataclass(frozen=True, slots=True)
class Pooled:
    """The flights of a row and those of the same seeds without its faults."""

    ids: tuple[int, ...]
    period_s: float
    clean: Sequence[History]
    faulty: Sequence[History]

    def stacked(self, which: Sequence[History], name: str, ticks: slice, slots: Sequence[int]) -> NDArray[Any]:
        """One quantity ``(seeds, ticks, drones)``."""
        return np.stack([getattr(history, name)[ticks][:, list(slots)] for history in which])


def row_figures(row: FaultRow, flown: Pooled) -> Figures:
    """The figures of a row; units are in the names, what is not known is NaN or ``None``."""
    ticks = [round(t_s / flown.period_s) for t_s in (row.begin_s - BEFORE_S, row.begin_s, row.end_s, row.duration_s)]
    before, during, after = (slice(max(a, 0), b) for a, b in pairwise(ticks))
    before = slice(before.start, max(before.stop - ROUNDS_TICKS, before.start))
    since = slice(ticks[1], ticks[3])
    everybody = range(len(flown.ids))
    named = frozenset().union(*(about(fault) for fault in row.faults))
    hit = [slot for slot in everybody if flown.ids[slot] in named] or list(everybody)
    others = [slot for slot in everybody if slot not in hit]
    figures: Figures = {
        "row": row.name, "title": row.title, "seeds": len(flown.faulty),
        "from_s": row.begin_s, "to_s": row.end_s, "hit": [flown.ids[slot] for slot in hit],
    }  # fmt: skip
    for name, span in zip(SPANS, (before, during, after), strict=True):
        figures[name] = _span_figures(flown, span, hit, others)
    figures |= _honesty(flown, since, during, hit)
    told = ticks[1] + round(row.told_within_s / flown.period_s)
    figures["sigmas_p99_unalarmed"] = _unalarmed_sigmas(flown, slice(told, ticks[3]))
    figures["back_after_s"] = back_after_s(flown, ticks[2], ticks[3])
    figures["flagged_after_s"] = _flagged_after_s(flown, during, hit)
    figures["attributable"] = len(flown.ids) >= row.attributable_from
    figures["misses"] = misses(row, figures)
    return figures


def _span_figures(flown: Pooled, span: slice, hit: Sequence[int], others: Sequence[int]) -> Figures:
    """Errors of a part of the flights, and over those without the fault."""
    found: Figures = {}
    for name, slots in (("all", [*hit, *others]), ("hit", hit), ("others", others)):
        own = [_rms(flown.stacked(which, "error_m", span, slots)) for which in (flown.faulty, flown.clean)]
        found[f"position_rmse_{name}_m"], found[f"position_rmse_{name}_clean_m"] = own
        found[f"position_ratio_{name}"] = own[0] / own[1] if slots else math.nan
    state = [_rms(flown.stacked(which, "fleet_m", span, [*hit, *others])) for which in (flown.faulty, flown.clean)]
    found |= {"fleet_rmse_m": state[0], "fleet_rmse_clean_m": state[1], "fleet_ratio": state[0] / state[1]}
    found["worst_m"] = _over(np.max, flown.stacked(flown.faulty, "error_m", span, [*hit, *others]))
    found["availability"] = float(flown.stacked(flown.faulty, "available", span, [*hit, *others]).mean())
    return found


def _honesty(flown: Pooled, since: slice, during: slice, hit: Sequence[int]) -> Figures:
    """What drones claimed from the begin of the fault on, and what they claimed it of."""
    everybody = range(len(flown.ids))

    def stacked(name: str, ticks: slice = since, slots: Sequence[int] = everybody) -> NDArray[Any]:
        return flown.stacked(flown.faulty, name, ticks, slots)

    error, sigma, alarm = stacked("error_m"), stacked("sigma_m"), stacked("alarm")
    misled = (error > MISLED_M) & (5.0 * sigma <= MISLED_M)
    claimed, actual = _rms(stacked("sigma_m", during, hit)), _rms(stacked("error_m", during, hit))
    return {
        "sigmas_p99": _over(lambda values: np.percentile(values, P99), error / sigma),
        "anees_own": _over(np.mean, stacked("nees")),
        "anees_own_hit": _over(np.mean, stacked("nees", slots=hit)),
        "anees_fleet": _over(np.mean, stacked("nees_fleet")),
        "claimed_over_actual_hit": claimed / actual,
        "flagged_share": float(stacked("flagged").mean()),
        "flagged_share_hit_during": float(stacked("flagged", during, hit).mean()),
        "alarm_share": float(alarm.mean()),
        "misleading_share": float(misled.mean()),
        "misleading_without_alarm_share": float((misled & ~alarm).mean()),
    }


def _unalarmed_sigmas(flown: Pooled, span: slice) -> float:
    """Errors over sigmas of a part of the flights that 99 % of the epochs without an alarm keep."""
    error, sigma, alarm = (
        flown.stacked(flown.faulty, name, span, range(len(flown.ids))) for name in ("error_m", "sigma_m", "alarm")
    )
    return _over(lambda values: np.percentile(values, P99), (error / sigma)[~alarm])


def back_after_s(flown: Pooled, end: int, last: int) -> float | None:
    """Time from tick ``end`` on until the fleet stays as good as without the fault, up to ``last``; or ``None``."""
    everybody = range(len(flown.ids))
    window = max(round(BACK_MEAN_S / flown.period_s), 1)
    means = []
    for which in (flown.faulty, flown.clean):
        square = np.nanmean(flown.stacked(which, "error_m", slice(end, last), everybody) ** 2, axis=(0, 2))
        means.append(np.convolve(square, np.full(window, 1.0 / window), mode="valid"))
    ratio = np.sqrt(means[0] / means[1])
    above = np.flatnonzero(~(ratio <= BACK))
    first = int(above[-1]) + 1 if len(above) else 0
    return first * flown.period_s if first < len(ratio) else None


def _flagged_after_s(flown: Pooled, during: slice, hit: Sequence[int]) -> float | None:
    """From the begin of the fault to the first flag of a drone that it hits, the longest over seeds; or ``None``."""
    flags: Bools = np.any(flown.stacked(flown.faulty, "flagged", during, hit), axis=2)
    return float(flags.argmax(axis=1).max()) * flown.period_s if flags.any(axis=1).all() else None


def misses(row: FaultRow, figures: Figures) -> list[str]:
    """Which of a row's bounds its figures do not keep, in words.

    Where nobody can tell whose fault it is, an estimate is pulled along, and an alarm has to say so.
    """
    ratio, sigmas = figures["during"]["position_ratio_all"], figures["sigmas_p99"]
    ratio_at_most, told_within_s = row.ratio_at_most, None
    if not figures["attributable"]:
        unalarmed = figures["sigmas_p99_unalarmed"]
        ratio_at_most, told_within_s, sigmas = None, row.told_within_s, 0.0 if math.isnan(unalarmed) else unalarmed
    back_s, flag_s = (
        math.inf if figures[name] is None else figures[name] for name in ("back_after_s", "flagged_after_s")
    )
    bounds = (
        ("ratio", ratio, ratio_at_most),
        ("sigmas", sigmas, row.sigmas_at_most),
        ("back s", back_s, row.back_within_s),
        ("flag s", flag_s, row.flag_within_s),
        ("told s", flag_s, told_within_s),
        ("claim", figures["claimed_over_actual_hit"], row.claim_at_most),
    )
    found = [
        f"{name} {value:.3g} > {limit:g}"
        for name, value, limit in bounds
        if limit is not None and not value <= limit
    ]
    if figures["misleading_without_alarm_share"] > 0.0:
        found.append("misleads")
    return found


def _rms(values: Floats) -> float:
    return _over(lambda found: np.sqrt(np.mean(found**2)), values)


def _over(of: Any, values: Floats) -> float:
    """A figure of the values that there are; NaN of none."""
    there = values[~np.isnan(values)]
    return float(of(there)) if there.size else math.nan


def _show(fleet: str, results: Sequence[Figures], runs: int) -> None:
    print_table(
        ["fault", "avail. %", "own RMSE m", "during", "after", "fleet RMSE m", "during", "after",
         "ratio", "hit", "others", "back s"],
        [_errors(row) for row in results],
        title=f"{fleet}, {runs} seed(s): errors before, during, after; ratios to the same seeds without the fault",
    )  # fmt: skip
    print_table(
        ["fault", "p99 sigmas", "ANEES own", "fleet", "claimed/actual", "not ok %", "flag s", "misled %", "misses"],
        [_claims(row) for row in results],
        title="from the begin of the fault on: what the drones said of it",
    )


def _errors(row: Figures) -> list[str]:
    spans, during = [row[name] for name in SPANS], row["during"]
    return [
        row["row"],
        f"{100 * min(span['availability'] for span in spans[1:]):.1f}",
        *(_shown(span["position_rmse_all_m"]) for span in spans),
        *(_shown(span["fleet_rmse_m"]) for span in spans),
        *(_shown(during[f"position_ratio_{who}"]) for who in ("all", "hit", "others")),
        "never" if row["back_after_s"] is None else f"{row['back_after_s']:.1f}",
    ]


def _claims(row: Figures) -> list[str]:
    return [
        row["row"],
        *(_shown(row[name]) for name in ("sigmas_p99", "anees_own", "anees_fleet", "claimed_over_actual_hit")),
        f"{100 * row['flagged_share']:.1f}",
        "never" if row["flagged_after_s"] is None else f"{row['flagged_after_s']:.1f}",
        f"{100 * row['misleading_without_alarm_share']:.1f}",
        ", ".join(row["misses"]) or "none",
    ]


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"
