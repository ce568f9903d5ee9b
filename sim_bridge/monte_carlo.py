"""Monte Carlo over the studies' scenario: the same runs for every estimator, figures with standard errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimators.estimator import Status
from estimators.layout import block, position, velocity
from estimators.settings import EstimatorSettings
from sim_bridge.lockstep import LockstepResult, run_lockstep
from sim_bridge.recording import Recording
from sim_bridge.study_scenario import Scenario

Floats = NDArray[np.float64]
Link = Callable[[Recording, np.random.Generator], Recording]

LINK_STREAM = 7
"""Keeps the links' random draws apart from the flight's."""


@dataclass(slots=True)
class Sample:
    """What one estimator did in all runs; arrays have the run first, then tick and agent."""

    norm_full: list[Floats] = field(default_factory=list)
    """Norm of each agent's whole fleet-state error ``(T+1, n)``."""
    own_position: list[Floats] = field(default_factory=list)
    """Norm of the error of the own position ``(T+1, n)``, m."""
    own_velocity: list[Floats] = field(default_factory=list)
    """Likewise of the own velocity, m/s."""
    others_position: list[Floats] = field(default_factory=list)
    """Rms over the other agents of their position error ``(T+1, n)``, m."""
    nees_full: list[Floats] = field(default_factory=list)
    nees_own: list[Floats] = field(default_factory=list)
    step_cpu_s: list[float] = field(default_factory=list)
    """CPU time per agent and tick of each run, everything included."""
    not_converged: int = 0
    fell_back: int = 0

    def add(self, recording: Recording, result: LockstepResult, cpu_s: float) -> None:
        """Add a run."""
        assert recording.truth is not None
        assert result.nees_full is not None
        assert result.nees_own is not None
        ticks, n, _ = recording.truth.shape
        error = result.mean - recording.truth.reshape(ticks, 1, 6 * n)
        self.norm_full.append(np.linalg.norm(error, axis=-1))
        self.own_position.append(_own(error, position))
        self.own_velocity.append(_own(error, velocity))
        self.others_position.append(_others(error))
        self.nees_full.append(result.nees_full)
        self.nees_own.append(result.nees_own)
        self.step_cpu_s.append(cpu_s / (ticks * n))
        self.not_converged += int(np.count_nonzero(result.status == Status.NOT_CONVERGED))
        self.fell_back += int(np.count_nonzero(result.status == Status.FELL_BACK))


def _own(error: Floats, part: Callable[[int], slice]) -> Floats:
    n = error.shape[1]
    return np.stack([np.linalg.norm(error[:, i, part(i)], axis=-1) for i in range(n)], axis=-1)


def _others(error: Floats) -> Floats:
    n = error.shape[1]
    squares = np.stack(
        [np.sum(error[:, :, block(j)][..., :3] ** 2, axis=-1) for j in range(n)], axis=-1
    )  # (T+1, agent, of whom)
    away = ~np.eye(n, dtype=bool)
    return np.asarray(np.sqrt(np.where(away, squares, 0.0).sum(axis=-1) / max(n - 1, 1)))


def run_study(
    scenario: Scenario,
    methods: Mapping[str, EstimatorSettings],
    runs: int,
    seed: int,
    progress: Callable[[], None] | None = None,
    link: Link | None = None,
) -> dict[str, Sample]:
    """Every method on the same ``runs`` runs; ``progress`` is called after each run of each method.

    ``link`` puts loss or delay on a run's links, with a generator of its own (the same for all methods).
    """
    samples = {name: Sample() for name in methods}
    for run in range(runs):
        recording = scenario.record(seed, run)
        if link is not None:
            recording = link(recording, np.random.default_rng([seed, run, LINK_STREAM]))
        for name, settings in methods.items():
            begun = time.process_time()
            result = run_lockstep(recording, settings)
            samples[name].add(recording, result, time.process_time() - begun)
            if progress is not None:
                progress()
    return samples


def mean_and_error(per_run: Sequence[float] | Floats) -> tuple[float, float]:
    """Mean over runs and its standard error (nan with a single run)."""
    values = np.asarray(per_run, float)
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")
    return float(values.mean()), error


def window_mean(arrays: Sequence[Floats], first: int, last: int) -> tuple[float, float]:
    """Mean over ticks first..last and agents, per run; then mean and standard error over runs."""
    return mean_and_error([float(array[first : last + 1].mean()) for array in arrays])


def window_rms(arrays: Sequence[Floats], first: int, last: int) -> tuple[float, float]:
    """Root mean square over ticks first..last, agents and runs; its standard error by the delta method."""
    mean, error = mean_and_error([float((array[first : last + 1] ** 2).mean()) for array in arrays])
    root = float(np.sqrt(mean))
    return root, error / (2.0 * root)


def table1_row(sample: Sample, samples: int) -> dict[str, float | int]:
    """Figures of one line of the paper's Table I: mean over t = 1..T, value at T, step time, failures."""
    mean, mean_error = window_mean(sample.norm_full, 1, samples)
    final, final_error = window_mean(sample.norm_full, samples, samples)
    return {
        "norm_full_mean": mean,
        "norm_full_mean_se": mean_error,
        "norm_full_final": final,
        "norm_full_final_se": final_error,
        "step_time_mean_s": float(np.mean(sample.step_cpu_s)),
        "failures": sample.not_converged + sample.fell_back,
    }


def accuracy_row(sample: Sample, first: int, last: int) -> dict[str, float | int]:
    """Steady and transient accuracy and consistency of one method; steady is t = first..last."""
    row: dict[str, float | int] = {}
    for name, arrays in (
        ("norm_full", sample.norm_full),
        ("own_position", sample.own_position),
        ("own_velocity", sample.own_velocity),
        ("others_position", sample.others_position),
        ("anees_full", sample.nees_full),
        ("anees_own", sample.nees_own),
    ):
        unit = {"own_position": "_m", "others_position": "_m", "own_velocity": "_mps"}.get(name, "")
        row[f"{name}_steady_mean{unit}"], row[f"{name}_steady_mean_se{unit}"] = window_mean(arrays, first, last)
        if not name.startswith("anees"):
            row[f"{name}_steady_rms{unit}"], row[f"{name}_steady_rms_se{unit}"] = window_rms(arrays, first, last)
    row["norm_full_mean"], row["norm_full_mean_se"] = window_mean(sample.norm_full, 1, last)
    row["step_time_mean_s"] = float(np.mean(sample.step_cpu_s))
    row["failures"] = sample.not_converged + sample.fell_back
    return row
