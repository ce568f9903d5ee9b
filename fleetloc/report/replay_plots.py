"""The plots of a replay's page; colours and style are those of every report (`fleetloc.report.report_plots`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fleetloc.report.fleet_results import Floats, unbroken
from fleetloc.report.report_plots import AXES, figure_of, plain_log, span_of, styled
from sim_bridge.replay.comparison import SERIES
from sim_bridge.replay.statistics import Thinned

Span = tuple[float, float]
"""Of the part that was replayed, s from the start of the logs."""
Windows = Sequence[tuple[float, float]]
OTHERS = ("#999999", "#000000")
"""Truth, and the autopilot's own estimate."""
GAP_S = 2.0
SIGMAS = 3.0
WINDOWS_PERCENT = 98
WIDEST_BAND = 10.0
"""A claim that is larger than the errors by more than this runs out of the picture, where it would flatten them."""


class Series:
    """One agent's thinned series with time from the start of the logs; columns by name."""

    def __init__(self, agent_id: int, thinned: Thinned, agents: int, start_s: float, period_s: float) -> None:
        self.agent_id = agent_id
        self._table = thinned.table(len(SERIES) + agents)
        self.time_s = self._table[:, 0] - start_s
        self.gap_s = max(GAP_S, 3 * thinned.step * period_s)

    def __len__(self) -> int:
        return len(self._table)

    def of(self, kind: str) -> Floats:
        """Columns ``(K, 3)`` north, east, down of ``own``, ``sigma``, ``truth`` or ``autopilot``."""
        return self._table[:, [SERIES.index(f"{kind}_{axis}") for axis in "ned"]]

    def column(self, name: str) -> Floats:
        """One column ``(K,)``."""
        return self._table[:, SERIES.index(name)]

    def age_s(self, slot: int) -> Floats:
        """Age of what is known of an agent ``(K,)``."""
        return self._table[:, len(SERIES) + slot]

    def lines(self, *columns: Floats) -> tuple[Floats, ...]:
        """Time and columns, broken where the time leaps."""
        return unbroken(self.time_s, *columns, gap_s=self.gap_s)

    @property
    def label(self) -> str:
        """What it is called in legends."""
        return f"drone {self.agent_id}"


@styled
def trajectories(series: Sequence[Series], span_s: Span, colour: Mapping[int, str]) -> Figure:
    """Top view and height: truth grey, the autopilot's own dashed, the fleet's estimate in colour."""
    figure = figure_of(4.8)
    above, beside = figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.25)})
    for one in series:
        for kind, style in (
            ("truth", {"color": OTHERS[0], "linewidth": 3.5, "alpha": 0.6}),
            ("autopilot", {"color": OTHERS[1], "linewidth": 0.7, "linestyle": "--"}),
            ("own", {"color": colour[one.agent_id], "linewidth": 1.1}),
        ):
            when, north, east, down = one.lines(*one.of(kind).T)
            label = one.label if kind == "own" else None
            above.plot(east, north, label=label, **style)
            beside.plot(when, -down, **style)
    places = np.vstack([one.of("own") for one in series])
    if len(places):
        above.set_xlim(*span_of(places[:, 1]))
        above.set_ylim(*span_of(places[:, 0]))
        beside.set_ylim(*span_of(-places[:, 2]))
    above.set(title="seen from above", xlabel="east m", ylabel="north m")
    above.set_aspect("equal", adjustable="box")
    beside.set(title="height above the origin", xlabel="time s", ylabel="m", xlim=span_s)
    figure.legend(loc="outside lower center", ncols=8)
    return figure


@styled
def errors(
    series: Sequence[Series],
    span_s: Span,
    colour: Mapping[int, str],
    dropped: Mapping[int, Windows],
    against: str,
) -> Figure:
    """Own position less a reference (``truth`` or ``autopilot``) per axis, in its 3-sigma band; lost GPS shaded."""
    figure = figure_of(0.8 + 1.8 * len(series))
    grid = figure.subplots(len(series), 3, sharex=True, squeeze=False)
    for row, one in zip(grid, series, strict=True):
        error, sigma = one.of("own") - one.of(against), one.of("sigma")
        other = one.of("autopilot") - one.of("truth") if against == "truth" else None
        for axis, axes in enumerate(row):
            when, middle, spread = one.lines(error[:, axis], sigma[:, axis])
            axes.fill_between(
                when, -SIGMAS * spread, SIGMAS * spread, color=colour[one.agent_id], alpha=0.18, linewidth=0
            )
            if other is not None:
                axes.plot(*one.lines(other[:, axis]), color=OTHERS[1], linewidth=0.6, linestyle="--")
            axes.plot(when, middle, color=colour[one.agent_id], linewidth=0.9)
            axes.set(xlim=span_s, ylim=_limits(error[:, axis], sigma[:, axis]))
            _shade(axes, dropped.get(one.agent_id, ()))
        row[0].set_ylabel(f"{one.label}\nm")
    for axes, name in zip(grid[0], AXES, strict=True):
        axes.set_title(name)
    for axes in grid[-1]:
        axes.set_xlabel("time s")
    return figure


@styled
def consistency(
    series: Sequence[Series], span_s: Span, colour: Mapping[int, str], dropped: Mapping[int, Windows]
) -> Figure:
    """NEES over its dimension, of the own state and of the whole fleet's."""
    figure = figure_of(3.0)
    whole, own = figure.subplots(1, 2, sharey=True)
    for axes, name, title in ((whole, "nees", "state of the fleet"), (own, "own_nees", "own state")):
        axes.axhline(1.0, color="#666666", linewidth=0.8, linestyle="--")
        for one in series:
            axes.plot(*one.lines(one.column(name)), color=colour[one.agent_id], linewidth=0.7, label=one.label)
            _shade(axes, dropped.get(one.agent_id, ()))
        axes.set(yscale="log", xlim=span_s, xlabel="time s", title=title)
        plain_log(axes)
    whole.set_ylabel("NEES / dimension")
    figure.legend(*own.get_legend_handles_labels(), loc="outside lower center", ncols=8)
    return figure


@styled
def ages(series: Sequence[Series], agents: Sequence[int], span_s: Span, colour: Mapping[int, str]) -> Figure:
    """How old the news is that each agent has of each other."""
    figure = figure_of(0.8 + 1.3 * len(series))
    grid = figure.subplots(len(series), 1, sharex=True, squeeze=False)[:, 0]
    for axes, one in zip(grid, series, strict=True):
        highest_s = 0.0
        for slot, agent_id in enumerate(agents):
            if agent_id in colour and len(one):
                age_s = one.age_s(slot)
                highest_s = max(highest_s, float(np.percentile(age_s, WINDOWS_PERCENT)))
                axes.plot(*one.lines(age_s), color=colour[agent_id], linewidth=0.8)
        axes.set(xlim=span_s, ylim=(0, max(1.3 * highest_s, 0.5)), ylabel=f"{one.label}\ns")
    grid[-1].set_xlabel("time s")
    return figure


@styled
def latency(
    tables: Mapping[int, Floats], start_s: float, span_s: Span, colour: Mapping[int, str]
) -> Figure:
    """Latency of each drone's GPS as it was estimated, with 1-sigma."""
    figure = figure_of(2.8)
    axes = figure.subplots()
    for agent_id, table in tables.items():
        when, value, sigma = unbroken(table[:, 0] - start_s, table[:, 1], table[:, 2], gap_s=10 * GAP_S)
        axes.fill_between(
            when, 1e3 * (value - sigma), 1e3 * (value + sigma), color=colour[agent_id], alpha=0.18, linewidth=0
        )
        axes.plot(when, 1e3 * value, color=colour[agent_id], linewidth=1.0, label=f"drone {agent_id}")
    axes.set(xlim=span_s, xlabel="time s", ylabel="ms")
    figure.legend(loc="outside lower center", ncols=8)
    return figure


def _shade(axes: Axes, windows: Windows) -> None:
    for from_s, to_s in windows:
        axes.axvspan(from_s, to_s, color="#bbbbbb", alpha=0.35, linewidth=0)


def _limits(error: Floats, sigma: Floats) -> tuple[float, float]:
    """Nearly all of it; a wild start runs out of the picture, and so does a band that hides the error."""
    known = np.abs(error[np.isfinite(error)])
    reach = np.maximum(np.abs(np.nan_to_num(error)), SIGMAS * sigma)
    limit = float(np.percentile(reach, WINDOWS_PERCENT)) if len(reach) else 1.0
    widest = WIDEST_BAND * float(np.percentile(known, WINDOWS_PERCENT)) if len(known) else 0.0
    if widest > 0.0:
        limit = min(limit, widest)
    return -1.15 * limit, 1.15 * limit
