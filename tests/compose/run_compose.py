"""Build the images, fly the compose fleet, and check what must hold: `make test-compose`.

Skipped with a clear word where no container engine answers. Prints figures as JSON.

    python tests/compose/run_compose.py [--lossy] [--duration 60] [--keep]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PROJECT = "fleetloc-test"
MAX_IMAGE_BYTES = 1_000_000_000
LEAST_ON_TIME = 0.99
BUILD_TIMEOUT_S, RUN_TIMEOUT_S = 1800, 900
CONTAINERS = ("agent1", "agent2", "agent3", "simulator", "report")


def main() -> int:
    """Exit code 0 if everything held or no engine is there, 1 otherwise."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--lossy", action="store_true", help="with the lossy radio under it")
    parser.add_argument("--duration", type=float, default=60.0, help="seconds of flight")
    parser.add_argument("--keep", action="store_true", help="leave containers and volume")
    options = parser.parse_args()
    why_not = engine_missing()
    if why_not:
        print(f"SKIPPED: the compose fleet needs a container engine with compose v2: {why_not}")  # noqa: T201
        return 0
    compose = Compose(lossy=options.lossy, duration_s=options.duration)
    try:
        figures, faults = compose.fly()
    finally:
        if not options.keep:
            compose.run("down", "--volumes", "--remove-orphans", timeout_s=120)
    print(json.dumps(figures, indent=1))  # noqa: T201
    for fault in faults:
        print(f"FAILED: {fault}", file=sys.stderr)  # noqa: T201
    return 1 if faults else 0


def engine_missing() -> str | None:
    """Why no engine can be used, or None."""
    try:
        for command in (("docker", "version"), ("docker", "compose", "version")):
            done = subprocess.run(command, capture_output=True, text=True, timeout=30)
            if done.returncode != 0:
                return f"`{' '.join(command)}` says: {(done.stderr or done.stdout).strip().splitlines()[-1]}"
    except FileNotFoundError:
        return "no docker command"
    except subprocess.TimeoutExpired:
        return "docker does not answer"
    return None


class Compose:
    """One compose project of this repository."""

    def __init__(self, *, lossy: bool, duration_s: float) -> None:
        self.lossy = lossy
        self._files = ["docker-compose.yml", *(["docker-compose.lossy.yml"] if lossy else [])]
        self._environment = os.environ | {"FLEETLOC_DURATION_S": f"{duration_s:g}"}

    def run(self, *arguments: str, timeout_s: float) -> subprocess.CompletedProcess[str]:
        """A compose command, its output shown as it comes."""
        files = [part for file in self._files for part in ("--file", file)]
        command = ["docker", "compose", "--project-name", PROJECT, *files, *arguments]
        return subprocess.run(command, cwd=ROOT, env=self._environment, timeout=timeout_s, text=True, check=False)

    def fly(self) -> tuple[dict[str, Any], list[str]]:
        """Build, fly, look; figures and what did not hold."""
        began_s = time.monotonic()
        if self.run("build", timeout_s=BUILD_TIMEOUT_S).returncode != 0:
            return {}, ["docker compose build"]
        built_s = time.monotonic()
        ended = self.run("up", "--exit-code-from", "report", timeout_s=RUN_TIMEOUT_S).returncode
        up_s = time.monotonic() - built_s
        figures: dict[str, Any] = {"build_s": built_s - began_s, "up_s": up_s, "exit_code": ended}
        figures["image_bytes"] = int(inspect("image", "fleetloc:local", "{{.Size}}"))
        figures["users"] = {name: inspect("container", container(name), "{{.Config.User}}") for name in CONTAINERS}
        faults = [f"{name} runs as root" for name, user in figures["users"].items() if user in ("", "root", "0")]
        if figures["image_bytes"] > MAX_IMAGE_BYTES:
            faults.append(f"image of {figures['image_bytes']} bytes, at most {MAX_IMAGE_BYTES} expected")
        if ended != 0:
            return figures, [*faults, f"docker compose up ended with {ended}"]
        report = self._report()
        figures |= {key: report["fleet"][key] for key in ("ticks_on_time_fraction", "position_rmse_m", "anees")}
        figures["agents"] = len(report["agents"])
        if figures["agents"] != 3:
            faults.append(f"{figures['agents']} agents in the report, 3 expected")
        if not self.lossy and figures["ticks_on_time_fraction"] < LEAST_ON_TIME:
            faults.append(f"{figures['ticks_on_time_fraction']:.3f} of the ticks on time, {LEAST_ON_TIME} expected")
        return figures, faults

    def _report(self) -> dict[str, Any]:
        """``report.json`` from the volume."""
        with tempfile.TemporaryDirectory() as folder:
            command = ["docker", "cp", f"{container('report')}:/data/report.json", folder]
            subprocess.run(command, check=True, capture_output=True, timeout=60)
            content: dict[str, Any] = json.loads((Path(folder) / "report.json").read_text(encoding="utf-8"))
        return content


def container(service: str) -> str:
    """Name that compose gives the container of a service."""
    return f"{PROJECT}-{service}-1"


def inspect(kind: str, name: str, template: str) -> str:
    """One fact about an image or a container."""
    command = ["docker", kind, "inspect", "--format", template, name]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
