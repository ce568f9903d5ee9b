"""``fleetloc replay``: recorded flights through the agents of a fleet; ``fleetloc ranges``: what ranges are like."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetloc.options import Delay, FiguresFile, Loss, Overrides, Require, with_options

if TYPE_CHECKING:
    from agent.config.documents import Override


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("replay")(replay)
    app.command("ranges")(ranges)


def replay(
    config: Annotated[
        Path, typer.Argument(help="Configuration (TOML; origin optional), or 'recorded': that of flight logs.")
    ],
    logs: Annotated[
        list[Path], typer.Argument(help="Logs (.tlog, dataflash .BIN, .ulg; also gzip), or flight logs (.mcap).")
    ],
    ranges_from: Annotated[
        list[str] | None,
        typer.Option(
            "--ranges",
            help="File (CSV, JSON lines, flight log .mcap; repeatable), or synthetic[:KEY=VALUE,...] from truth.",
        ),
    ] = None,
    truth: Annotated[
        list[str] | None, typer.Option("--truth", help="auto (what the logs hold), or a CSV per log in their order.")
    ] = None,
    drop_gps: Annotated[
        list[str] | None,
        typer.Option("--drop-gps", help="No fixes of this drone then; repeatable. 2:-90, = last 90 s."),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="KEYS", help='Like one of sim.faults: kind="gps_off", agents=[2].'),
    ] = None,
    loss: Loss = None,
    delay_s: Delay = None,
    estimator: Annotated[
        str | None, typer.Option("--estimator", help="Kind of estimator in place of the file's.")
    ] = None,
    from_s: Annotated[
        float | None,
        typer.Option("--from", help="Begin there: s from where all logs are there, negative: from the end of that."),
    ] = None,
    to_s: Annotated[float | None, typer.Option("--to", help="End there, likewise.")] = None,
    arrival: Annotated[
        str,
        typer.Option("--arrival", help="logged: samples come when the log had them; stamped: as on board."),
    ] = "logged",
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Of synthetic ranges (default: 1) and injected faults.")
    ] = None,
    overrides: Overrides = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the results; default: out/replay.")] = None,
    json_file: FiguresFile = None,
    require: Require = None,
) -> None:
    """Replay recorded flights: what would the fleet have known?

    And how sure, and how does it compare?

    Times are seconds from where all logs are there, negative from where the first of them ends. Writes report.html,
    report.json and the estimates as CSV and MCAP. Flight logs of our own daemons are repeated exactly and compared
    instead.
    """
    from fleetloc.errors import FAILED
    from fleetloc.report.replay_exports import exporting
    from fleetloc.run.replay_run import clear, refuse_inputs, run_replay
    from fleetloc.run.replay_setup import Options, prepare, split_truth
    from fleetloc.verdict import read_requirements
    from fleetloc.warmup import announce, warm_up_everything

    required = read_requirements(require or "")
    began_s = time.monotonic()
    truth_given = truth
    logs, truth = split_truth(logs, truth or ())
    options = [
        ("--estimator", "estimator.kind", estimator),
        ("--loss", "transport.loss", loss),
        ("--delay", "transport.delay_s", delay_s),
        ("--seed", "transport.seed", seed),
    ]
    settings = with_options(options, overrides)
    folder = out or Path("out") / "replay"
    if any(path.suffix == ".mcap" for path in logs):
        given = {"--ranges": ranges_from, "--truth": truth_given, "--drop-gps": drop_gps, "--fault": fault,
                 "--loss": loss, "--delay": delay_s, "--from": from_s, "--to": to_s, "--seed": seed,
                 "--require": require, "--arrival": None if arrival == "logged" else arrival}  # fmt: skip
        refused = [name for name, value in given.items() if value is not None]
        _repeat(config, logs, refused, settings, folder, json_file)
        return
    refuse_inputs(folder, (config, *logs, *truth, *(ranges_from or ())))
    prepared = prepare(
        Options(
            config=config,
            logs=logs,
            settings=settings,
            ranges=ranges_from or (),
            truth=truth,
            drops=drop_gps or (),
            faults=fault or (),
            seed=1 if seed is None else seed,
            from_s=from_s,
            to_s=to_s,
            arrival=arrival,
        )
    )
    clear(folder)
    announce()
    warm_up_everything()
    replayed = run_replay(prepared, folder)
    inputs = prepared.inputs
    agents = [vehicle.agent_id for vehicle in inputs.plan.vehicles]
    with exporting(folder, prepared.config, agents, inputs.plan.zero_s, inputs.plan.epoch_unix_s):
        from fleetloc.report.replay_report import write_report  # loading it takes as long as the export

        figures = write_report(prepared, replayed, folder, json_file, began_s, required)
    typer.echo(f"report: {folder / 'report.html'}")
    if figures["verdict"]["failed"]:
        raise typer.Exit(FAILED)


def _repeat(
    config: Path, logs: list[Path], refused: list[str], settings: list[Override], folder: Path, json_file: Path | None
) -> None:
    from fleetloc.errors import FAILED, InputError
    from fleetloc.run.replay_records import RECORDED, refuse_mixture, replay_records
    from fleetloc.warmup import announce, warm_up_everything

    refuse_mixture(logs)
    if refused:
        expected = "no such option: a flight log is repeated with what was received (replay its .tlog instead)"
        raise InputError(", ".join(refused), "", expected, "logs that are flight logs (.mcap)")
    announce()
    warm_up_everything()
    equal = replay_records(config, logs, settings, folder, json_file)
    if not equal and str(config) == RECORDED and not settings:
        raise typer.Exit(FAILED)


def ranges(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE",
            help="CSV or JSON lines with true distances; or flight logs (.mcap); or CONFIG (.toml) of a live fleet.",
        ),
    ],
    outlier_m: Annotated[
        float, typer.Option("--outlier", min=0.0, help="Further than this from its pair's median is an outlier, m.")
    ] = 0.5,
    write: Annotated[
        Path | None, typer.Option("--write", metavar="FILE", help="Write the lines of the configuration here.")
    ] = None,
    duration_s: Annotated[
        float, typer.Option("--duration", help="Listen to a live fleet for so many seconds.")
    ] = 10.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
) -> None:
    """Bias, noise and outliers of ranges, per pair of drones.

    From true distances in a file, from the flight logs of drones, or from what the drones of a live fleet estimate.
    """
    import asyncio

    from fleetloc.errors import InputError

    kinds = {path.suffix.lower() for path in files}
    if kinds == {".mcap"}:
        from fleetloc.report.flight_ranges import study_flight_logs
        from fleetloc.warmup import announce

        announce()
        study_flight_logs(files, json_file, write)
        return
    if len(files) > 1:
        expected = "flight logs (.mcap), or one file"
        raise InputError("FILE", "", expected, ", ".join(path.name for path in files))
    if kinds == {".toml"}:
        from fleetloc.report.flight_ranges import listen_to_biases
        from fleetloc.whole_config import load_whole

        asyncio.run(listen_to_biases(load_whole(files[0]), files[0].parent, duration_s, json_file, write))
        return
    from fleetloc.report.range_study import study_ranges

    study_ranges(files[0], outlier_m, json_file, write)
