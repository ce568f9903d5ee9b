"""What a daemon cannot start with: an exit code, and one line that says why."""

from __future__ import annotations

import logging
import socket
from pathlib import Path
from typing import Any

import pytest

from agent.config.tables import FleetConfig
from agent.daemon import run
from agent.exit_codes import ExitCode
from agent.watch.log_lines import configure_logging
from estimators.factory import make_estimator
from tests.support.ports import HOST, bound


def expect_exit(
    config: FleetConfig, agent_id: int, caplog: pytest.LogCaptureFixture, base: Path = Path()
) -> tuple[ExitCode, str]:
    """The exit code, and the one line that explains it."""
    with caplog.at_level(logging.ERROR, "fleetloc.agent"):
        code = run(config, agent_id, make_estimator, base=base)
    assert len(caplog.messages) == 1
    assert "\n" not in caplog.messages[0]
    return code, caplog.messages[0]


def test_an_unknown_id_is_a_configuration_error(config_of: Any, caplog: pytest.LogCaptureFixture) -> None:
    code, line = expect_exit(config_of(2), 7, caplog)
    assert code is ExitCode.BAD_INPUT
    assert "expected one of 1, 2, found 7" in line


def test_a_taken_mavlink_port(config_of: Any, caplog: pytest.LogCaptureFixture) -> None:
    with bound(socket.SOCK_DGRAM) as port:
        code, line = expect_exit(config_of(1, f"agents.1.mavlink=udpin:{HOST}:{port}"), 1, caplog)
    assert code is ExitCode.LINK
    assert f"udpin:{HOST}:{port}: cannot be opened" in line


def test_a_taken_session_port(config_of: Any, caplog: pytest.LogCaptureFixture) -> None:
    with bound(socket.SOCK_STREAM) as port:
        code, line = expect_exit(config_of(1, f'agents.1.listen=["tcp/{HOST}:{port}"]'), 1, caplog)
    assert code is ExitCode.SESSION
    assert f"tcp/{HOST}:{port}" in line


def test_missing_keys(config_of: Any, caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    code, line = expect_exit(config_of(1, "security.mode=signed"), 1, caplog, tmp_path)
    assert code is ExitCode.KEYS
    assert str(tmp_path / "keys") in line
    assert "fleetloc keys" in line


def test_an_autopilot_that_never_appears(config_of: Any, caplog: pytest.LogCaptureFixture) -> None:
    code, line = expect_exit(config_of(1, "mavlink.appear_timeout_s=0.2", "fleet.period_s=1.0"), 1, caplog)
    assert code is ExitCode.NO_AUTOPILOT
    assert "expected heartbeats of an autopilot (auto) with system id 1 within 0.2 s, found nothing" in line


def test_log_lines_go_to_stderr_quiet_unless_asked(capsys: pytest.CaptureFixture[str]) -> None:
    logger = logging.getLogger("fleetloc")
    before = (logger.handlers[:], logger.level, logger.propagate)
    try:
        configure_logging(0)
        logging.getLogger("fleetloc.agent").info("a state")
        configure_logging(1)
        logging.getLogger("fleetloc.agent").info("a change")
        out, err = capsys.readouterr()
    finally:
        logger.handlers[:], logger.level, logger.propagate = before
    assert out == ""
    assert "a change" in err
    assert "a state" not in err
