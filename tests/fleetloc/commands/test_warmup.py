"""What people see while kernels are compiled."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from estimators.compiled.entries import Progress
from fleetloc import cli, warmup
from fleetloc.warmup import Announcer

FIRST_START = (
    Progress("compiling", "estimators.a.step", 0, 2),
    Progress("inner", "estimators.b.row", 0, 2),
    Progress("compiled", "estimators.a.step", 0, 2),
    Progress("ready", "estimators.a.step", 1, 2),
    Progress("compiling", "estimators.a.mix", 1, 2),
    Progress("compiled", "estimators.a.mix", 1, 2),
    Progress("ready", "estimators.a.mix", 2, 2),
)


def shown(events: tuple[Progress, ...], *, terminal: bool = False) -> str:
    stream = io.StringIO()
    listener = Announcer(Console(file=stream, force_terminal=terminal, width=60, highlight=False))
    for event in events:
        listener(event)
    return stream.getvalue()


def test_log_gets_plain_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEETLOC_CACHE", "/var/cache/kernels")
    assert shown(FIRST_START).splitlines() == [
        "fleetloc: compiling kernels into /var/cache/kernels (once per machine and version)",
        "fleetloc: compiling [1/2] estimators.a.step",
        "fleetloc: compiling [2/2] estimators.a.mix",
    ]


def test_terminal_shows_the_inner_kernels_too() -> None:
    text = shown(FIRST_START, terminal=True)
    assert "once per machine and version" in text
    assert "[1/2] estimators.b.row" in text
    assert "[2/2] estimators.a.mix" in text
    assert text.count("\x1b[?25l") == text.count("\x1b[?25h") == 2, "the cursor is given back"


def test_nothing_to_compile_is_silent() -> None:
    assert shown((Progress("ready", "a", 1, 2), Progress("ready", "b", 2, 2))) == ""


def test_each_warning_once() -> None:
    told = (
        Progress("waiting", detail="another process compiles"),
        Progress("warning", detail="cannot store [x]"),
        Progress("warning", detail="cannot store [x]"),
    )
    assert shown(told).splitlines() == [
        "fleetloc: waiting: another process compiles",
        "fleetloc: warning: cannot store [x]",
    ]


def test_command_says_how_many_and_where(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FLEETLOC_CACHE", "/var/cache/kernels")
    monkeypatch.setattr(warmup, "warm_up_everything", lambda: 5)
    assert cli.main(["warmup"]) == 0
    assert capsys.readouterr().out == "5 kernels ready in /var/cache/kernels\n"
