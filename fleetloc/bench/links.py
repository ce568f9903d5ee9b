"""``fleetloc bench loss``: every estimator over links that lose, delay, reorder and double packets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fleetloc.bench.methods import FLAGSHIP, GENIE
from fleetloc.bench.plots import curves, save
from fleetloc.bench.sweep import STEADY_FROM, Flown, Point, fly, numbered, show
from fleetloc.output import print_table, with_error
from sim_bridge.studies.air import Air, bursty, fu_channel, lossy
from sim_bridge.studies.monte_carlo import Method
from sim_bridge.studies.study_scenario import StudyScenario
from transport.link.channel import LinkFaults

CHANNELS: dict[str, tuple[str, Air, str]] = {
    "bursts": ("bursts: loss 0.3, 20 packets on average (Gilbert-Elliott)", bursty(0.3, 20.0), "line"),
    "jitter": ("delay random, 0 to 3 ticks: packets overtake each other", Air(spread_ticks=3.0), "line"),
    "duplicates": ("every other packet twice", Air(LinkFaults(duplicate=0.5), spread_ticks=1.0), "line"),
    "one-way": ("triangle, 1 does not hear 2", Air(deaf=((0, 1),)), "triangle"),
    "fu": ("on time 0.4, a tick late 0.3, lost 0.3 (Fu, Bi, Gao)", fu_channel(), "line"),
}
"""Name -> what it is, the radio, the graph it is flown on."""


def points(losses: Sequence[float], delays_ticks: Sequence[int], channels: Sequence[str]) -> list[Point]:
    """The conditions of the study; lossless is the reference of each axis and always there."""
    line = StudyScenario()
    found = [Point("loss 0", "loss", 0.0, line, None, is_reference=True)]
    found += [Point(f"loss {p:g}", "loss", p, line, lossy(p)) for p in losses if p]
    ticks = [d for d in delays_ticks if d]
    if ticks:
        found.append(Point("delay 0 ticks", "delay_ticks", 0.0, line, None, is_reference=True))
    found += [Point(f"delay {d} ticks", "delay_ticks", float(d), line, Air(delay_ticks=d)) for d in ticks]
    for name in channels:
        what, air, graph = CHANNELS[name]
        found.append(Point(what, f"channel {name}", None, StudyScenario(graph), air))
    return found


def loss(
    *, runs: int, seed: int, losses: Sequence[float], delays_ticks: Sequence[int], channels: Sequence[str],
    methods: Mapping[str, Method], jobs: int, link_seed: int | None = None, out: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Fly all conditions, print the tables with the genie beside the flagship, return (and draw) all figures."""
    flown = fly(points(losses, delays_ticks, channels), methods, runs=runs, seed=seed, jobs=jobs, link_seed=link_seed)
    show(flown, f"{runs} runs, steady t = {STEADY_FROM}..{StudyScenario().samples} (mean ± standard error over runs)")
    if GENIE in methods and FLAGSHIP in methods:
        _beside_the_genie(flown)
    if out is not None:
        for axis, label in (("loss", "probability that a packet is lost"), ("delay_ticks", "delay, ticks")):
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
        title="Beside the genie of the flown exchange: full information on all records that could have arrived",
    )
