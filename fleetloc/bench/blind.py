"""``fleetloc bench blind``: a drone without GPS, what it still knows and whether it says when it does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.estimator import Status
from fleetloc.bench.sweep import Point, fly
from fleetloc.output import print_table
from sim_bridge.studies.monte_carlo import Method, Sample, mean_and_error
from sim_bridge.studies.study_scenario import GRAPHS, StudyScenario

SAMPLES = 100
FIRST = 80
"""The figures are of t = 80..100."""
SIGMAS = 3.0
FLAGGED = 0.5
"""A run counts as flagged when it says not observable in at least this share of the ticks."""


@dataclass(frozen=True, slots=True)
class BlindCase:
    """The last drone of a graph has no GPS; ``ranges`` it measures, ``goal_m`` for its median error."""

    name: str
    graph: str
    start_sigma_m: float
    goal_m: float | None = None

    @property
    def ranges(self) -> int:
        """Neighbours that the blind drone ranges."""
        agents, edges = GRAPHS[self.graph]
        return sum(agents - 1 in edge for edge in edges)

    def scenario(self) -> StudyScenario:
        """Every agent's estimate of every position is wrong by ``start_sigma_m`` per axis, and knows it."""
        return StudyScenario(self.graph, SAMPLES, blind=1, start_sigma_m=self.start_sigma_m)


CASES = (
    BlindCase("K4", "K4", 2.0, 0.06),
    BlindCase("K5", "K5", 2.0, 0.04),
    BlindCase("K6", "K6", 2.0, 0.04),
    BlindCase("triangle from 0.3 m", "triangle", 0.3, 0.33),
    BlindCase("triangle", "triangle", 2.0),
    BlindCase("ring4", "ring4", 2.0),
    BlindCase("line", "line", 2.0),
)


def blind(
    *, runs: int, seed: int, methods: Mapping[str, Method], jobs: int, cases: Sequence[BlindCase] | None = None
) -> dict[str, Any]:  # fmt: skip
    """Fly the cases (absent: all), print the blind drone's error, consistency and status, return the figures."""
    cases = CASES if cases is None else cases
    points = [Point(case.name, "case", None, case.scenario()) for case in cases]
    flown = fly(points, methods, runs=runs, seed=seed, jobs=jobs)
    rows = {
        case.name: {name: blind_row(sample) for name, sample in each.samples.items()}
        for case, each in zip(cases, flown, strict=True)
    }
    print_table(
        ["case | method", "ranges", "goal m", "median m", "90 % m", "availability", "ANEES own",
         "ANEES fleet", "runs > 3 sigma", "flagged of them", "flagged of the others"],
        [_line(case, name, row) for case in cases for name, row in rows[case.name].items()],
        title=f"The blind drone's own position, {runs} runs, t = {FIRST}..{SAMPLES}",
    )  # fmt: skip
    settings = {"runs": runs, "seed": seed, "first_tick": FIRST, "last_tick": SAMPLES, "sigmas": SIGMAS}
    return {"settings": settings, "rows": rows}


def blind_row(sample: Sample) -> dict[str, float | int]:
    """Figures of the last agent over t = 80..100.

    A run's error is the rms of the own position error over the window, its sigma likewise of the claimed standard
    deviation (root of the trace); *wrong* is a run whose error exceeds three of them.
    """
    error = _per_run_rms(sample.own_position)
    wrong = error > SIGMAS * _per_run_rms(sample.own_sigma)
    flagged = np.array([np.mean(s[FIRST:, -1] == Status.NOT_OBSERVABLE) >= FLAGGED for s in sample.status])
    all_errors = np.concatenate([each[FIRST:, -1] for each in sample.own_position])
    own, own_se = mean_and_error([float(each[FIRST:, -1].mean()) for each in sample.nees_own])
    full, full_se = mean_and_error([float(each[FIRST:].mean()) for each in sample.nees_full])
    served: dict[str, float | int] = {}
    if sample.available:
        served["availability"] = float(np.mean([each[FIRST:, -1].mean() for each in sample.available]))
    return served | {
        "own_position_median_m": float(np.median(all_errors)),
        "own_position_p90_m": float(np.quantile(all_errors, 0.9)),
        "anees_own_mean": own,
        "anees_own_mean_se": own_se,
        "anees_full_mean": full,
        "anees_full_mean_se": full_se,
        "runs": len(error),
        "runs_beyond_3_sigma": int(wrong.sum()),
        "runs_beyond_3_sigma_flagged": int((wrong & flagged).sum()),
        "runs_within_3_sigma_flagged": int((~wrong & flagged).sum()),
    }


def _per_run_rms(arrays: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.array([float(np.sqrt(np.mean(each[FIRST:, -1] ** 2))) for each in arrays])


def _line(case: BlindCase, method: str, row: Mapping[str, float | int]) -> list[str]:
    wrong = row["runs_beyond_3_sigma"]
    return [
        f"{case.name} | {method}",
        str(case.ranges),
        "-" if case.goal_m is None else f"{case.goal_m:g}",
        f"{row['own_position_median_m']:.3f}",
        f"{row['own_position_p90_m']:.3f}",
        f"{row['availability']:.4f}" if "availability" in row else "-",
        f"{row['anees_own_mean']:.2f}",
        f"{row['anees_full_mean']:.2f}",
        f"{wrong} of {row['runs']}",
        f"{row['runs_beyond_3_sigma_flagged']} of {wrong}",
        f"{row['runs_within_3_sigma_flagged']} of {row['runs'] - wrong}",
    ]
