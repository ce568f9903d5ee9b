"""A replay's page: one file, no network, readable in any browser and on paper."""

from __future__ import annotations

from html import escape
from typing import Any

from fleetloc.extras import is_installed, sentence
from fleetloc.report.replay_figures import ReplayResults
from fleetloc.report.replay_tables import ANEES_EXPLAINED, cautions, error_table, fit_table, log_table
from fleetloc.report.report_html import CSS, counted
from fleetloc.report.style import NO_PLOTS, colour
from fleetloc.run.replay_run import Replayed
from fleetloc.run.replay_setup import Prepared

SYNTHETIC = (
    "SYNTHETIC RANGES. The ranges between the drones were not measured: they are made of the truth, with {model}. "
    "This page shows what the fleet could have known on this flight."
)


LONG_CELL, WORDS = 30, ' class="words"'
"""Characters from which on a cell may be broken into lines."""
Section = tuple[str, str, str]
"""Heading, a sentence on it, and HTML."""


def page(prepared: Prepared, sections: list[Section], figures: dict[str, Any]) -> str:
    """The whole page of a replay; ``figures`` is the content of ``report.json``."""
    name = escape(f"{prepared.config.fleet.name}: replay")
    body = "\n".join(
        f'<h2>{escape(title)}</h2>\n<p class="note">{escape(note)}</p>\n{content}'
        for title, note, content in sections
    )
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{name}</title>\n'
        f"<style>{CSS}</style>\n</head>\n<body>\n<h1>{name}</h1>\n{_warnings(figures)}"
        f'<p class="note"><strong>{escape(figures["verdict"]["line"])}</strong></p>\n'
        f'<p class="note">{escape(_summary(prepared, figures))}</p>\n{body}\n</body>\n</html>\n'
    )


def drawn_sections(
    prepared: Prepared, replayed: Replayed, results: ReplayResults, figures: dict[str, Any]
) -> list[Section]:
    """Tables and plots of a page, which is most of the work on it; tables only without the plotting library."""
    tables = [
        ("Errors", "In metres. Horizontal and whole errors of each drone's estimate of itself against the truth, per "
         f"part of the run. {ANEES_EXPLAINED[0].upper()}{ANEES_EXPLAINED[1:]}.",
         _table(*error_table(figures))),
        ("Fit", "Mean and largest of the normalised squared residuals of each drone's sensors and of the ranges to "
         "each neighbour, averaged over three seconds, a residual counting 10 at most: about 1 if a sensor is as "
         "good as it claims; the weights of fixes are 1 for all that is no outlier.", _table(*fit_table(figures))),
        ("Logs", "Samples that were used, and content that was not, by reason.", _table(*log_table(figures))),
    ]  # fmt: skip
    return tables + _plots(prepared, replayed, results, figures) if is_installed("report") else tables


def _plots(prepared: Prepared, replayed: Replayed, results: ReplayResults, figures: dict[str, Any]) -> list[Section]:
    from fleetloc.report import replay_plots
    from fleetloc.report.report_plots import packets

    config, inputs = prepared.config, prepared.inputs
    colours = {agent_id: colour(slot) for slot, agent_id in enumerate(config.ids) if agent_id in results.compared}
    series = [
        replay_plots.Series(agent_id, compared.series, len(config.ids), inputs.plan.zero_s, config.fleet.period_s)
        for agent_id, compared in results.compared.items()
    ]  # fmt: skip
    span_s = figures["from_s"], figures["to_s"]
    dropped: dict[int, list[tuple[float, float]]] = {}
    for drop in figures["gps_dropped"]:
        dropped.setdefault(drop["agent"], []).append((drop["from_s"], drop["to_s"]))
    latencies = {agent_id: thinned.table(3) for agent_id, thinned in replayed.latency.items()}
    has_truth = any(len(references.truth) for references in results.references.values())
    sections = [
        ("Where they were", "Colour: the fleet's estimate; black, dashed: the autopilot's own; grey: truth.",
         replay_plots.trajectories(series, span_s, colours)),
    ]  # fmt: skip
    if has_truth:
        sections += [
            ("Error against the truth, with the 3-sigma band",
             "Colour: the fleet's estimate of the drone itself, and what it claims. Black, dashed: the autopilot's "
             "own estimate. Grey: GPS of this drone was dropped.",
             replay_plots.errors(series, span_s, colours, dropped, "truth")),
            ("Consistency", "Near 1 is right, above it the estimator is overconfident, below it is cautious.",
             replay_plots.consistency(series, span_s, colours, dropped)),
        ]  # fmt: skip
    elif any(len(references.autopilot) for references in results.references.values()):
        sections.append(
            ("Difference to the autopilot's own estimate", _AUTOPILOT_NOTE,
             replay_plots.errors(series, span_s, colours, dropped, "autopilot"))
        )  # fmt: skip
    if latencies:
        sections.append(
            ("Latency of GPS", "How much older a position is than its stamp: as known beforehand, then learned from "
             "manoeuvres; the band is 1-sigma.",
             replay_plots.latency(latencies, inputs.plan.zero_s, span_s, colours))
        )  # fmt: skip
    sections += [
        ("Age of the news", "By drone: how old the newest measurement of each drone (its colour) is in its estimate.",
         replay_plots.ages(series, config.ids, span_s, colours)),
        ("Packets", "On the virtual radio between the drones.", packets(figures["agents"])),
    ]  # fmt: skip
    return sections


_AUTOPILOT_NOTE = (
    "Own estimate less the autopilot's. Its position is about its own origin; where the log does not say where that "
    "is, a constant offset is no disagreement."
)


def _summary(prepared: Prepared, figures: dict[str, Any]) -> str:
    config, fleet = prepared.config, figures["fleet"]
    return (
        f"{counted(len(figures['agents']), 'drone')}, {figures['duration_s']:.0f} s of logs, "
        f"{fleet['times_real_time']:.1f} times faster than real time; {config.estimator.kind}, "
        f"window {config.estimator.window}, {counted(config.estimator.rounds, 'round')}, "
        f"{1 / config.fleet.period_s:g} Hz; loss {config.transport.loss:g}, "
        f"delay {config.transport.delay_s:g} s; seed {figures['seed']}. Truth: {figures['truth']}. Ranges: "
        f"{figures['ranges']}. Clocks: {figures['clocks']}. Origin: {figures['origin']}."
    )


def _warnings(figures: dict[str, Any]) -> str:
    sentences = []
    if figures["synthetic_ranges"]:
        sentences.append(SYNTHETIC.format(model=figures["ranges"].partition(": ")[2]))
    sentences += [
        f"GPS of drone {drop['agent']} was dropped on request from {drop['from_s']:.1f} to {drop['to_s']:.1f} s"
        for drop in figures["gps_dropped"]
    ]
    sentences += cautions(figures)
    if not is_installed("report"):
        sentences.append(sentence("report", NO_PLOTS))
    return "".join(f'<p class="warning">{escape(each)}</p>\n' for each in sentences)


def _table(columns: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in rows)
    return f"<table>\n<tr>{head}</tr>\n{body}</table>"


def _cell(text: str) -> str:
    """A cell of a table; a short one stays on one line."""
    return f"<td{WORDS if len(text) > LONG_CELL else ''}>{escape(text)}</td>"
