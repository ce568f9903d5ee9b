"""The command line: one clear line and a documented exit code for whatever is wrong."""

from __future__ import annotations

import errno
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import typer

import fleetloc
from fleetloc import cli
from fleetloc.commands import warmup as commands_warmup
from fleetloc.errors import EnvironmentFault, FleetlocError, InputError

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
    [(["nonsense"], "nonsense"), (["warmup", "--fast"], "--fast"), (["warmup", "extra"], "extra")],
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
