"""Monte Carlo over the studies' scenario: the same runs for every estimator, figures with standard errors."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from estimators.estimator import Status
from estimators.model.layout import block, position, velocity
from estimators.settings import EstimatorSettings
from sim_bridge.studies.air import Air, channel_seed
from sim_bridge.studies.flown import FlownResult, fly_recording
from sim_bridge.studies.genie import Genie
from sim_bridge.studies.lockstep import LockstepResult, run_lockstep
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario

Floats = NDArray[np.float64]
Method = EstimatorSettings | Genie
Given = TypeVar("Given")
Found = TypeVar("Found")


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
    available: list[NDArray[np.bool_]] = field(default_factory=list)
    """Whether an estimate was out within a period of its tick's end ``(T+1, n)``; of flown runs only."""
    bytes_per_s: list[dict[str, float]] = field(default_factory=list)
    """What a drone put on the air, by kind of message and in all; of flown runs only."""
    not_converged: int = 0
    fell_back: int = 0
    own_sigma: list[Floats] = field(default_factory=list)
    """Root of the trace of the own position's covariance ``(T+1, n)``, m."""
    status: list[NDArray[np.int8]] = field(default_factory=list)
    """`estimators.estimator.Status` ``(T+1, n)``."""

    def extend(self, other: Sample) -> None:
        """Append the runs of another sample."""
        for each in fields(self):
            setattr(self, each.name, getattr(self, each.name) + getattr(other, each.name))

    def add_flown(self, recording: StudyInput, flown: FlownResult, cpu_s: float) -> None:
        """Add a run of the agents that fly."""
        self.add(recording, flown.estimates, cpu_s)
        self.available.append(flown.available)
        self.bytes_per_s.append(flown.bytes_per_s)

    def add(self, recording: StudyInput, result: LockstepResult, cpu_s: float) -> None:
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
        variances = np.stack([result.cov_diag[:, i, position(i)].sum(axis=-1) for i in range(n)], axis=-1)
        self.own_sigma.append(np.sqrt(variances))
        self.status.append(result.status)
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


@dataclass(frozen=True, slots=True)
class StudyFlight:
    """One run of a study, to be flown by every method; a function of these values alone."""

    scenario: StudyScenario
    methods: Mapping[str, Method]
    seed: int
    run: int
    air: Air | None = None
    link_seed: int | None = None
    """Of the links' draws; absent: those of ``seed``."""
    flown: bool = True
    """By the agents that fly; else tick by tick (`sim_bridge.studies.lockstep`), with whole links."""

    def fly(self) -> dict[str, Sample]:
        """Each method's sample of this one run.

        A central filter has all records whatever the links do; the genie has those that could have reached an agent
        with its settings.
        """
        recording = self.scenario.record(self.seed, self.run)
        samples, heard = {name: Sample() for name in self.methods}, _FlownOnce(self, recording)
        for name, method in self.methods.items():
            begun = time.process_time()
            if isinstance(method, Genie):
                samples[name].add(recording, method.run(recording, heard.of(method.settings)), _since(begun))
            elif self.flown and method.kind != "centralized_ekf":
                samples[name].add_flown(recording, heard.flight(method), _since(begun))
            else:
                samples[name].add(recording, run_lockstep(recording, method), _since(begun))
        return samples


def _since(begun: float) -> float:
    return time.process_time() - begun


class _FlownOnce:
    """The flights of one run, each flown once: the genie wants to know what reached whom in them."""

    def __init__(self, flight: StudyFlight, recording: StudyInput) -> None:
        self._flight, self._recording = flight, recording
        self._flown: dict[EstimatorSettings, FlownResult] = {}

    def flight(self, settings: EstimatorSettings) -> FlownResult:
        """The run flown with some settings."""
        if settings not in self._flown:
            flight = self._flight
            seed = channel_seed(flight.seed if flight.link_seed is None else flight.link_seed, flight.run)
            self._flown[settings] = fly_recording(self._recording, settings, flight.air, seed=seed)
        return self._flown[settings]

    def of(self, settings: EstimatorSettings) -> NDArray[np.bool_]:
        """Who could know what in it."""
        return self.flight(settings).heard


class Hangar:
    """Does the work of runs one after the other, or in ``jobs`` processes at a time; a context manager."""

    def __init__(self, jobs: int = 1) -> None:
        # spawn: a fork would copy the threads of a progress bar, and with them locks that nobody releases
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(jobs, mp_context=context) if jobs > 1 else None

    def __enter__(self) -> Hangar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, work: Callable[[Given], Found], given: Iterable[Given]) -> Iterator[Found]:
        """``work`` of each, in their order whatever the number of processes; all of it can be pickled."""
        return iter(map(work, given)) if self._pool is None else self._pool.map(work, given)


def run_study(
    scenario: StudyScenario,
    methods: Mapping[str, Method],
    runs: int,
    seed: int,
    progress: Callable[[], None] | None = None,
    air: Air | None = None,
    *,
    link_seed: int | None = None,
    hangar: Hangar | None = None,
    flown: bool = True,
) -> dict[str, Sample]:
    """Every method on the same ``runs`` runs; ``progress`` is called for each run of each method.

    ``air`` puts loss or delay on a run's links, with generators of their own (the same for all methods), whose
    seed is ``link_seed`` or else ``seed``. ``hangar`` flies in several processes. Not ``flown``: tick by tick.
    """
    samples = {name: Sample() for name in methods}
    flights = [StudyFlight(scenario, methods, seed, run, air, link_seed, flown) for run in range(runs)]
    for of_run in (Hangar() if hangar is None else hangar).map(StudyFlight.fly, flights):
        for name, sample in of_run.items():
            samples[name].extend(sample)
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


def ratio_of_means(over: Sequence[Floats], under: Sequence[Floats], first: int, last: int) -> tuple[float, float]:
    """Ratio of the means over ticks first..last of two samples of the same runs, and its standard error.

    By the delta method on the runs' pairs (nan with a single run).
    """
    a, b = (np.array([float(array[first : last + 1].mean()) for array in arrays]) for arrays in (over, under))
    ratio = float(a.mean() / b.mean())
    _, error = mean_and_error((a - ratio * b) / b.mean())
    return ratio, error


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
    if first > 1:
        for name, arrays in (("norm_full", sample.norm_full), ("anees_full", sample.nees_full)):
            transient = window_mean(arrays, 1, first - 1)
            row[f"{name}_transient_mean"], row[f"{name}_transient_mean_se"] = transient
    row["step_time_mean_s"] = float(np.mean(sample.step_cpu_s))
    row["failures"] = sample.not_converged + sample.fell_back
    if sample.available:
        row["availability_steady"] = float(np.mean([each[first : last + 1].mean() for each in sample.available]))
        row["availability"] = float(np.mean([each[: last + 1].mean() for each in sample.available]))
        for name in sample.bytes_per_s[0]:
            row[f"sent_{name}_bytes_per_s"] = float(np.mean([each[name] for each in sample.bytes_per_s]))
    return row
