"""What cannot fly says so in one line, with a documented exit code, and leaves no process behind."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.exit_codes import ExitCode
from fleetloc import cli
from fleetloc.errors import BAD_INPUT, REFUSED
from tests.support.fleet_process import LINE3, ROOT, FleetProcess, on_free_ports, with_overrides
from tests.support.ports import HOST, bound

Start = Callable[..., FleetProcess]
STEEP = 'sim.paths=[{agent=1, kind="circle", center_m=[0.0, 0.0, -5.0], radius_m=50.0, lap_s=10.0}]'


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit code and the one line of a command that is refused before any process starts."""
    code = cli.main(arguments)
    line = capsys.readouterr().err
    assert line.startswith("fleetloc: error: ")
    assert line.count("\n") == 1
    return code, line


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("estimator.windo=3", "estimator.windo: expected one of kind, window"),
        ("fleet.period_s=0", "fleet.period_s"),
        ("sim.gps_hz=900", "sim.gps_hz: expected a number <= 50, found 900"),
        (STEEP, "agent 1: path: expected one that needs at most 2.0 m/s2 per axis"),
        ("transport.loss=2", "transport.loss"),
    ],
)
def test_a_wrong_configuration(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, override: str, says: str
) -> None:
    code, line = refused(capsys, "fleet", str(LINE3), "--out", str(tmp_path / "run"), "--set", override)
    assert code == BAD_INPUT
    assert says in line
    assert not (tmp_path / "run").exists()


def test_missing_keys(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    settings = with_overrides(["security.mode=signed", f"security.keys={tmp_path}/k"])
    code, line = refused(capsys, "fleet", str(LINE3), "--out", str(tmp_path / "run"), *settings)
    assert code == BAD_INPUT
    assert f"{tmp_path}/k: no such key directory; make one with `fleetloc keys init`" in line


def test_a_missing_file_names_it(capsys: pytest.CaptureFixture[str]) -> None:
    code, line = refused(capsys, "fleet", "nowhere.toml")
    assert code == BAD_INPUT
    assert "nowhere.toml" in line
    code, line = refused(capsys, "agent", "nowhere.toml", "--id", "1")
    assert code == ExitCode.BAD_INPUT


@pytest.mark.slow
@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM], ids=["mavlink", "radio"])
def test_a_taken_port_stops_the_whole_start(start_fleet: Start, kind: int) -> None:
    with bound(kind) as port:
        taken = f"udpin:{HOST}:{port}" if kind == socket.SOCK_DGRAM else f"tcp/{HOST}:{port}"
        override = f"agents.2.mavlink={taken}" if kind == socket.SOCK_DGRAM else f'agents.2.listen=["{taken}"]'
        fleet = start_fleet("--duration", "5", "--set", override)
        code, _, stderr = fleet.finish()
    assert code == REFUSED
    last = stderr.splitlines()[-1]
    assert last.startswith("fleetloc: error: agent 2 ended with exit code")
    assert taken in last
    assert fleet.nothing_left()


@pytest.mark.slow
def test_an_autopilot_that_never_appears(tmp_path: Path) -> None:
    overrides = [*on_free_ports(3), "mavlink.appear_timeout_s=0.5"]
    done = subprocess.run(
        [sys.executable, "-m", "fleetloc", "agent", str(LINE3), "--id", "1", "--quiet", *with_overrides(overrides)],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == ExitCode.NO_AUTOPILOT
    assert "expected heartbeats of an autopilot (px4) with system id 1 within 0.5 s, found nothing" in done.stderr
    assert "Traceback" not in done.stderr
