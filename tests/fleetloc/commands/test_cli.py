"""The command line: one clear line and a documented exit code for whatever is wrong."""

from __future__ import annotations

import errno
import logging
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup
from typer.main import get_command

import fleetloc
from fleetloc import cli
from fleetloc.commands import warmup as commands_warmup
from fleetloc.errors import EnvironmentFault, FleetlocError, InputError
from fleetloc.output import progress_bar
from fleetloc.verbosity import set_verbosity

Run = Callable[[], int]


class OtherRoomError(Exception):
    """Stands for an error class of another room."""


OtherRoomError.__module__ = "agent.errors"


@pytest.fixture
def raising(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], int]:
    """Runs a command line whose only command raises the given error."""

    def run(error: BaseException) -> int:
        def command() -> None:
            raise error

        monkeypatch.setattr(commands_warmup, "register", lambda app: app.command("fail")(command))
        return cli.main(["fail"])

    return run


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (InputError("a.npz", "edges", "agents 0..2", "3"), 2, "a.npz: edges: expected agents 0..2, found 3"),
        (InputError("--runs", "", "at least 1", "0"), 2, "--runs: expected at least 1, found 0"),
        (EnvironmentFault("no heartbeat on udp port 14550"), 3, "no heartbeat on udp port 14550"),
        (FleetlocError("two runs diverged"), 1, "two runs diverged"),
        (OtherRoomError("line3.toml: period_s:\n expected > 0"), 2, "line3.toml: period_s: expected > 0"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "x.npz"), 3, "x.npz: No such file"),
        (OSError("port 14550 is taken"), 3, "port 14550 is taken"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
def test_error_on_purpose_is_one_line(
    raising: Callable[[BaseException], int],
    capsys: pytest.CaptureFixture[str],
    error: Exception,
    code: int,
    says: str,
) -> None:
    assert raising(error) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"fleetloc: error: {says}")
    assert err.count("\n") == 1


def test_traceback_on_request(
    raising: Callable[[BaseException], int],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("FLEETLOC_TRACEBACK", "1")
    assert raising(InputError("a", "b", "c", "d")) == 2
    assert "Traceback" in capsys.readouterr().err


def test_fault_of_the_program_shows_where(
    raising: Callable[[BaseException], int], capsys: pytest.CaptureFixture[str]
) -> None:
    # GIVEN an error that nobody raised on purpose, THEN it is not dressed up as bad input
    assert raising(ZeroDivisionError("division by zero")) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert err.endswith("fleetloc: error: unexpected ZeroDivisionError: division by zero\n")


@pytest.mark.parametrize("error", [KeyboardInterrupt(), typer.Abort()], ids=["ctrl-c", "abort"])
def test_interrupt(raising: Callable[[BaseException], int], error: BaseException) -> None:
    assert raising(error) == 130


def test_exit_code_of_a_command_is_passed_on(raising: Callable[[BaseException], int]) -> None:
    assert raising(typer.Exit(7)) == 7


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nonsense"], "'nonsense'. (see fleetloc --help)"),
        (["warmup", "--fast"], "--fast (see fleetloc warmup --help)"),
        (["warmup", "extra"], "(extra) (see fleetloc warmup --help)"),
        (["bench", "loss", "--fast"], "--fast (see fleetloc bench loss --help)"),
    ],
)
def test_wrong_usage_is_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    assert cli.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert says in err
    assert err.startswith("fleetloc: error: ")
    assert err.count("\n") == 1


def test_no_command_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "warmup" in capsys.readouterr().err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"fleetloc {fleetloc.__version__}\n"


def test_start_imports_nothing_heavy() -> None:
    # GIVEN all groups of commands, WHEN one starts, THEN what only others need is not imported
    look = (
        "import sys; from fleetloc.cli import build_app; build_app();"
        "heavy = {'numba', 'scipy', 'matplotlib', 'osqp', 'zenoh', 'pymavlink', 'casadi', 'numpy'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout == "[]\n"


def commands() -> list[list[str]]:
    """Every command of the command line, as it is typed."""
    group = get_command(cli.build_app())
    assert isinstance(group, TyperGroup)
    found = []
    for name, command in group.commands.items():
        inner = command.commands if isinstance(command, TyperGroup) else None
        found += [[name]] if inner is None else [[name, each] for each in inner]
    return found


@pytest.mark.parametrize("command", commands(), ids=" ".join)
def test_every_command_has_the_same_help(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*command, "-h"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"Usage: fleetloc {' '.join(command)} [OPTIONS]")
    for option in ("-h, --help", "-v, --verbose", "-q, --quiet"):
        assert option in text
    assert not re.search(r"<(?!fleet>)\w+(\[\w+\])?>", text)
    assert "{" not in text.splitlines()[0]
    # what stands for a value says what kind of thing it is
    assert " TEXT " not in text


@pytest.mark.parametrize("group", [[], ["bench"], ["keys"]], ids=str)
def test_no_line_of_a_list_of_commands_is_cut_off(group: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*group, "-h"]) == 0
    listed = capsys.readouterr().out.split("Commands:")[1].splitlines()[1:]
    assert len(listed) > 5
    assert not [line for line in listed if line.endswith("...")]


def test_help_says_what_a_value_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fleet", "--help"]) == 0
    text = capsys.readouterr().out
    for words in ("--with FILE", "--set KEY=VALUE", "--duration S", "--out FOLDER", "--seed N"):
        assert words in text


def test_a_shell_is_told_how_to_complete(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert cli.main(["--help"]) == 0
    assert "--install-completion" in capsys.readouterr().out
    monkeypatch.setenv("_FLEETLOC_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "fleetloc che")
    monkeypatch.setenv("COMP_CWORD", "1")
    with pytest.raises(SystemExit):
        cli.main([])
    assert capsys.readouterr().out.strip() == "check"


@pytest.mark.parametrize(("option", "lines"), [(None, 10), ("-q", 0)])
def test_progress_without_a_terminal_is_a_line_now_and_then(
    capsys: pytest.CaptureFixture[str], option: str | None, lines: int
) -> None:
    set_verbosity(-1 if option else 0)
    with progress_bar("simulated seconds", 25) as advance:
        for _ in range(25):
            advance()
    set_verbosity(0)
    told = capsys.readouterr().err.splitlines()
    assert len(told) == lines
    assert told[-1:] == ["fleetloc: simulated seconds: 25 of 25"][: len(told)]


@pytest.mark.parametrize(("options", "told"), [([], []), (["-v"], ["a state changed"]), (["-q"], [])])
def test_verbose_shows_the_log_of_the_parts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[str], told: list[str]
) -> None:
    logger = logging.getLogger("fleetloc")
    monkeypatch.setattr(logger, "handlers", [])  # as at a start, whatever other tests left
    monkeypatch.setattr(logger, "propagate", True)
    monkeypatch.setattr(logger, "level", logging.NOTSET)

    def command() -> None:
        logging.getLogger("fleetloc.part").info("a state changed")

    monkeypatch.setattr(commands_warmup, "register", lambda app: app.command("fail")(command))
    assert cli.main(["fail", *options]) == 0
    set_verbosity(0)
    assert [line.partition(" INFO ")[2] for line in capsys.readouterr().err.splitlines()] == told
