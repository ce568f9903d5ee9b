"""The report of a replay: ``report.json``, ``report.html`` and the tables on the terminal."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from fleetloc.extras import is_installed, sentence
from fleetloc.output import print_table, write_json
from fleetloc.report.replay_figures import load_results, report_figures
from fleetloc.report.replay_page import drawn_sections, page
from fleetloc.report.replay_tables import ANEES_EXPLAINED, cautions, error_table, log_table
from fleetloc.run import run_files
from fleetloc.run.replay_run import Replayed
from fleetloc.run.replay_setup import Prepared
from fleetloc.verdict import verdict


def write_report(
    prepared: Prepared,
    replayed: Replayed,
    directory: Path,
    json_file: Path | None,
    began_s: float,
    required: Mapping[str, float],
) -> dict[str, Any]:
    """Compare, write ``report.html`` and ``report.json``, print the figures; returns them.

    ``began_s`` is the monotonic time at which the command began: it is the whole of it that is timed. ``required``
    are the limits of `fleetloc.verdict`.
    """
    results = load_results(prepared, directory)
    figures = report_figures(prepared, replayed, results)
    found = verdict(figures, required)
    figures["verdict"] = {"line": found.line, "failed": found.failed}
    sections = drawn_sections(prepared, replayed, results, figures)
    wall_s = time.monotonic() - began_s
    figures["fleet"] |= {"wall_s": wall_s, "times_real_time": figures["duration_s"] / wall_s}
    html = page(prepared, sections, figures)
    (directory / run_files.REPORT_HTML).write_text(html, encoding="utf-8")
    for path in (directory / run_files.REPORT_JSON, *([json_file] if json_file else [])):
        write_json(path, figures)
    _print(figures)
    return figures


def _print(figures: dict[str, Any]) -> None:
    title = "SYNTHETIC RANGES, made of the truth" if figures["synthetic_ranges"] else None
    print_table(*log_table(figures), title="logs: samples used, content skipped")
    print_table(*error_table(figures), title=title)
    typer.echo(f"{ANEES_EXPLAINED}.")
    notes = list(cautions(figures))
    if not is_installed("report"):
        notes.append(sentence("report", f"{run_files.REPORT_HTML} has no plots"))
    for note in notes:
        typer.echo(f"note: {note}")
    typer.echo(figures["verdict"]["line"])
