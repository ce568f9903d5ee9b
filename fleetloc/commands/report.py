"""What is made of a run's folder: ``fleetloc report``, the report; ``fleetloc export``, files for other tools."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from fleetloc.options import FiguresFile, FleetFile, Overrides, Profiles, Require

LOOK_PERIOD_S = 0.2


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("report")(report)
    app.command("export")(export)


def report(
    config: FleetFile,
    directory: Annotated[Path, typer.Argument(help="Folder with the simulator's truth and the agents' records.")],
    json_file: FiguresFile = None,
    profiles: Profiles = None,
    overrides: Overrides = None,
    require: Require = None,
    wait_s: Annotated[
        float, typer.Option("--wait", help="Wait at most so many seconds for a run that ends after this began.")
    ] = 0.0,
) -> None:
    """Make the report of a finished run.

    It writes report.json and report.html, as `fleetloc fleet` does at its end.
    """
    from agent.config.reading import load_config
    from fleetloc.errors import FAILED, InputError
    from fleetloc.report.fleet_report import write_report
    from fleetloc.run import run_files
    from fleetloc.run.fleet_run import RunOutcome
    from fleetloc.verdict import read_requirements

    required = read_requirements(require or "")
    fleet = load_config(config, overrides or (), profiles or ())
    records = [run_files.record_path(directory, agent_id) for agent_id in fleet.ids]
    ends = [directory / run_files.SIMULATOR_JSON, *(path.with_suffix(run_files.SUMMARY_SUFFIX) for path in records)]
    if wait_s > 0.0:
        _wait_for(ends, wait_s)
    some = next((path for path in records if path.is_file()), records[0])
    for needed in (directory / run_files.TRUTH, some):
        if not needed.is_file():
            expected = f"{needed.name}, which `fleetloc sim --out` and `fleetloc agent --out` write"
            raise InputError(str(directory), "", expected, "no such file")
    figures = write_report(fleet, directory, RunOutcome(), json_file, "live", required)
    typer.echo(f"report: {directory / run_files.REPORT_HTML}")
    if figures["verdict"]["failed"]:
        raise typer.Exit(FAILED)


def export(
    config: FleetFile,
    directory: Annotated[Path, typer.Argument(help="Folder with the agents' records.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where the files go; default: beside the records.")
    ] = None,
    profiles: Profiles = None,
    overrides: Overrides = None,
) -> None:
    """Make files for other tools of a finished run.

    It writes estimates.mcap (Foxglove, PlotJuggler) with foxglove-layout.json, tracks.kml and tracks.geojson (maps).
    Fixes and ranges are in them where there are flight logs.
    """
    from agent.config.reading import load_config
    from fleetloc.export.flown import export_run
    from fleetloc.run.run_files import MCAP

    fleet = load_config(config, overrides or (), profiles or ())
    folder = out or directory
    for line in export_run(fleet, directory, folder):
        typer.echo(f"note: {line}")
    typer.echo(f"files: {folder / MCAP} and beside it")


def _wait_for(files: list[Path], wait_s: float) -> None:
    """Until all files have been written since now; raises `RunFailed` naming those that were not."""
    from fleetloc.errors import REFUSED
    from fleetloc.run.fleet_run import RunFailed

    began_s, deadline_s = time.time(), time.monotonic() + wait_s
    missing = files
    while missing := [file for file in missing if not file.is_file() or file.stat().st_mtime < began_s]:
        if time.monotonic() > deadline_s:
            names = ", ".join(file.name for file in missing)
            raise RunFailed(f"{files[0].parent}: expected {names} within {wait_s:g} s, not written", REFUSED)
        time.sleep(LOOK_PERIOD_S)
