"""Monte Carlo studies behind ``fleetloc bench table1``, ``accuracy`` and ``loss``."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from msgspec.structs import replace

from estimators.settings import EstimatorSettings
from fleetloc.output import print_table, progress_bar, with_error
from sim_bridge.link_conditions import with_delay, with_loss
from sim_bridge.monte_carlo import Link, Sample, accuracy_row, run_study, table1_row
from sim_bridge.recording import Recording
from sim_bridge.study_scenario import Scenario

RELAY = EstimatorSettings(
    kind="dmhe_relay", window=6, rounds=2, share_inputs="fleet", relay_hops=2, unknown_inputs="hold"
)
"""The relay estimator as docs/algorithms.md recommends it (configs/relay.toml)."""

STEADY_FROM = 41
"""First sample that counts as steady (of 70)."""

PAPER_TABLE1 = {
    "dekf_ci": (2.7651, 0.7059),
    "dmhe": (1.6371, 0.6906),
    "dmhe_pre_ekf": (1.7009, 0.6104),
    "dmhe_pre_ekf_2": (1.6709, 0.5980),
}
"""RMSE and final RMSE that the paper prints."""


def table1(
    *, runs: int, seed: int, period_s: float, samples: int, other_accel_variance: float, start: str
) -> dict[str, Any]:
    """Run the four methods of Table I, print the table, return it."""
    common = EstimatorSettings(other_accel_variance=other_accel_variance, max_iterations=500)
    methods = {
        "dekf_ci": replace(common, kind="dekf_ci"),
        "dmhe": replace(common, kind="dmhe"),
        "dmhe_pre_ekf": replace(common, kind="dmhe_pre_ekf"),
        "dmhe_pre_ekf_2": replace(common, kind="dmhe_pre_ekf", rounds=2),
    }
    scenario = Scenario("line", samples, period_s, "paper" if start == "paper" else "good")
    study = _run(scenario, methods, runs, seed)
    rows = {name: table1_row(sample, samples) for name, sample in study.items()}
    print_table(
        ["method", "mean error", "final error", "step ms", "not converged", "fell back", "paper: mean", "final"],
        [
            [
                name,
                with_error(row["norm_full_mean"], row["norm_full_mean_se"]),
                with_error(row["norm_full_final"], row["norm_full_final_se"]),
                f"{1e3 * row['step_time_mean_s']:.3f}",
                str(study[name].not_converged),
                str(study[name].fell_back),
                *(f"{value:.4f}" for value in PAPER_TABLE1[name]),
            ]
            for name, row in rows.items()
        ],
        title=f"Norm of the fleet-state error, {runs} runs, t = 1..{samples} and t = {samples}",
    )
    settings = {
        "runs": runs,
        "seed": seed,
        "period_s": period_s,
        "samples": samples,
        "other_accel_variance": other_accel_variance,
        "start": start,
    }
    return {"settings": settings, "rows": rows}


def accuracy(
    *, runs: int, seed: int, graph: str, samples: int, period_s: float, start: str, blind: int,
    methods: dict[str, EstimatorSettings],
) -> dict[str, Any]:  # fmt: skip
    """Run methods on one scenario, print steady accuracy and consistency, return all figures."""
    scenario = Scenario(graph, samples, period_s, "paper" if start == "paper" else "good", blind)
    first = min(STEADY_FROM, samples)
    study = _run(scenario, methods, runs, seed)
    rows = {name: accuracy_row(sample, first, samples) for name, sample in study.items()}
    print_table(
        ["method", "steady", "all samples", "own position m", "own velocity m/s", "ANEES", "ANEES own", "failures"],
        [
            [
                name,
                with_error(row["norm_full_steady_mean"], row["norm_full_steady_mean_se"]),
                with_error(row["norm_full_mean"], row["norm_full_mean_se"]),
                with_error(row["own_position_steady_mean_m"], row["own_position_steady_mean_se_m"]),
                with_error(row["own_velocity_steady_mean_mps"], row["own_velocity_steady_mean_se_mps"]),
                with_error(row["anees_full_steady_mean"], row["anees_full_steady_mean_se"], 2),
                with_error(row["anees_own_steady_mean"], row["anees_own_steady_mean_se"], 2),
                str(row["failures"]),
            ]
            for name, row in rows.items()
        ],
        title=f"{graph}, {runs} runs, steady t = {first}..{samples} (mean ± standard error over runs)",
    )
    settings = {
        "runs": runs,
        "seed": seed,
        "graph": graph,
        "samples": samples,
        "period_s": period_s,
        "start": start,
        "blind": blind,
        "steady_from": first,
    }
    return {"settings": settings, "rows": rows}


def default_methods(other_accel_variance: float) -> dict[str, EstimatorSettings]:
    """The estimators that every accuracy study compares."""
    q = other_accel_variance
    return {
        "dmhe_pre_ekf": EstimatorSettings(kind="dmhe_pre_ekf", other_accel_variance=q),
        "dmhe": EstimatorSettings(kind="dmhe", other_accel_variance=q),
        "dekf_ci": EstimatorSettings(kind="dekf_ci", other_accel_variance=q),
        "dekf_ci_shared": EstimatorSettings(kind="dekf_ci", share_inputs="neighbours", other_accel_variance=q),
        "dmhe_pre_ekf_shared": EstimatorSettings(share_inputs="neighbours", other_accel_variance=q),
        "dmhe_relay": RELAY,
        "centralized_iekf": EstimatorSettings(kind="centralized_ekf", iterations_ekf=20),
    }


def _run(
    scenario: Scenario, methods: dict[str, EstimatorSettings], runs: int, seed: int
) -> dict[str, Sample]:
    with progress_bar("runs", runs * len(methods)) as advance:
        return run_study(scenario, methods, runs, seed, advance)


def loss(
    *, runs: int, seed: int, losses: list[float], delays_ticks: list[int], methods: dict[str, EstimatorSettings]
) -> dict[str, Any]:
    """Methods under Bernoulli loss and under constant delay on every link of the line of three."""
    scenario = Scenario()
    first, last = STEADY_FROM, scenario.samples
    conditions: dict[str, Link] = {f"loss {p:g}": partial(_lossy, probability=p) for p in losses}
    conditions |= {f"delay {ticks} ticks": partial(_late, ticks=ticks) for ticks in delays_ticks}
    rows: dict[str, dict[str, Any]] = {}
    with progress_bar("runs", runs * len(methods) * len(conditions)) as advance:
        for name, link in conditions.items():
            study = run_study(scenario, methods, runs, seed, advance, link)
            rows[name] = {method: accuracy_row(sample, first, last) for method, sample in study.items()}
    print_table(
        ["links", *(f"{method}: error" for method in methods), *(f"{method}: ANEES" for method in methods)],
        [
            [
                name,
                *(with_error(row["norm_full_steady_mean"], row["norm_full_steady_mean_se"]) for row in each.values()),
                *(f"{row['anees_full_steady_mean']:.2f}" for row in each.values()),
            ]
            for name, each in rows.items()
        ],
        title=f"line, {runs} runs, steady t = {first}..{last}",
    )
    return {"settings": {"runs": runs, "seed": seed, "steady_from": first}, "rows": rows}


def _lossy(recording: Recording, rng: np.random.Generator, *, probability: float) -> Recording:
    return with_loss(recording, probability, rng)


def _late(recording: Recording, _rng: np.random.Generator, *, ticks: int) -> Recording:
    return with_delay(recording, ticks)
