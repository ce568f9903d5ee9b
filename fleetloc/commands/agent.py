"""``fleetloc agent``: the daemon of one drone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fleetloc.common_options import Quiet, Verbose
from fleetloc.errors import FleetlocError
from fleetloc.options import FleetFile, Overrides, Profiles, with_options


class NotStarted(FleetlocError):
    """The daemon cannot be started; the exit code is one of `agent.exit_codes`."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("agent")(agent)


def agent(
    config: FleetFile,
    agent_id: Annotated[int, typer.Option("--id", help="Which of its agents this is.")],
    profiles: Profiles = None,
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the record here; earlier ones are kept beside it.")
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Run the daemon of one drone until SIGTERM or SIGINT.

    Exit codes: 0 stopped, 1 a fault of the program, 2 wrong usage or configuration, 4 autopilot's link, 5 keys,
    6 session with the other agents, 7 no autopilot appeared, 8 record, 9 what has to outlive a restart (disk full).
    """
    import logging
    import time

    from agent.config.reading import load_config
    from agent.daemon import run
    from agent.errors import ConfigError, LogFileError
    from agent.exit_codes import ExitCode
    from agent.sensing.clock import require_epoch
    from agent.watch.log_lines import configure_logging, log_file
    from agent.watch.observer_list import observers_of
    from estimators.factory import make_estimator
    from fleetloc.run.run_files import keep_earlier_record
    from fleetloc.warmup import announce
    from transport.errors import KeyFileError

    settings = with_options([("--out", "record.directory", None if out is None else str(out))], overrides)
    try:
        fleet = load_config(config, settings, profiles or ())
        unset = require_epoch(fleet, unix_s=time.time())
    except ConfigError as error:
        raise NotStarted(str(error), ExitCode.BAD_INPUT) from error
    try:
        file = log_file(fleet.log, agent_id)
        unlogged = ""
    except LogFileError as error:  # a full disk grounds no drone
        file, unlogged = None, str(error)
    configure_logging(0 if quiet else 1 + verbose, file)
    log = logging.getLogger("fleetloc.agent")
    if unlogged:
        log.error("agent %d: %s; flying without a log file", agent_id, unlogged)
    try:
        observers = observers_of(fleet, agent_id, config.parent) if agent_id in fleet.ids else []
    except ConfigError as error:
        raise NotStarted(str(error), ExitCode.BAD_INPUT) from error
    except KeyFileError as error:
        raise NotStarted(str(error), ExitCode.KEYS) from error
    if unset is not None:
        log.warning("agent %d: %s; nothing is sent until it is set", agent_id, unset)
    announce()
    unrecorded = ""
    if fleet.record.directory is not None:
        try:
            keep_earlier_record(Path(fleet.record.directory), agent_id)
        except OSError as error:
            unrecorded = f"record {fleet.record.directory}: an earlier one cannot be put aside: {error.strerror}"
    raise typer.Exit(
        run(fleet, agent_id, make_estimator, base=config.parent, observers=observers, unrecorded=unrecorded)
    )
