"""Simulated modules on pseudo terminals, one a drone, each found under a link with the drone's id."""

from __future__ import annotations

import contextlib
import os
import tty
from pathlib import Path

from sim_bridge.uwb_modules.speech import SPEECHES, Speech
from sim_bridge.world.sensors import SensedRanges

READ_BYTES = 256


def device_path(folder: Path, agent_id: int) -> Path:
    """Where the module of a drone is plugged in."""
    return folder / f"uwb_{agent_id:03d}"


class ModuleTerminal:
    """One module on a pseudo terminal; unplugged it is gone as a USB device is, link and all."""

    def __init__(self, path: Path, speech: Speech) -> None:
        self.path, self.speech = path, speech
        self._master = self._slave = -1

    @property
    def plugged(self) -> bool:
        """Whether it is there."""
        return self._master >= 0

    def plug(self) -> None:
        """Make it appear; raises `OSError` where the system has no terminal left or the link cannot be made."""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Make it disappear."""
        if self.plugged:
            self.path.unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def answer(self) -> None:
        """Answer what was typed since the last time."""
        with contextlib.suppress(BlockingIOError):
            while self.plugged and (typed := os.read(self._master, READ_BYTES)):
                self.send(self.speech.hear(typed))

    def send(self, data: bytes) -> bool:
        """Send bytes; whether all of them went: nobody may read, and the terminal's buffer is small."""
        if not data:
            return True
        try:
            return self.plugged and os.write(self._master, data) == len(data)
        except BlockingIOError:
            return False


class SimulatedModules:
    """The modules of a simulated fleet."""

    def __init__(self, kind: str, ids: tuple[int, ...], folder: Path) -> None:
        """Plug in a module of a kind for every drone; raises `OSError`."""
        self.terminals = {each: ModuleTerminal(device_path(folder, each), SPEECHES[kind](each)) for each in ids}
        for terminal in self.terminals.values():
            terminal.plug()

    def say(self, taken_s: float, ranges: SensedRanges) -> bool:
        """Have a module say what it measured at ``taken_s``; whether its port took it."""
        terminal = self.terminals[ranges.observer]
        terminal.answer()
        return terminal.send(terminal.speech.say(taken_s, ranges))

    def close(self) -> None:
        """Unplug all."""
        for terminal in self.terminals.values():
            terminal.unplug()
