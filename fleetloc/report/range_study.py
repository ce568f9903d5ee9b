"""``fleetloc ranges`` of a file with true distances: what measured ranges are like, pair by pair."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetloc.errors import InputError
from fleetloc.output import print_table, write_json
from fleetloc.report.pair_calibration import CalibratedPair, name_of, write_lines
from sim_bridge.replay.side_files.range_files import RangeCounts, read_ranges

Floats = NDArray[np.float64]
Antennas = tuple[tuple[int, int], tuple[int, int]]
"""Drone and tag of both ends, the lower ones first."""
NORMAL_OF_MAD = 1.4826
"""1-sigma of a normal distribution by its median absolute deviation."""
MEDIAN_OF_NORMAL = math.sqrt(math.pi / 2.0)
"""1-sigma of the median of many normal values, by theirs over the root of their number."""


@dataclass(frozen=True, slots=True)
class PairFigures:
    """Errors (measured less true, m) of one pair, whoever measured, or of two of its antennas (``tags``).

    ``sigma_m`` is robust: 1.4826 times the median distance from the median. ``outliers`` is the share that lies
    further than a limit from the pair's median.
    """

    pair: tuple[int, int]
    tags: tuple[int, int] | None
    count: int
    bias_m: float
    median_m: float
    median_sigma_m: float
    """1-sigma of the median itself; errors that follow each other closely count as fewer."""
    sigma_m: float
    outliers: float
    worst_m: float


def pair_figures(
    pair: tuple[int, int], errors_m: Floats, outlier_m: float, tags: tuple[int, int] | None = None
) -> PairFigures:
    """Figures of the errors ``(K,)`` of one pair, K at least 1."""
    median_m = float(np.median(errors_m))
    off_m = np.abs(errors_m - median_m)
    sigma_m = NORMAL_OF_MAD * float(np.median(off_m))
    return PairFigures(
        pair=pair,
        tags=tags,
        count=len(errors_m),
        bias_m=float(errors_m.mean()),
        median_m=median_m,
        median_sigma_m=MEDIAN_OF_NORMAL * sigma_m / math.sqrt(_independent(errors_m, median_m, outlier_m)),
        sigma_m=sigma_m,
        outliers=float(np.mean(off_m > outlier_m)),
        worst_m=float(off_m.max()),
    )


def _independent(errors_m: Floats, median_m: float, outlier_m: float) -> float:
    """How many independent errors tell as much: those of a first-order Gauss-Markov sequence, by its first lag."""
    close = errors_m[np.abs(errors_m - median_m) <= outlier_m] - median_m
    count = len(close)
    power = float(close @ close)
    if count < 3 or power == 0.0:
        return float(max(count, 1))
    lag = min(max(float(close[1:] @ close[:-1]) / power, 0.0), 1.0 - 1.0 / count)
    return max(count * (1.0 - lag) / (1.0 + lag), 1.0)


def study_ranges(
    file: Path, outlier_m: float, json_file: Path | None, write: Path | None = None
) -> dict[str, Any]:
    """Print bias, robust sigma and outliers per pair; returns what goes into the JSON file.

    The lines of the configuration go to ``write``.

    Raises `InputError` or `ReplayError` for a file without ranges or without true distances.
    """
    counts = RangeCounts()
    errors: dict[Antennas, list[float]] = {}
    for line in read_ranges(file, counts):
        if line.true_m is None:
            counts.skipped["no true distance"] += 1
            continue
        ends = (line.observer, line.tag), (line.target, line.other_tag)
        errors.setdefault((min(ends), max(ends)), []).append(line.range_m - line.true_m)
    if not errors:
        raise InputError(str(file), "true_m", "a column of true distances (true_m, mocap_range or truth)", "none")
    several = {pair for pair in map(_pair, errors) if sum(_pair(each) == pair for each in errors) > 1}
    pairs = [
        pair_figures(_pair(ends), np.array(values), outlier_m, _tags(ends) if _pair(ends) in several else None)
        for ends, values in sorted(errors.items())
    ]
    figures = {
        "file": file.name,
        "lines_read": counts.read,
        "lines_skipped": dict(counts.skipped),
        "first_bad_lines": counts.lines,
        "outlier_limit_m": outlier_m,
        "pairs": [
            {
                "pair": list(one.pair),
                "tags": None if one.tags is None else list(one.tags),
                "count": one.count,
                "bias_m": one.bias_m,
                "median_m": one.median_m,
                "median_sigma_m": one.median_sigma_m,
                "robust_sigma_m": one.sigma_m,
                "outlier_fraction": one.outliers,
                "worst_from_median_m": one.worst_m,
            }
            for one in pairs
        ],
        "bias_mean_m": float(np.mean([one.bias_m for one in pairs])),
        "bias_spread_m": float(np.std([one.bias_m for one in pairs])),
        "robust_sigma_median_m": float(np.median([one.sigma_m for one in pairs])),
    }
    _print(figures, pairs, counts)
    found = (CalibratedPair(p.pair, p.count, p.median_m, p.median_sigma_m, p.sigma_m, p.tags) for p in pairs)
    write_lines(found, write)
    if json_file is not None:
        write_json(json_file, figures)
    return figures


def _pair(ends: Antennas) -> tuple[int, int]:
    return ends[0][0], ends[1][0]


def _tags(ends: Antennas) -> tuple[int, int]:
    return ends[0][1], ends[1][1]


def _of_all(figures: dict[str, Any]) -> list[str]:
    spread = f"{figures['bias_mean_m']:+.3f} ({figures['bias_spread_m']:.3f} apart)"
    return [spread, "", "", f"{figures['robust_sigma_median_m']:.3f}", "", ""]


def _print(figures: dict[str, Any], pairs: list[PairFigures], counts: RangeCounts) -> None:
    limit = f"> {figures['outlier_limit_m']:g} m off %"
    columns = ["pair", "ranges", "bias m", "median m", "+- m", "robust sigma m", limit, "worst m"]
    rows = [
        [
            name_of(one.pair, one.tags),
            str(one.count),
            f"{one.bias_m:+.3f}",
            f"{one.median_m:+.3f}",
            f"{one.median_sigma_m:.3f}",
            f"{one.sigma_m:.3f}",
            f"{100 * one.outliers:.2f}",
            f"{one.worst_m:.2f}",
        ]
        for one in pairs
    ]
    rows.append(["all", str(sum(one.count for one in pairs)), *_of_all(figures)])
    print_table(columns, rows, title="measured less true distance")
    if counts.skipped:
        rows = [
            [reason, str(n), ", ".join(map(str, counts.lines.get(reason, []))) or "-"]
            for reason, n in counts.skipped.items()
        ]
        print_table(["lines left out", "number", "first at line"], rows)
