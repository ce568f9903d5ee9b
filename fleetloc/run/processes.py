"""Child processes of a run: started in groups of their own, watched, and stopped without leaving any behind."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from fleetloc.errors import EnvironmentFault
from fleetloc.shadowing import child_options

GRACE_S = 8.0
"""After SIGTERM a child has this long to write its files; then it is killed."""
TAIL_BYTES = 4000
TAIL_LINES = 5
CLOCK_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class Child:
    """One ``fleetloc`` process. Its stderr goes to ``log``, its stdout nowhere unless ``reads_stdout``."""

    def __init__(self, name: str, arguments: Sequence[str], log: Path, *, reads_stdout: bool = False) -> None:
        self.name = name
        self.log = log
        self.process: asyncio.subprocess.Process | None = None
        self._arguments = arguments
        self._reads_stdout = reads_stdout
        self.stopped_by_us = False
        self.lived_s = 0.0
        self._started_s = 0.0

    async def start(self) -> None:
        """Start it; raises `EnvironmentFault` if the machine refuses.

        It gets a session of its own: Ctrl-C reaches the starter alone, which then stops all in order.
        """
        output = asyncio.subprocess.PIPE if self._reads_stdout else asyncio.subprocess.DEVNULL
        try:
            with self.log.open("wb") as log:
                self.process = await asyncio.create_subprocess_exec(
                    sys.executable, *child_options(), "-m", "fleetloc", *self._arguments,
                    stdin=asyncio.subprocess.DEVNULL, stdout=output, stderr=log, start_new_session=True,
                )  # fmt: skip
        except OSError as error:
            raise EnvironmentFault(f"{self.name}: cannot be started: {error.strerror or error}") from error
        self._started_s = time.monotonic()

    @property
    def running(self) -> bool:
        """Started and not ended."""
        return self.process is not None and self.process.returncode is None

    @property
    def pid(self) -> int:
        """Process id; -1 before the start."""
        return -1 if self.process is None else self.process.pid

    async def wait(self) -> int:
        """Until it has ended; the exit code, negative for a signal."""
        assert self.process is not None
        code = await self.process.wait()
        self.lived_s = time.monotonic() - self._started_s
        return code

    def terminate(self) -> None:
        """Ask it to end."""
        self.stopped_by_us = True
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self.stopped_by_us = True
        self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        if self.process is not None and self.process.returncode is None:
            try:
                self.process.send_signal(number)
            except ProcessLookupError:
                return  # it ended by itself in this moment

    def why_it_ended(self) -> str:
        """The exit code or signal, and the last words on stderr."""
        code = None if self.process is None else self.process.returncode
        if code is None:
            return "not ended"
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        words = " | ".join(self.last_lines())
        return f"{how}: {words}" if words else how

    def last_lines(self) -> list[str]:
        """The last lines that it wrote to stderr."""
        try:
            with self.log.open("rb") as file:
                file.seek(max(self.log.stat().st_size - TAIL_BYTES, 0))
                text = file.read().decode("utf-8", "replace")
        except OSError as error:
            return [f"{self.log}: {error.strerror}"]
        return [line for line in text.splitlines() if line.strip()][-TAIL_LINES:]


async def stop_all(children: Iterable[Child], grace_s: float = GRACE_S) -> list[str]:
    """End all that run, in order: asked first, killed after the grace; names of those that had to be killed."""
    running = [child for child in children if child.running]
    for child in running:
        child.terminate()
    waits = {child: asyncio.ensure_future(child.wait()) for child in running}
    if waits:
        await asyncio.wait(waits.values(), timeout=grace_s)
    stubborn = [child for child in running if child.running]
    for child in stubborn:
        child.kill()
    await asyncio.gather(*waits.values())
    return [child.name for child in stubborn]


def cpu_time_s(pid: int) -> float | None:
    """User and system time that a process has used so far; ``None`` where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS_PER_S


def resident_mb(pid: int) -> float | None:
    """Resident memory of a process; ``None`` where the system does not tell."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]) * PAGE_BYTES / 1e6
    except (OSError, IndexError):
        return None
