"""``fleetloc health``: a daemon's answer as words and an exit code."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.watch.health import Health, State
from agent.watch.health_query import STALE_AFTER_S
from agent.watch.observers import DaemonState
from fleetloc import cli


@pytest.mark.parametrize(
    ("answer", "options", "code", "said"),
    [
        ({"state": "ok", "reasons": [], "age_s": 0.3}, [], 0, "ok\n"),
        ({"state": "init", "reasons": ["searching"], "age_s": 0.3}, [], 0, "init: searching\n"),
        ({"state": "init", "reasons": [], "age_s": 0.3}, ["--require-ok"], 1, "init\n"),
        ({"state": "fault", "reasons": ["estimator"], "age_s": 0.3}, [], 1, "fault: estimator\n"),
        ({"state": "ok", "reasons": [], "age_s": STALE_AFTER_S + 1}, [], 1, "ok, but does not get on\n"),
    ],
)
def test_the_command_turns_the_answer_into_an_exit_code(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answer: dict[str, object],
    options: list[str],
    code: int,
    said: str,
) -> None:
    monkeypatch.setattr("agent.watch.health_query.ask", lambda _path, _timeout_s: answer)
    assert cli.main(["health", "some.sock", *options]) == code
    assert capsys.readouterr().out == said


def test_nobody_there_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["health", str(tmp_path / "health.sock")]) == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "no answer: No such file or directory" in error


@pytest.mark.parametrize(
    ("state", "code", "strict_code"),
    [(State.INIT, 0, 1), (State.ALIGNING, 0, 1), (State.OK, 0, 0), (State.DEGRADED, 0, 1), (State.FAULT, 1, 1)],
)
def test_every_state_that_a_daemon_says_has_its_exit_code(
    monkeypatch: pytest.MonkeyPatch, state: State, code: int, strict_code: int
) -> None:
    # GIVEN an answer as a daemon makes it
    answer = DaemonState(7, 12.5, Health(state, ()), {}, {}, {}).as_dict()
    monkeypatch.setattr("agent.watch.health_query.ask", lambda _path, _timeout_s: {**answer, "age_s": 0.3})
    # THEN only a fault fails a container, and with --require-ok whatever is not ok
    assert cli.main(["health", "some.sock"]) == code
    assert cli.main(["health", "some.sock", "--require-ok"]) == strict_code
