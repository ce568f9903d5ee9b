"""``fleetloc fleet``: a whole fleet on this machine, live or in virtual time, and its report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetloc.errors import INTERRUPTED, InputError
from fleetloc.options import Delay, FiguresFile, Loss, Overrides, Profiles, Require, with_options

if TYPE_CHECKING:
    from agent.config.documents import Override
    from agent.config.tables import FleetConfig
    from fleetloc.run.fleet_run import RunOutcome


DEMO_FOLDER = "fleetloc-demo"


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("fleet")(fleet)


def fleet(
    config: Annotated[Path | None, typer.Argument(help="Configuration of the fleet (TOML), or none: --demo.")] = None,
    demo: Annotated[
        bool, typer.Option("--demo", help="Fly the example of three drones that comes with fleetloc.")
    ] = False,
    duration_s: Annotated[float | None, typer.Option("--duration", help="Seconds; default: sim.duration_s.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Of the world and of injected faults.")] = None,
    loss: Loss = None,
    delay_s: Delay = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of the run; default: out/<fleet>, or fleetloc-demo.")
    ] = None,
    json_file: FiguresFile = None,
    require: Require = None,
    profiles: Profiles = None,
    overrides: Overrides = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Virtual time in one process: fast, and the same at every run.")
    ] = False,
) -> None:
    """Fly a simulated fleet, one daemon per drone, and report.

    Ends after the duration, on Ctrl-C, or when no daemon is left; the report is written in each case. The verdict
    says whether the run was as wanted; exit 1 if no drone had an estimate, or a limit of --require is not kept.
    """
    from fleetloc.errors import FAILED
    from fleetloc.report.fleet_report import write_report
    from fleetloc.run import run_files
    from fleetloc.verdict import read_requirements
    from fleetloc.warmup import announce, warm_up_everything

    required = read_requirements(require or "")
    if demo:
        out = out or Path(DEMO_FOLDER)
    config = _chosen(config, demo)
    options = [
        ("--duration", "sim.duration_s", duration_s),
        ("--seed", "sim.seed", seed),
        ("--seed", "transport.seed", seed),
        ("--loss", "transport.loss", loss),
        ("--delay", "transport.delay_s", delay_s),
    ]
    fleet_config = _prepared(config, profiles or [], with_options(options, overrides), out, live=not lockstep)
    folder = Path(str(fleet_config.record.directory))
    announce()
    warm_up_everything()
    if lockstep:
        from fleetloc.run.lockstep_run import fly_in_lockstep

        began_s = time.monotonic()
        outcome = fly_in_lockstep(fleet_config, folder)
        outcome.wall_s = time.monotonic() - began_s
    else:
        outcome = _fly(fleet_config, folder)
        if outcome.wall_s == 0.0:  # interrupted before anything flew
            raise typer.Exit(INTERRUPTED)
    figures = write_report(
        fleet_config, folder, outcome, json_file, "lockstep" if lockstep else "live", required
    )
    typer.echo(f"report: {folder / run_files.REPORT_HTML}")
    if figures["verdict"]["failed"]:
        raise typer.Exit(FAILED)


def _chosen(config: Path | None, demo: bool) -> Path:
    """The configuration to fly; raises `InputError` unless there is exactly one."""
    from fleetloc import examples

    if demo and config is not None:
        raise InputError("--demo", "", "no configuration beside it", str(config))
    if not demo and config is None:
        raise InputError("CONFIG", "", "a configuration of a fleet (TOML), or --demo", "neither")
    return config or examples.DEMO


def _prepared(
    config: Path, profiles: list[Path], settings: list[Override], out: Path | None, *, live: bool
) -> FleetConfig:
    """The effective configuration, also written into the run's folder for all its processes.

    Checks before anything starts: the scenario, and for a live run what the security profile promises.
    """
    from agent.config.reading import dump
    from agent.radio.security import require
    from agent.sensing.clock import require_epoch
    from fleetloc.run import run_files
    from fleetloc.whole_config import load_whole
    from sim_bridge.world.scenario_config import scenario_from_config

    fleet = load_whole(config, settings, profiles)
    scenario_from_config(fleet)
    folder = (out or Path("out") / fleet.fleet.name).resolve()
    run_files.refuse_inputs(folder, (config, *profiles))
    if live:
        _refuse_liars(config, fleet)
        require_epoch(fleet, unix_s=time.time())
        for agent_id in fleet.ids:
            require(fleet, agent_id, config.parent, unix_s=time.time())
    else:
        _refuse_modules(config, fleet)
    fleet = run_files.in_folder(fleet, config.parent, folder)
    run_files.clear(folder)
    (folder / run_files.CONFIG).write_text(dump(fleet), encoding="utf-8")
    return fleet


def _refuse_modules(path: Path, fleet: FleetConfig) -> None:
    """Modules on pseudo terminals, and their drivers, live in real time."""
    from fleetloc.errors import InputError
    from sim_bridge.world.sim_table import sim_table

    kind = sim_table(fleet).uwb_module
    if kind != "none":
        raise InputError(str(path), "sim.uwb_module", '"none" in virtual time (--lockstep)', f'"{kind}"')


def _refuse_liars(path: Path, fleet: FleetConfig) -> None:
    """Faults of members are injected into agents in virtual time; a daemon has no such hook."""
    from fleetloc.errors import InputError
    from sim_bridge.faults.fault_tables import MemberFault
    from sim_bridge.world.sim_table import sim_table

    lying = [fault for fault in sim_table(fleet).faults if isinstance(fault, MemberFault)]
    if lying:
        kind = lying[0].__struct_config__.tag
        expected = "faults of sensors in a live run (--lockstep flies all)"
        raise InputError(str(path), "sim.faults", expected, f'"{kind}"')


def _fly(config: FleetConfig, folder: Path) -> RunOutcome:
    import asyncio

    from fleetloc.run.fleet_run import FleetRun
    from fleetloc.verbosity import stderr_console

    async def fly() -> RunOutcome:
        return await FleetRun(config, folder, stderr_console()).fly()

    return asyncio.run(fly())
