"""A fleet as processes, each drone in a network namespace, what they say to each other on the lossy segment.

Autopilots and UWB modules belong to the drone: what they say crosses a clean bridge to the simulator's namespace.
Only what the drones' daemons say to each other crosses the segment.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

from agent.config.reading import load_config
from fleetloc.run import run_files
from tests.support.lossnet.segment import address, ip

ROOT = Path(__file__).parents[3]
TUN = Path("/dev/net/tun")
DEVICE_PORT, MAVLINK_PORT = 7440, 14550
PATIENCE_S = 120.0
POLL_S = 0.1


def why_not() -> str | None:
    """What this machine lacks for namespaces and TAP devices; ``None`` = nothing."""
    if os.geteuid() != 0:
        return "needs root for network namespaces"
    if not os.access(TUN, os.R_OK | os.W_OK):
        return f"needs {TUN}"
    tried = subprocess.run(["ip", "netns", "add", _name("try")], check=False, capture_output=True, text=True)
    if tried.returncode != 0:
        return f"cannot make network namespaces: {tried.stderr.strip()}"
    ip("netns", "del", _name("try"))
    return None


def _name(what: object) -> str:
    """Namespaces of this process, apart from those of others."""
    return f"fl{os.getpid()}{what}"


def clean_address(node: int) -> str:
    return f"10.88.0.{node + 1}"


class LossyFlight:
    """One run of ``config`` in ``out``; use as a context manager, nothing of it outlives that.

    ``overrides`` beat the file, ``profiles`` are laid over it. Faults of the segment are named as in `LinkFaults`.
    """

    def __init__(self, config: Path, out: Path, overrides: list[str], profiles: list[Path]) -> None:
        self.out = out
        self.ids = load_config(config).ids
        self._config = config
        addresses = []
        for node, agent_id in enumerate(self.ids):
            addresses += [
                f"agents.{agent_id}.mavlink=udpin:{clean_address(node)}:{MAVLINK_PORT}",
                f'agents.{agent_id}.listen=["tcp/{clean_address(node)}:{DEVICE_PORT}"]',
                f'agents.{agent_id}.radio="{address(node)}"',
            ]
        settings = [argument for each in [*addresses, *overrides] for argument in ("--set", each)]
        self._options = [str(argument) for profile in profiles for argument in ("--with", profile)] + settings
        self._stack = ExitStack()
        self._segment: subprocess.Popen[str] | None = None
        self._daemons: dict[int, subprocess.Popen[str]] = {}

    def __enter__(self) -> LossyFlight:
        self.out.mkdir(parents=True, exist_ok=True)
        try:
            self._build()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def set_faults(self, **faults: float) -> tuple[int, int, int]:
        """Of every directed link from now on; frames, lost frames and bytes before."""
        segment = self._segment
        assert segment is not None
        assert segment.stdin is not None
        assert segment.stdout is not None
        segment.stdin.write(json.dumps(faults) + "\n")
        segment.stdin.flush()
        frames, lost, size = json.loads(segment.stdout.readline())
        return frames, lost, size

    def start_daemons(self) -> None:
        """Each in its namespace, its record and log in ``out``; returns when all have opened their sessions."""
        for node, agent_id in enumerate(self.ids):
            arguments = ("agent", str(self._config), "--id", str(agent_id), "--out", str(self.out), *self._options)
            self._daemons[agent_id] = self._start(_name(node), run_files.log_path(self.out, agent_id), arguments)
        deadline_s = time.monotonic() + PATIENCE_S
        while not all(self._listens(node) for node in range(len(self.ids))):
            self._check_daemons()
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"daemons not on the radio within {PATIENCE_S:g} s; see the logs in {self.out}")
            time.sleep(POLL_S)

    def fly(self, duration_s: float) -> None:
        """The simulator from start to end."""
        log = self.out / run_files.SIMULATOR_LOG
        arguments = ("sim", str(self._config), "--out", str(self.out), "--duration", str(duration_s), *self._options)
        simulator = self._start(_name("sim"), log, arguments)
        if simulator.wait(timeout=duration_s + PATIENCE_S) != 0:
            raise RuntimeError(f"simulator: {log.read_text()[-500:]}")
        time.sleep(0.5)  # the estimate of the last tick

    def report(self) -> dict[str, Any]:
        """End the daemons and make the report."""
        self._check_daemons()
        for daemon in self._daemons.values():
            daemon.terminate()
        for daemon in self._daemons.values():
            daemon.wait(timeout=PATIENCE_S)
        command = [sys.executable, "-m", "fleetloc", "report", str(self._config), str(self.out), *self._options]
        made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if made.returncode != 0:
            raise RuntimeError(made.stderr)
        content: dict[str, Any] = json.loads((self.out / run_files.REPORT_JSON).read_bytes())
        return content

    def counters(self, agent_id: int) -> dict[str, Any]:
        """What a daemon has written at its end: state, counters, gauges, neighbours."""
        path = run_files.record_path(self.out, agent_id).with_suffix(run_files.SUMMARY_SUFFIX)
        content: dict[str, Any] = json.loads(path.read_bytes())
        return content

    # --- parts ----------------------------------------------------------------------------------------------

    def _build(self) -> None:
        nodes = [_name(node) for node in range(len(self.ids))]
        hub = _name("sim")
        for namespace in (hub, *nodes):
            ip("netns", "add", namespace)
            self._stack.callback(ip, "netns", "del", namespace)
            ip("-n", namespace, "link", "set", "lo", "up")
        ip("-n", hub, "link", "add", "clean", "type", "bridge")
        ip("-n", hub, "addr", "add", f"{clean_address(len(nodes))}/24", "dev", "clean")
        ip("-n", hub, "link", "set", "clean", "up")
        for node, namespace in enumerate(nodes):
            ip("-n", hub, "link", "add", f"to{node}", "type", "veth", "peer", "name", "clean", "netns", namespace)
            ip("-n", hub, "link", "set", f"to{node}", "master", "clean", "up")
            ip("-n", namespace, "addr", "add", f"{clean_address(node)}/24", "dev", "clean")
            ip("-n", namespace, "link", "set", "clean", "up")
        self._segment = self._start(None, self.out / "segment.log", nodes, module="tests.support.lossnet.segment")
        assert self._segment.stdout is not None
        if self._segment.stdout.readline().strip() != "ready":
            raise RuntimeError((self.out / "segment.log").read_text())

    def _start(
        self, namespace: str | None, log: Path, arguments: tuple[str, ...] | list[str], module: str = "fleetloc"
    ) -> subprocess.Popen[str]:
        inside = [] if namespace is None else ["ip", "netns", "exec", namespace]
        stderr: IO[bytes] = self._stack.enter_context(log.open("wb"))
        process = subprocess.Popen(
            [*inside, sys.executable, "-m", module, *arguments],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True,
            # as on a machine of its own: where sessions share one, what is flown gets no less than the tests' witness
            start_new_session=True,
        )  # fmt: skip
        self._stack.callback(_end, process)
        return process

    def _listens(self, node: int) -> bool:
        """Whether a daemon's session is open: its device port is bound (1 = a listening socket in /proc)."""
        found = subprocess.run(
            ["ip", "netns", "exec", _name(node), "ss", "-Htln", f"sport = :{DEVICE_PORT}"],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        return bool(found.stdout.strip())

    def _check_daemons(self) -> None:
        for agent_id, daemon in self._daemons.items():
            if daemon.poll() is not None:
                words = run_files.log_path(self.out, agent_id).read_text()[-500:]
                raise RuntimeError(f"agent {agent_id} ended with exit code {daemon.returncode}: {words}")


def _end(process: subprocess.Popen[str]) -> None:
    """By its process id; asked first."""
    process.send_signal(signal.SIGTERM)
    if process.stdin is not None:
        process.stdin.close()
    try:
        process.wait(timeout=10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()
