"""The ``fleetloc`` command: collects the command groups and turns errors into one line and an exit code.

A group of commands is a module below ``fleetloc/commands`` with ``register(app)``. All of them are
imported at every start, so they import what is heavy (numba, scipy, matplotlib, zenoh, the rooms) inside the
commands.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated

import typer

import fleetloc
from fleetloc import commands
from fleetloc.common_options import complete
from fleetloc.errors import BAD_INPUT, FAILED, INTERRUPTED, REFUSED
from fleetloc.shadowing import ROOMS


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"fleetloc {fleetloc.__version__}")
        raise typer.Exit


def _root(
    context: typer.Context,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Onboard cooperative localization for fleets of drones."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help(), err=True)
        raise typer.Exit(BAD_INPUT)


def build_app() -> typer.Typer:
    """The command line with every group of commands in this package."""
    app = typer.Typer(
        name="fleetloc",
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback(invoke_without_command=True)(_root)
    for module in pkgutil.walk_packages(commands.__path__, f"{commands.__name__}."):
        if not module.ispkg:
            importlib.import_module(module.name).register(app)
    complete(app)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command (default: of ``sys.argv``); returns the exit code, see `fleetloc.errors`."""
    try:
        result = build_app()(args=arguments, prog_name="fleetloc", standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        return INTERRUPTED
    except Exception as error:  # noqa: BLE001  # the one place that answers for all of them
        return _report(error)
    return result if isinstance(result, int) else 0


def _report(error: Exception) -> int:
    """Print an error to stderr: one line where it was raised on purpose, with its traceback where not."""
    code = _exit_code(error)
    if code is None or os.environ.get("FLEETLOC_TRACEBACK"):
        traceback.print_exception(error)
    print(f"fleetloc: error: {_one_line(error)}", file=sys.stderr)  # noqa: T201
    return FAILED if code is None else code


def _exit_code(error: Exception) -> int | None:
    """Exit code of an error raised on purpose, None for a fault in the program."""
    if hasattr(error, "format_message"):  # of the option parser
        return BAD_INPUT
    if isinstance(error, OSError):
        return int(getattr(error, "exit_code", REFUSED))
    if type(error).__module__.partition(".")[0] in ROOMS:
        return int(getattr(error, "exit_code", BAD_INPUT))
    return None


def _one_line(error: Exception) -> str:
    if hasattr(error, "format_message"):
        text = f"{error.format_message()} (see {_command_of(error)} --help)"
    elif isinstance(error, OSError) and error.filename is not None and error.strerror:
        text = f"{error.filename}: {error.strerror}"
    elif _exit_code(error) is None:
        text = f"unexpected {type(error).__name__}: {error}"
    else:
        text = str(error)
    return " ".join(text.split())


def _command_of(error: Exception) -> str:
    """The command that was typed, ``fleetloc bench loss``, as far as the option parser got."""
    context = getattr(error, "ctx", None)
    return "fleetloc" if context is None else str(context.command_path)
