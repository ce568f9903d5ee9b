"""``fleetloc bench partition``: a mesh of five falls apart into two and three, and heals.

Beside every run flies the same one without the cut. Both lose some packets on every link: on perfect links all
members of a mesh solve one and the same problem, and what they disagree by is rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.settings import EstimatorSettings
from fleetloc.bench.plots import islands, save
from fleetloc.output import print_table, progress_bar
from sim_bridge.studies.air import Air, channel_seed
from sim_bridge.studies.flown import fly_recording
from sim_bridge.studies.monte_carlo import Hangar
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario
from transport.link.channel import LinkFaults

Floats = NDArray[np.float64]

AGREED = 1.2
"""Disagreement over its clean value at which the islands are one again."""


@dataclass(frozen=True, slots=True)
class PartitionPlan:
    """When the fleet falls apart, for how long, and how long it is watched afterwards."""

    settings: EstimatorSettings
    seed: int
    graph: str = "K5"
    island: tuple[int, ...] = (0, 1)
    """Slots of one island; the others are the other."""
    begin_s: float = 8.0
    length_s: float = 20.0
    after_s: float = 10.0
    turn_every_s: float | None = None
    """How often the vehicles set out for a new place; absent: they hover once they are where they belong."""
    ranges_cut: bool = True
    """Out of sight: no ranges between the islands either."""
    loss: float = 0.1
    """Of every packet, all the time."""
    period_s: float = 0.1

    @property
    def cut(self) -> tuple[int, int]:
        """First tick of the partition, first after it."""
        return round(self.begin_s / self.period_s), round((self.begin_s + self.length_s) / self.period_s)

    def recording(self, run: int, *, cut: bool) -> StudyInput:
        """What is measured in a run; with the cut no ranges between the islands, if they are out of sight."""
        ticks = self.cut[1] + round(self.after_s / self.period_s)
        recording = StudyScenario(self.graph, ticks, self.period_s, turn_every_s=self.turn_every_s).record(
            self.seed, run
        )
        if not (cut and self.ranges_cut):
            return recording
        inside = np.isin(np.arange(len(recording.agents)), self.island)
        ranges = recording.ranges.copy()
        ranges[slice(*self.cut), inside[:, None] != inside[None, :]] = np.nan
        return replace(recording, ranges=ranges)

    def air(self, *, cut: bool) -> Air:
        """The radio of a run."""
        return Air(LinkFaults(loss=self.loss), cut=(self.island, *self.cut) if cut else None)


@dataclass(frozen=True, slots=True)
class PartitionOutcome:
    """One run, cut and clean; arrays over ticks ``(T+1,)``."""

    anees: tuple[Floats, Floats]
    """NEES over its dimension, mean over the members of the island and of the rest."""
    disagreement: Floats
    """Rms over pairs from different islands of the norm of the difference of their means."""
    clean_disagreement: Floats
    error: Floats
    """Mean norm of the fleet-state error of all members."""
    clean_error: Floats
    available: float
    """Share of ticks with an estimate in time, of the run with the cut."""


def fly_once(plan: PartitionPlan, run: int) -> PartitionOutcome:
    """One run with the partition and without."""
    whole, seed = plan.recording(run, cut=False), channel_seed(plan.seed, run)
    flown_whole = fly_recording(whole, plan.settings, plan.air(cut=False), seed=seed)
    flown_cut = fly_recording(plan.recording(run, cut=True), plan.settings, plan.air(cut=True), seed=seed)
    clean, parted = flown_whole.estimates, flown_cut.estimates
    assert parted.nees_full is not None
    assert whole.truth is not None
    truth = whole.truth.reshape(len(whole.truth), 1, -1)
    ins = list(plan.island)
    outs = [slot for slot in range(len(whole.agents)) if slot not in ins]
    return PartitionOutcome(
        (parted.nees_full[:, ins].mean(axis=1), parted.nees_full[:, outs].mean(axis=1)),
        between(parted.mean, ins, outs),
        between(clean.mean, ins, outs),
        np.linalg.norm(parted.mean - truth, axis=-1).mean(axis=1),
        np.linalg.norm(clean.mean - truth, axis=-1).mean(axis=1),
        float(flown_cut.available.mean()),
    )


def between(mean: Floats, some: Sequence[int], others: Sequence[int]) -> Floats:
    """Rms norm ``(T+1,)`` of the difference of two agents' means ``(T+1, n, 6n)``, one of each group."""
    difference = mean[:, list(some), None] - mean[:, None, list(others)]
    return np.asarray(np.sqrt(np.mean(np.sum(difference**2, axis=-1), axis=(1, 2))))


def agrees_after(ratio: Floats, healed: int) -> int | None:
    """Ticks after ``healed`` from which on ``ratio`` ``(T+1,)`` stays at or below `AGREED`; None if never."""
    above = np.flatnonzero(ratio[healed:] > AGREED)
    first = int(above[-1]) + 1 if len(above) else 0
    return first if healed + first < len(ratio) else None


def partition(plan: PartitionPlan, *, runs: int, jobs: int, out: Path | None = None) -> dict[str, Any]:
    """Fly the runs, print when islands were inconsistent and when they agree again, return the figures."""
    with Hangar(min(jobs, runs)) as hangar, progress_bar("runs", runs) as advance:
        outcomes = []
        for outcome in hangar.map(partial(fly_once, plan), range(runs)):
            outcomes.append(outcome)
            advance()
    results = figures(plan, outcomes)
    shown = {key: value for key, value in results.items() if not isinstance(value, dict | list)}
    print_table(
        ["figure", "value"],
        [[key, _shown(value)] for key, value in shown.items()],
        title=f"{plan.graph} cut into {len(plan.island)} + the rest for {plan.length_s:g} s, {runs} runs",
    )
    if out is not None:
        time_s, anees, apart = _curves(plan, outcomes)
        save(islands(time_s, anees, apart, (plan.begin_s, plan.begin_s + plan.length_s)), out, "partition")
    return results


def figures(plan: PartitionPlan, outcomes: Sequence[PartitionOutcome]) -> dict[str, Any]:
    """ANEES of the islands while cut and after, errors, and how long after healing they agree.

    ANEES per tick is the mean over runs and members; the largest of these, and of their means over a second.
    """
    _, anees, apart = _curves(plan, outcomes)
    first, healed = plan.cut
    second = round(1.0 / plan.period_s)
    results: dict[str, Any] = {
        "runs": len(outcomes),
        "seed": plan.seed,
        "loss": plan.loss,
        "ranges_cut": plan.ranges_cut,
        "turn_every_s": plan.turn_every_s,
        "availability": float(np.mean([outcome.available for outcome in outcomes])),
    }
    for name, line in anees.items():
        during = line[first:]
        results[f"anees_{name}_largest_of_a_tick"] = float(during.max())
        results[f"anees_{name}_largest_of_a_second"] = float(_smoothed(during, second).max())
        results[f"anees_{name}_mean_while_cut"] = float(line[first:healed].mean())
    ratio = apart["cut"] / apart["clean"]
    ticks = agrees_after(ratio, healed)
    results["disagreement_norm_at_the_end_of_the_cut"] = float(apart["cut"][healed - 1])
    results["disagreement_norm_clean"] = float(apart["clean"][first:].mean())
    results["disagreement_ratio_at_the_end_of_the_cut"] = float(ratio[healed - 1])
    results["disagreement_ratio_5s_after"] = float(ratio[healed + 5 * second])
    for after_s in (1, 5):
        results[f"disagreement_norm_{after_s}s_after"] = float(apart["cut"][healed + after_s * second])
    results["agrees_again_after_s"] = None if ticks is None else ticks * plan.period_s
    for name in ("error", "clean_error"):
        line = np.mean([getattr(outcome, name) for outcome in outcomes], axis=0)
        results[f"norm_full_{name}_while_cut"] = float(line[first:healed].mean())
        results[f"norm_full_{name}_last_5s"] = float(line[-5 * second :].mean())
    return results


def _curves(
    plan: PartitionPlan, outcomes: Sequence[PartitionOutcome]
) -> tuple[Floats, dict[str, Floats], dict[str, Floats]]:
    """Time, ANEES per island and disagreement (cut, clean), over the runs."""
    anees: dict[str, Floats] = {
        name: np.mean([outcome.anees[which] for outcome in outcomes], axis=0)
        for which, name in enumerate(("island", "rest"))
    }
    apart: dict[str, Floats] = {
        name: np.sqrt(np.mean(np.square([getattr(outcome, field) for outcome in outcomes]), axis=0))
        for name, field in (("cut", "disagreement"), ("clean", "clean_disagreement"))
    }
    return np.arange(len(anees["island"]), dtype=float) * plan.period_s, anees, apart


def _smoothed(line: Floats, ticks: int) -> Floats:
    """Mean over the last ``ticks`` values, fewer at the beginning."""
    total = np.concatenate([[0.0], np.cumsum(line)])
    ends = np.arange(1, len(line) + 1)
    begins = np.maximum(ends - ticks, 0)
    return np.asarray((total[ends] - total[begins]) / (ends - begins))


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
