"""The plots of a report as SVG text, drawn without a display and without state of matplotlib's own."""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from agent.config.tables import FleetConfig
from estimators.integrity.consistency import average_nees_band
from estimators.model.layout import STATES_PER_AGENT
from fleetloc.report.fleet_results import AgentTrack, FleetResults, Floats, unbroken
from fleetloc.report.style import STYLE, colour
from sim_bridge.world.sim_table import sim_table

WIDTH_IN = 11.0
Given = ParamSpec("Given")
BAND = "95 % of a consistent estimator's samples"
GAPS = 1.5
"""Ticks further apart than this many periods are not joined by a line."""
SETTLING_S = 5.0
TARGET_COLOUR = "#444444"
AXES = ("north", "east", "down")


Drawing = Callable[Given, Figure]


def styled(draw: Drawing[Given]) -> Callable[Given, str]:
    """Draw in this report's style; the drawing as SVG."""

    @functools.wraps(draw)
    def drawn(*args: Given.args, **kwargs: Given.kwargs) -> str:
        with matplotlib.rc_context(STYLE):
            return _svg(draw(*args, **kwargs))

    return drawn


@styled
def trajectories(config: FleetConfig, results: FleetResults) -> Figure:
    """Top view and height over time: the truth pale and wide, what each drone believes of itself thin on top."""
    figure = figure_of(4.6)
    above, beside = figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.25)})
    time_s = results.truth.time_unix_s - results.start_unix_s
    for slot, track in enumerate(results.tracks):
        truth_m = results.truth.position_m[:, slot]
        above.plot(truth_m[:, 1], truth_m[:, 0], color=colour(slot), alpha=0.3, linewidth=4)
        above.plot(*truth_m[0, 1::-1], "o", color=colour(slot), markersize=6)
        beside.plot(time_s, -truth_m[:, 2], color=colour(slot), alpha=0.3, linewidth=4)
        when, north, east, down = _columns(track, results, track.own_m)
        above.plot(east, north, color=colour(slot), linewidth=0.9, label=f"drone {track.agent_id}")
        beside.plot(when, -down, color=colour(slot), linewidth=0.9)
    for target_id in dict.fromkeys(track.target_id for track in results.targets):
        truth_m = results.truth.position_m[:, results.truth.agents.index(target_id)]
        above.plot(truth_m[:, 1], truth_m[:, 0], color=TARGET_COLOUR, alpha=0.3, linewidth=4)
        beside.plot(time_s, -truth_m[:, 2], color=TARGET_COLOUR, alpha=0.3, linewidth=4)
    for seen in results.targets[:: len(results.tracks)]:  # as the first drone has it
        label = f"target {seen.target_id} by {seen.agent_id}"
        when, north, east, down = unbroken(seen.time_s, *seen.position_m.T, gap_s=GAPS * results.period_s)
        above.plot(east, north, color=TARGET_COLOUR, linewidth=0.9, label=label)
        beside.plot(when, -down, color=TARGET_COLOUR, linewidth=0.9)
    places_m = np.array(list(config.places_m.values())).reshape(-1, 3)
    if len(places_m):
        above.plot(places_m[:, 1], places_m[:, 0], "k^", markersize=5, label="anchors")
    everything = np.concatenate([results.truth.position_m.reshape(-1, 3), places_m])
    _frame(above, everything[:, 1], everything[:, 0])
    beside.set_ylim(*span_of(-everything[:, 2]))
    above.set(title="seen from above", xlabel="east m", ylabel="north m")
    beside.set(title="height above the origin", xlabel="time s", ylabel="m", xlim=(0, results.duration_s))
    above.set_aspect("equal", adjustable="box")
    figure.legend(loc="outside lower center", ncols=min(len(results.tracks), 8))
    return figure


@styled
def errors(config: FleetConfig, results: FleetResults) -> Figure:
    """Own position error per axis within its 3-sigma band, one row per drone; GPS outages are shaded."""
    count = len(results.tracks)
    figure = figure_of(0.6 + 1.7 * count)
    grid = figure.subplots(count, 3, sharex=True, squeeze=False)
    for slot, (row, track) in enumerate(zip(grid, results.tracks, strict=True)):
        limits_m = [_error_limit_m(track, axes) for axes in (slice(0, 2), slice(0, 2), slice(2, 3))]
        for axis, axes in enumerate(row):
            when, error, sigma = _columns(track, results, track.own_error_m[:, axis], track.own_sigma_m[:, axis])
            axes.fill_between(when, -3 * sigma, 3 * sigma, color=colour(slot), alpha=0.18, linewidth=0)
            axes.plot(when, error, color=colour(slot), linewidth=0.8)
            axes.set(ylim=(-limits_m[axis], limits_m[axis]), xlim=(0, results.duration_s))
            for outage in sim_table(config).gps_outages:
                if outage.agent == track.agent_id:
                    axes.axvspan(outage.from_s, outage.to_s, color="#bbbbbb", alpha=0.35, linewidth=0)
        row[0].set_ylabel(f"drone {track.agent_id}\nm")
    for axes, name in zip(grid[0], AXES, strict=True):
        axes.set_title(name)
    for axes in grid[-1]:
        axes.set_xlabel("time s")
    return figure


@styled
def targets(results: FleetResults) -> Figure:
    """Error of each target as each drone had it, over its 3 sigma, a row per target; logarithmic."""
    ids = list(dict.fromkeys(track.target_id for track in results.targets))
    figure = figure_of(0.6 + 2.4 * len(ids))
    grid = figure.subplots(len(ids), 1, sharex=True, squeeze=False)[:, 0]
    for axes, target_id in zip(grid, ids, strict=True):
        seen = [track for track in results.targets if track.target_id == target_id]
        for slot, track in enumerate(seen):
            error_m, sigma_m = (np.linalg.norm(each, axis=1) for each in (track.error_m, track.sigma_m))
            when, error, band = unbroken(track.time_s, error_m, 3 * sigma_m, gap_s=GAPS * results.period_s)
            axes.plot(when, band, color=colour(slot), alpha=0.3, linewidth=3)
            axes.plot(when, error, color=colour(slot), linewidth=0.8, label=f"drone {track.agent_id}")
        axes.set(yscale="log", xlim=(0, results.duration_s), ylabel=f"target {target_id}\nm")
        plain_log(axes)
    grid[-1].set_xlabel("time s")
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6)
    return figure


@styled
def consistency(results: FleetResults) -> Figure:
    """NEES of the fleet state over its dimension, logarithmic, with the band that holds 95 % of samples."""
    figure = figure_of(3.2)
    axes = figure.subplots()
    low, high = average_nees_band(STATES_PER_AGENT * len(results.tracks), 1)
    axes.axhspan(low, high, color="#888888", alpha=0.18, linewidth=0, label=BAND)
    axes.axhline(1.0, color="#666666", linewidth=0.8, linestyle="--")
    for slot, track in enumerate(results.tracks):
        when, values = _columns(track, results, track.nees)
        axes.plot(when, values, color=colour(slot), linewidth=0.8, label=f"drone {track.agent_id}")
    axes.set(yscale="log", xlim=(0, results.duration_s), xlabel="time s", ylabel="NEES / dimension")
    plain_log(axes)
    figure.legend(loc="outside lower center", ncols=6)
    return figure


@styled
def timing(results: FleetResults) -> Figure:
    """When each tick's estimate was out, against its deadline, and how the computing times are distributed."""
    figure = figure_of(3.4)
    over_time, distribution = figure.subplots(1, 2, gridspec_kw={"width_ratios": (1.6, 1)})
    for slot, track in enumerate(results.tracks):
        latency_ms, label = 1e3 * track.latency_s, f"drone {track.agent_id}"
        over_time.plot(track.time_s, latency_ms, ".", markersize=2.5, color=colour(slot), label=label)
        if track.tick_time_s.any():
            ordered = np.sort(1e3 * track.tick_time_s)
            distribution.plot(ordered, 100 * np.arange(1, len(ordered) + 1) / len(ordered), color=colour(slot))
    deadline_ms = 1e3 * results.period_s
    over_time.axhline(deadline_ms, color="#b00020", linewidth=1)
    over_time.annotate(
        "deadline", (results.duration_s, deadline_ms), (0, 3), textcoords="offset points", ha="right", color="#b00020"
    )
    latest_ms = 1e3 * max(track.latency_s.max(initial=0.0) for track in results.tracks)
    over_time.set(
        title="estimate out after the end of its tick",
        xlabel="time s",
        ylabel="ms",
        xlim=(0, results.duration_s),
        ylim=(0, max(1.25 * deadline_ms, 1.1 * latest_ms)),
    )
    distribution.set(title="computing time of a tick", xlabel="ms", ylabel="% of ticks at most", ylim=(0, 101))
    if distribution.lines:
        distribution.set_xscale("log")
        plain_log(distribution, axis="x")
    else:
        distribution.annotate("not measured in virtual time", (0.5, 0.5), xycoords="axes fraction", ha="center")
    figure.legend(loc="outside lower center", ncols=min(len(results.tracks), 8), markerscale=4)
    return figure


@styled
def packets(agents: Sequence[dict[str, Any]]) -> Figure:
    """Packets per drone: what came in, and what did not come, came late or was refused."""
    figure = figure_of(2.8)
    traffic, trouble = figure.subplots(1, 2)
    names = [f"drone {agent['id']}" for agent in agents]
    of = [agent["packets"] for agent in agents]
    _bars(traffic, names, {"sent": [p["sent"] for p in of], "received": [p["received"] for p in of]})
    _bars(
        trouble,
        names,
        {
            "lost": [p["lost"] for p in of],
            "late": [p["late"] for p in of],
            "refused": [sum(p["rejected"].values()) for p in of],
        },
    )
    traffic.set(title="traffic", ylabel="packets")
    trouble.set(title="what went wrong", ylabel="packets")
    return figure


# --- parts --------------------------------------------------------------------------------------------------


def figure_of(height_in: float) -> Figure:
    """An empty figure of the page's width."""
    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def _svg(figure: Figure) -> str:
    """The drawing alone, without XML declaration and date, its width left to the page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return re.sub(r' (?:width|height)="[\d.]+pt"', "", text[text.index("<svg") :], count=2)


def _columns(track: AgentTrack, results: FleetResults, *values: Floats) -> tuple[Floats, ...]:
    """Time and the columns of values where there was an estimate, with gaps at missing ticks."""
    known = track.known
    flat = [column for value in values for column in (value[known].T if value.ndim > 1 else (value[known],))]
    return unbroken(track.time_s[known], *flat, gap_s=GAPS * results.period_s)


def _error_limit_m(track: AgentTrack, axes: slice) -> float:
    """Half height of the plots of some axes: nearly all of the settled run, cut where it is much wider."""
    settled = track.known & (track.time_s >= min(SETTLING_S, track.time_s.max(initial=0) / 2))
    if not settled.any():
        return 1.0
    reach = np.maximum(3 * track.own_sigma_m[settled, axes], np.abs(track.own_error_m[settled, axes]))
    return float(1.2 * np.percentile(reach, 95))


def span_of(values: Floats) -> tuple[float, float]:
    """Limits that show all values with a margin."""
    low, high = float(values.min()), float(values.max())
    margin = 0.08 * max(high - low, 1.0)
    return low - margin, high + margin


def _frame(axes: Axes, x: Floats, y: Floats) -> None:
    """Show the truth with a margin; an estimate that is far off at its start runs out of the picture."""
    axes.set_xlim(*span_of(x))
    axes.set_ylim(*span_of(y))


def plain_log(axes: Axes, axis: str = "y") -> None:
    """Tick labels 0.1, 1, 10 in place of powers."""
    chosen = axes.yaxis if axis == "y" else axes.xaxis
    chosen.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
    chosen.set_minor_formatter(NullFormatter())


def _bars(axes: Axes, names: Sequence[str], series: dict[str, list[int]]) -> None:
    """Bars side by side with their figures above them."""
    width = 0.8 / len(series)
    shades = ("#0072b2", "#8fc1e0", "#c8c8c8")
    for index, (label, values) in enumerate(series.items()):
        at = np.arange(len(names)) + (index - (len(series) - 1) / 2) * width
        axes.bar_label(axes.bar(at, values, width * 0.92, label=label, color=shades[index]), fontsize=7.5)
    axes.set_xticks(np.arange(len(names)), names)
    axes.set_ylim(0, 1.15 * max(1, *(max(values) for values in series.values())))
    axes.grid(False, axis="x")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3)
