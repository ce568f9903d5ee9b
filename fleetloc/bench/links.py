"""``fleetloc bench loss``: every estimator over links that lose, delay, reorder and double packets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fleetloc.bench.methods import FLAGSHIP, GENIE
from fleetloc.bench.plots import curves, save
from fleetloc.bench.sweep import STEADY_FROM, Flown, Point, fly, numbered, show
from fleetloc.output import print_table, with_error
from sim_bridge.studies.link_conditions import (
    with_bursts,
    with_delay,
    with_duplicates,
    with_fu_channel,
    with_loss,
    with_one_way,
)
from sim_bridge.studies.monte_carlo import Method
from sim_bridge.studies.recording import Recording
from sim_bridge.studies.study_scenario import Scenario

Rng = np.random.Generator


def lossy(recording: Recording, rng: Rng, *, probability: float) -> Recording:
    """Bernoulli loss on every directed link."""
    return with_loss(recording, probability, rng)


def late(recording: Recording, _rng: Rng, *, ticks: int) -> Recording:
    """Every packet by as much too late."""
    return with_delay(recording, ticks)


def _bursts(recording: Recording, rng: Rng) -> Recording:
    return with_bursts(recording, 0.3, 5.0, rng)


def _jitter(recording: Recording, rng: Rng) -> Recording:
    return with_delay(recording, 0, 3, rng)


def _duplicates(recording: Recording, rng: Rng) -> Recording:
    return with_duplicates(recording, 0.5, rng)


def _one_way(recording: Recording, _rng: Rng) -> Recording:
    return with_one_way(recording, receiver=0, sender=1)


CHANNELS: dict[str, tuple[str, Callable[[Recording, Rng], Recording], str]] = {
    "bursts": ("bursts: loss 0.3, 5 ticks on average (Gilbert-Elliott)", _bursts, "line"),
    "jitter": ("delay random, 0 to 3 ticks: packets overtake each other", _jitter, "line"),
    "duplicates": ("every other packet twice", _duplicates, "line"),
    "one-way": ("triangle, 1 does not hear 2", _one_way, "triangle"),
    "fu": ("on time 0.4, a tick late 0.3, lost 0.3 (Fu, Bi, Gao)", with_fu_channel, "line"),
}
"""Name -> what it is, the link, the graph it is flown on."""


def points(losses: Sequence[float], delays_ticks: Sequence[int], channels: Sequence[str]) -> list[Point]:
    """The conditions of the study; lossless is the reference of each axis and always there."""
    line = Scenario()
    found = [Point("loss 0", "loss", 0.0, line, None, is_reference=True)]
    found += [Point(f"loss {p:g}", "loss", p, line, partial(lossy, probability=p)) for p in losses if p]
    ticks = [d for d in delays_ticks if d]
    if ticks:
        found.append(Point("delay 0 ticks", "delay_ticks", 0.0, line, None, is_reference=True))
    found += [Point(f"delay {d} ticks", "delay_ticks", float(d), line, partial(late, ticks=d)) for d in ticks]
    for name in channels:
        what, link, graph = CHANNELS[name]
        found.append(Point(what, f"channel {name}", None, Scenario(graph), link))
    return found


def loss(
    *, runs: int, seed: int, losses: Sequence[float], delays_ticks: Sequence[int], channels: Sequence[str],
    methods: Mapping[str, Method], jobs: int, link_seed: int | None = None, out: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Fly all conditions, print the tables with the genie beside the flagship, return (and draw) all figures."""
    flown = fly(points(losses, delays_ticks, channels), methods, runs=runs, seed=seed, jobs=jobs, link_seed=link_seed)
    show(flown, f"{runs} runs, steady t = {STEADY_FROM}..{Scenario().samples} (mean ± standard error over runs)")
    if GENIE in methods and FLAGSHIP in methods:
        _beside_the_genie(flown)
    if out is not None:
        for axis, label in (("loss", "probability of loss per link and tick"), ("delay_ticks", "delay, ticks")):
            along = numbered(flown, axis)
            if len(along) > 1:
                save(curves(along, label), out, axis)
    settings = {"runs": runs, "seed": seed, "link_seed": link_seed, "steady_from": STEADY_FROM}
    document = {"settings": settings, "points": [each.document() for each in flown]}
    return document | {"rows": {each.point.name: each.rows for each in flown}}


def _beside_the_genie(flown: Sequence[Flown]) -> None:
    """The flagship against what could be known over the links as they were."""
    print_table(
        ["links", FLAGSHIP, GENIE, "ratio", f"{FLAGSHIP} ANEES", f"{GENIE} ANEES"],
        [
            [
                each.point.name,
                *(with_error(row["norm_full_steady_mean"], row["norm_full_steady_mean_se"]) for row in rows),
                f"{rows[0]['norm_full_steady_mean'] / rows[1]['norm_full_steady_mean']:.2f}",
                *(f"{row['anees_full_steady_mean']:.2f}" for row in rows),
            ]
            for each in flown
            for rows in [(each.rows[FLAGSHIP], each.rows[GENIE])]
        ],
        title="Beside the genie: full information on all records that could have arrived",
    )
