"""Whole fleets as users start them: processes, sockets, signals. Every wait has an end and polls for an event."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.support.ports import HOST, free_ports

ROOT = Path(__file__).parents[2]
LINE3 = ROOT / "configs" / "line3.toml"
PATIENCE_S = 300.0
"""A first start compiles kernels."""
POLL_S = 0.05


def on_free_ports(count: int) -> list[str]:
    """Overrides that move a fleet with ids from 1 to ports that nobody uses."""
    udp, tcp = free_ports(socket.SOCK_DGRAM, count), free_ports(socket.SOCK_STREAM, count)
    moved = [f"agents.{i + 1}.mavlink=udpin:{HOST}:{port}" for i, port in enumerate(udp)]
    return moved + [f'agents.{i + 1}.listen=["tcp/{HOST}:{port}"]' for i, port in enumerate(tcp)]


def with_overrides(overrides: list[str]) -> list[str]:
    return [argument for override in overrides for argument in ("--set", override)]


def until(condition: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> None:
    """Poll for an event; fails the test if it does not happen."""
    end_s = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end_s:
            pytest.fail(f"in {patience_s:g} s not seen: {what}")
        time.sleep(POLL_S)


def processes_with(word: str) -> dict[int, list[str]]:
    """Command lines by process id of what runs with this word among its arguments."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                arguments = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
            except OSError:
                continue  # it has ended meanwhile
            if any(word in argument for argument in arguments):
                found[int(entry.name)] = arguments
    return found


class FleetProcess:
    """One ``fleetloc fleet``; its folder's name tells its processes from all others."""

    def __init__(self, out: Path, *arguments: str, config: Path = LINE3) -> None:
        self.out = out
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fleetloc", "fleet", str(config), "--out", str(out), *arguments],
            cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,  # as from a terminal of its own, with a share of the machine of its own
        )  # fmt: skip

    def log(self, agent_id: int) -> str:
        path = self.out / f"agent_{agent_id:03d}.log"
        return path.read_text() if path.exists() else ""

    def flying(self) -> bool:
        """Whether the simulator's autopilots have reached every daemon."""
        logs = [self.log(int(path.stem[-3:])) for path in self.out.glob("agent_???.log")]
        return bool(logs) and all("autopilot connected" in log for log in logs)

    def pid_of(self, agent_id: int) -> int:
        """Process id of a daemon."""
        found = [
            pid for pid, arguments in processes_with(str(self.out)).items()
            if "agent" in arguments and arguments[arguments.index("--id") + 1] == str(agent_id)
        ]  # fmt: skip
        assert len(found) == 1
        return found[0]

    def interrupt(self) -> None:
        """What Ctrl-C does."""
        self.process.send_signal(signal.SIGINT)

    def finish(self) -> tuple[int, str, str]:
        """Exit code, stdout and stderr."""
        stdout, stderr = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, stdout, stderr

    def report(self) -> dict[str, Any]:
        content: dict[str, Any] = msgspec.json.decode((self.out / "report.json").read_bytes())
        return content

    def nothing_left(self) -> bool:
        return not processes_with(str(self.out))

    def clean_up(self) -> None:
        """For a test that failed half way: end what is left, by process id."""
        for pid in (self.process.pid, *processes_with(str(self.out))):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        self.process.wait()
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
