"""``fleetloc sitl``: daemons on autopilots in simulators (PX4 or ArduPilot), flown and compared with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetloc.errors import FAILED, INTERRUPTED, InputError
from fleetloc.options import Delay, FiguresFile, FleetFile, Loss, Overrides, Profiles, with_options

if TYPE_CHECKING:
    from agent.config.tables import FleetConfig
    from fleetloc.run.sitl_run import SitlRun

NO_MISSION = "none"


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("sitl")(sitl)
    app.command("sitl-bridge", hidden=True)(sitl_bridge)
    app.command("sitl-mission", hidden=True)(sitl_mission)


def sitl(
    config: FleetFile,
    duration_s: Annotated[
        float | None,
        typer.Option("--duration", help="Seconds; default: until the mission ends, without one sim.duration_s."),
    ] = None,
    mission: Annotated[
        str | None, typer.Option("--mission", help="Mission to fly (TOML), or none; default: sitl.mission.")
    ] = None,
    drop_gps: Annotated[
        list[str] | None,
        typer.Option("--drop-gps", help="No GPS for this daemon then, s from the begin; may be repeated."),
    ] = None,
    autopilot_gps: Annotated[
        list[str] | None,
        typer.Option("--autopilot-gps", help="No GPS for this autopilot itself then; may be repeated."),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Of the ranges and of injected faults.")] = None,
    loss: Loss = None,
    delay_s: Delay = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the run; default: out/<fleet>.")] = None,
    json_file: FiguresFile = None,
    profiles: Profiles = None,
    overrides: Overrides = None,
) -> None:
    """Attach daemons to running SITL simulators, and report.

    You start the simulators (docs/sitl.md). Ranges are made of their ground truth; a mission is flown if asked. Ends
    on Ctrl-C too; the report is written in either case.
    """
    from fleetloc.report.fleet_report import write_report
    from fleetloc.run import run_files
    from fleetloc.warmup import announce, warm_up_everything
    from fleetloc.whole_config import load_whole
    from sim_bridge.sitl.sitl_table import sitl_table
    from sim_bridge.world.sim_table import sim_table

    options = [
        ("--duration", "sim.duration_s", duration_s),
        ("--seed", "sim.seed", seed),
        ("--seed", "transport.seed", seed),
        ("--loss", "transport.loss", loss),
        ("--delay", "transport.delay_s", delay_s),
    ]
    loaded = load_whole(config, with_options(options, overrides), profiles or ())
    fleet = _prepared(config, loaded, mission, (drop_gps or [], autopilot_gps or []), duration_s)
    folder = _write_folder((config, *(profiles or ())), fleet, out)
    announce()
    warm_up_everything()
    without_end = duration_s is None and sitl_table(fleet).mission is None
    limit_s = sim_table(fleet).duration_s if without_end else duration_s
    effective, run = _fly(folder, limit_s)
    if run.outcome.wall_s == 0.0:  # interrupted before anything flew
        raise typer.Exit(INTERRUPTED)
    write_report(effective, folder, run.outcome, json_file, "sitl")
    typer.echo(f"report: {folder / run_files.REPORT_HTML}")
    if run.mission_failure is not None or run.lost_simulators:
        raise typer.Exit(FAILED)


def _prepared(
    file: Path,
    fleet: FleetConfig,
    mission: str | None,
    without_gps: tuple[list[str], list[str]],
    duration_s: float | None,
) -> FleetConfig:
    """The effective configuration, checked as far as that is possible before anything is started; which daemons and
    which autopilots are without GPS when."""
    import msgspec

    from agent.config.reading import with_other_table
    from fleetloc.run.gps_drops import gps_outage
    from sim_bridge.sitl.mission import load_mission
    from sim_bridge.sitl.pilot import require_client
    from sim_bridge.sitl.setup import vehicle_links
    from sim_bridge.sitl.sitl_table import sitl_table
    from sim_bridge.world.sim_table import sim_table

    vehicle_links(fleet)
    replace = msgspec.structs.replace
    sitl, sim = sitl_table(fleet), sim_table(fleet)
    wanted = None if mission == NO_MISSION else mission
    if mission is None and sitl.mission is not None:
        wanted = str(file.parent / sitl.mission)
    daemons, autopilots = without_gps
    taken = tuple(gps_outage(text, fleet.ids, duration_s, "--autopilot-gps") for text in autopilots)
    sitl = replace(
        sitl,
        mission=None if wanted is None else str(Path(wanted).resolve()),
        autopilot_gps=sitl.autopilot_gps + taken,
    )
    fleet = with_other_table(fleet, "sitl", sitl)
    if wanted is not None:
        load_mission(Path(wanted), fleet)
        require_client()
    outages = tuple(gps_outage(text, fleet.ids, duration_s) for text in daemons)
    return with_other_table(fleet, "sim", replace(sim, gps_outages=sim.gps_outages + outages))


def _write_folder(files: tuple[Path, ...], fleet: FleetConfig, out: Path | None) -> Path:
    """Put the effective configuration into the run's folder, for all processes of the run; that folder."""
    import time

    from agent.config.reading import dump
    from agent.radio.security import key_folder
    from agent.sensing.clock import require_epoch
    from fleetloc.run import run_files
    from sim_bridge.sitl.sitl_table import sitl_table
    from transport.security.keys import load_secret, load_trust

    folder = (out or Path("out") / fleet.fleet.name).resolve()
    mission = sitl_table(fleet).mission
    run_files.refuse_inputs(folder, (*files, *([mission] if mission is not None else [])))
    require_epoch(fleet, unix_s=time.time())
    keys = key_folder(fleet, files[0].parent)
    if fleet.security.mode == "signed":
        load_trust(keys, fleet.ids)
        for agent_id in fleet.ids:
            load_secret(keys, agent_id)
    fleet = run_files.in_folder(fleet, files[0].parent, folder)
    run_files.clear(folder)
    (folder / run_files.CONFIG).write_text(dump(fleet), encoding="utf-8")
    return folder


def _fly(folder: Path, duration_s: float | None) -> tuple[FleetConfig, SitlRun]:
    import asyncio

    from agent.config.reading import load_config
    from fleetloc.run import run_files
    from fleetloc.run.sitl_run import SitlRun
    from fleetloc.verbosity import stderr_console

    async def fly() -> tuple[FleetConfig, SitlRun]:
        fleet = load_config(folder / run_files.CONFIG)
        run = SitlRun(fleet, folder, stderr_console(), duration_s)
        await run.fly()
        return fleet, run

    return asyncio.run(fly())


def sitl_bridge(
    config: FleetFile,
    out: Annotated[Path | None, typer.Option("--out", help="Write the truth here when it ends.")] = None,
) -> None:
    """Stand between running simulators and daemons that are started by somebody else; SIGTERM and SIGINT end it.

    Progress and truth go to stdout as lines of JSON.
    """
    import asyncio
    import dataclasses

    from agent.config.reading import load_config
    from fleetloc.output import write_json
    from fleetloc.run.run_files import SIMULATOR_JSON, TRUTH
    from fleetloc.run.sitl_lines import LineWriter
    from sim_bridge.sitl.bridge import bridge

    fleet = load_config(config)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    lines = LineWriter()
    truth_file = None if out is None else out / TRUTH
    flown = bridge(
        fleet, truth_file=truth_file, on_progress=lines.progress, on_step=lines.step, base=config.parent
    )
    report = asyncio.run(flown)
    if out is not None:
        write_json(out / SIMULATOR_JSON, dataclasses.asdict(report))


def sitl_mission(config: FleetFile) -> None:
    """Fly the mission of [sitl] through a running bridge; what happens goes to stdout."""
    import asyncio

    from agent.config.reading import load_config
    from fleetloc.run.sitl_lines import MissionPrinter
    from sim_bridge.sitl.mission import load_mission
    from sim_bridge.sitl.pilot import fly_mission
    from sim_bridge.sitl.sitl_table import sitl_table

    fleet = load_config(config)
    mission_file = sitl_table(fleet).mission
    if mission_file is None:
        raise InputError(str(config), "sitl.mission", "a mission file", "none")
    mission = load_mission(config.parent / mission_file, fleet)
    asyncio.run(fly_mission(fleet, mission, MissionPrinter()))
