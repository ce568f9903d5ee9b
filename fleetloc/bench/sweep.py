"""Studies over many conditions: every method at every point on the same runs, as figures, tables and plots."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fleetloc.bench.methods import CENTRALISED
from fleetloc.output import print_table, progress_bar, with_error
from sim_bridge.studies.air import Air
from sim_bridge.studies.monte_carlo import Hangar, Method, Sample, accuracy_row, ratio_of_means, run_study
from sim_bridge.studies.study_scenario import StudyScenario

STEADY_FROM = 41
"""First sample that counts as steady (of 70)."""

Figures = dict[str, float | int]


@dataclass(frozen=True, slots=True)
class Point:
    """One condition of a study: where it stands on which axis (``value`` absent: it only has a name)."""

    name: str
    axis: str
    value: float | None
    scenario: StudyScenario
    air: Air | None = None
    is_reference: bool = False
    """The other points of its axis are compared with it, run by run."""


@dataclass(frozen=True, slots=True)
class Flown:
    """A point with each method's sample and figures."""

    point: Point
    samples: Mapping[str, Sample]
    rows: Mapping[str, Figures]

    def document(self) -> dict[str, Any]:
        """For the JSON; the axis carries its unit."""
        scenario = self.point.scenario
        where = {} if self.point.value is None else {self.point.axis: self.point.value}
        return {"name": self.point.name, "graph": scenario.graph, "blind": scenario.blind, **where, "rows": self.rows}


def default_jobs() -> int:
    """As many processes as there are processors for this one."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def fly(
    points: Sequence[Point], methods: Mapping[str, Method], *, runs: int, seed: int, jobs: int,
    link_seed: int | None = None,
) -> list[Flown]:  # fmt: skip
    """Fly every point: the same seeds, hence the same flights and link draws, for all methods and along an axis."""
    flown: list[Flown] = []
    with Hangar(min(jobs, runs)) as hangar, progress_bar("runs", runs * len(methods) * len(points)) as advance:
        for point in points:
            samples = run_study(
                point.scenario, methods, runs, seed, advance, point.air, link_seed=link_seed, hangar=hangar
            )
            last = point.scenario.samples
            rows = {name: accuracy_row(sample, steady_from(last), last) for name, sample in samples.items()}
            flown.append(Flown(point, samples, rows))
    for each in flown:
        _compare(each, next((o for o in flown if o.point.is_reference and o.point.axis == each.point.axis), None))
    return flown


def steady_from(samples: int) -> int:
    """First steady tick of a flight."""
    return min(STEADY_FROM, samples)


def _compare(flown: Flown, reference: Flown | None) -> None:
    """Add ratios on the same runs: to the centralised filter, and to the same method at the axis' reference."""
    last = flown.point.scenario.samples
    first = steady_from(last)
    for name, row in flown.rows.items():
        against = {"centralized": flown.samples.get(CENTRALISED)}
        if reference is not None and reference.point.scenario.samples == last:
            against["reference"] = reference.samples[name]
        for what, other in against.items():
            if other is not None:
                ratio, error = ratio_of_means(flown.samples[name].norm_full, other.norm_full, first, last)
                row[f"norm_full_steady_ratio_to_{what}"] = ratio
                row[f"norm_full_steady_ratio_to_{what}_se"] = error


def show(flown: Sequence[Flown], title: str) -> None:
    """Print a table of errors, one of ratios and consistency; methods are columns."""
    methods = list(flown[0].rows)
    print_table(
        ["steady error", *methods],
        [[each.point.name, *(_error(each.rows[name]) for name in methods)] for each in flown],
        title=title,
    )
    print_table(
        ["steady ANEES | ratio to centralised | to reference", *methods],
        [[each.point.name, *(_ratios(each.rows[name]) for name in methods)] for each in flown],
    )
    print_table(
        ["availability | kB/s that a drone sends", *methods],
        [[each.point.name, *(_served(each.rows[name]) for name in methods)] for each in flown],
    )


def _error(row: Mapping[str, float | int]) -> str:
    return with_error(row["norm_full_steady_mean"], row["norm_full_steady_mean_se"])


def _served(row: Mapping[str, float | int]) -> str:
    """Share of steady ticks with an estimate in time, and what it took; nothing of a method that does not fly."""
    if "availability_steady" not in row:
        return "-"
    return f"{row['availability_steady']:.4f} | {row['sent_all_bytes_per_s'] / 1e3:.1f}"


def _ratios(row: Mapping[str, float | int]) -> str:
    parts = [f"{row['anees_full_steady_mean']:.2f}"]
    for what in ("centralized", "reference"):
        ratio = row.get(f"norm_full_steady_ratio_to_{what}")
        parts.append("-" if ratio is None else f"{ratio:.2f}")
    return " | ".join(parts)


def numbered(flown: Sequence[Flown], axis: str) -> list[Flown]:
    """The points of an axis, in order of its values."""
    found = [each for each in flown if each.point.axis == axis and each.point.value is not None]
    return sorted(found, key=lambda each: each.point.value or 0.0)
