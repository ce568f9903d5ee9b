"""``fleetloc sim``: the simulated world with its autopilots, for daemons that are started by somebody else."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fleetloc.options import FleetFile, Overrides, Profiles, with_options


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("sim")(sim)


def sim(
    config: FleetFile,
    out: Annotated[Path | None, typer.Option("--out", help="Write the truth here when it ends.")] = None,
    duration_s: Annotated[float | None, typer.Option("--duration", help="Seconds; default: sim.duration_s.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Beats sim.seed.")] = None,
    profiles: Profiles = None,
    overrides: Overrides = None,
    truth_lines: Annotated[
        bool, typer.Option("--truth-lines", hidden=True, help="Write the truth to stdout as it happens.")
    ] = False,
) -> None:
    """Fly the world of [sim] in real time, for daemons of yours.

    It serves the autopilots and UWB modules. SIGTERM and SIGINT end it too.
    """
    import asyncio
    import dataclasses

    from agent.config.reading import load_config
    from fleetloc.output import write_json
    from fleetloc.run.live_truth import TruthWriter
    from fleetloc.run.run_files import SIMULATOR_JSON, TRUTH
    from sim_bridge.world.simulator import simulate

    options = [("--seed", "sim.seed", seed), ("--duration", "sim.duration_s", duration_s)]
    fleet = load_config(config, with_options(options, overrides), profiles or ())
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    report = asyncio.run(
        simulate(
            fleet,
            truth_file=None if out is None else out / TRUTH,
            on_advance=TruthWriter() if truth_lines else None,
            base=config.parent,
            modules_folder=out or Path(),
        )
    )
    if out is not None:
        write_json(out / SIMULATOR_JSON, dataclasses.asdict(report))
    typer.echo(
        f"flown {report.duration_s:.1f} s, behind the clock by {1e3 * report.max_behind_s:.0f} ms at most, "
        f"{report.ranges_published} range frames sent, {report.ranges_failed} failed, "
        f"{report.frames_unsent} MAVLink frames for nobody, {report.send_errors} send errors",
        err=True,
    )
