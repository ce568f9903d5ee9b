"""``fleetloc bench setmembership``: guaranteed sets on the half circle of Bolting and Fergani 2018."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.sets.relative import RelativeBounds, RelativeFilter
from fleetloc.output import print_table, progress_bar
from sim_bridge.studies.half_circle import HalfCircle, HalfCircleData, draw, kalman_filter, kalman_noise, set_filter

CASES: Mapping[str, HalfCircle] = {
    "code within 3 m, biased": HalfCircle(),
    "code within 2 m, biased": HalfCircle(code_bound_m=2.0),
    "code within 3 m, white": HalfCircle(bias_m=0.0, noise_sigma_m=1.0),
}
SETTLED = 20
"""Epoch from which on the share of the trace that ranges leave is taken."""
SIGMAS = 3.0
STEPS_TIMED = 2000


@dataclass(frozen=True, slots=True)
class FilteredFlight:
    """One filter on one flight: by epoch, whether the truth was outside, the trace and the error of the middle."""

    outside: NDArray[np.bool_]
    trace: NDArray[np.float64]
    middle_error_m: NDArray[np.float64]
    last_half_axes_m: NDArray[np.float64]
    empty: int = 0


def set_membership(*, runs: int, seed: int) -> dict[str, Any]:
    """Fly the cases, print them, return the figures."""
    rows: dict[str, dict[str, float]] = {}
    with progress_bar("flights", len(CASES) * runs) as advance:
        for name, scenario in CASES.items():
            flown: dict[str, list[FilteredFlight]] = {}
            for run in range(runs):
                data = draw(scenario, np.random.default_rng([seed, run]))
                for method, each in _filtered(scenario, data).items():
                    flown.setdefault(method, []).append(each)
                advance()
            rows |= {f"{name} | {method}": _row(each) for method, each in flown.items()}
            rows[f"{name} | set, code and ranges"]["trace_ratio"] = _ratio(flown)
    step_us = step_time_us()
    _print(rows, runs, step_us)
    settings = {"runs": runs, "seed": seed, "sigmas": SIGMAS, "settled_epoch": SETTLED}
    return {"settings": settings, "rows": rows, "step_us": step_us}


def _filtered(scenario: HalfCircle, data: HalfCircleData) -> dict[str, FilteredFlight]:
    noise = kalman_noise(scenario)
    found = {}
    for with_ranges, sensors in ((False, "code"), (True, "code and ranges")):
        sets = list(set_filter(data, with_ranges=with_ranges))
        found[f"set, {sensors}"] = FilteredFlight(
            np.array([held.level(at) > 1.0 for (held, _), at in zip(sets, data.truth_m, strict=True)]),
            np.array([held.trace for held, _ in sets]),
            np.array([np.linalg.norm(held.centre - at) for (held, _), at in zip(sets, data.truth_m, strict=True)]),
            sets[-1][0].half_axes(),
            sum(not sound for _, sound in sets),
        )
        beliefs = list(kalman_filter(data, noise, with_ranges=with_ranges))
        errors = [mean - at for (mean, _), at in zip(beliefs, data.truth_m, strict=True)]
        squares = [e @ np.linalg.solve(spread, e) for e, (_, spread) in zip(errors, beliefs, strict=True)]
        axes = SIGMAS * np.sqrt(np.linalg.eigvalsh(beliefs[-1][1])[::-1])
        found[f"Kalman, {SIGMAS:g} sigma, {sensors}"] = FilteredFlight(
            np.array(squares) > SIGMAS**2,
            np.array([SIGMAS**2 * np.trace(spread) for _, spread in beliefs]),
            np.linalg.norm(errors, axis=1),
            axes,
        )
    return found


def _row(runs: Sequence[FilteredFlight]) -> dict[str, float]:
    """Figures of one filter over all flights; half axes, trace and error are those of the last epoch, means."""
    axes = np.mean([run.last_half_axes_m for run in runs], axis=0)
    return {
        "runs_outside": float(sum(run.outside.any() for run in runs)),
        "epochs_outside_share": float(np.mean([run.outside.mean() for run in runs])),
        "epochs_empty": float(sum(run.empty for run in runs)),
        "trace_m2": float(np.mean([run.trace[-1] for run in runs])),
        "half_axis_1_m": float(axes[0]),
        "half_axis_2_m": float(axes[1]),
        "half_axis_3_m": float(axes[2]),
        "middle_error_m": float(np.mean([run.middle_error_m[-1] for run in runs])),
    }


def _ratio(flown: Mapping[str, Sequence[FilteredFlight]]) -> float:
    """Share of the trace that ranges leave, mean over flights and settled epochs."""
    alone, ranged = (np.stack([run.trace[SETTLED:] for run in flown[f"set, {sensors}"]])
                     for sensors in ("code", "code and ranges"))  # fmt: skip
    return float(np.mean(ranged / alone))


def step_time_us() -> float:
    """Median time of one step of one neighbour's filter, with a fix and a range, least range included."""
    data = draw(replace(HalfCircle(), epochs=STEPS_TIMED + 1), np.random.default_rng(0))
    relative = RelativeFilter(0.1)
    slack, half = np.full(3, data.step_bound_m), np.full(3, data.code_bound_m)
    taken = []
    for k in range(STEPS_TIMED):
        ranges = np.array([[data.range_m[k], data.range_bound_m, 0.0, 0.0, 0.0]])
        bounds = RelativeBounds(data.step_m[k], slack, data.truth_m[k] - half, data.truth_m[k] + half, ranges)
        began = time.perf_counter()
        relative.observe(bounds)
        held = relative.set
        if held is not None:
            held.min_range()
        taken.append(time.perf_counter() - began)
    return float(1e6 * np.median(taken))


def _print(rows: Mapping[str, Mapping[str, float]], runs: int, step_us: float) -> None:
    print_table(
        ["case | filter", "runs outside", "epochs outside", "trace m2", "half axes m", "middle off by m",
         "ranges leave"],
        [
            [
                name,
                f"{row['runs_outside']:.0f} of {runs}",
                f"{row['epochs_outside_share']:.1%}",
                f"{row['trace_m2']:.2f}",
                f"{row['half_axis_1_m']:.2f} {row['half_axis_2_m']:.2f} {row['half_axis_3_m']:.2f}",
                f"{row['middle_error_m']:.2f}",
                f"{row['trace_ratio']:.2f}" if "trace_ratio" in row else "-",
            ]
            for name, row in rows.items()
        ],
        title=f"Half circle, last epoch, {runs} flights; a step takes {step_us:.0f} us per neighbour",
    )  # fmt: skip
