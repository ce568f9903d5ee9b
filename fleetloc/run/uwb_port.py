"""The serial port of a UWB module: found, opened, read, lost and opened again."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any

from agent.errors import OPENING_FAULTS
from agent.uwb.modules.kinds import ModuleKind

READ_BYTES = 4096
LISTEN_S = 2.0
"""A port is listened to for so long to find out whether a module of a kind is there."""
POLL_S = 0.05


class ModulePort:
    """An open port; raises what opening one raises (`OPENING_FAULTS`)."""

    def __init__(self, device: str, baud: int, on_data: Callable[[bytes, float], None]) -> None:
        """``on_data`` gets bytes and the monotonic time of their arrival."""
        import serial  # only where there is a serial port: it takes time to load

        self.device = device
        self._on_data = on_data
        self._port: Any = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        asyncio.get_running_loop().add_reader(self._port.fileno(), self._read)

    @property
    def open(self) -> bool:
        """Whether the module is still there."""
        return self._port is not None

    def send(self, data: bytes) -> None:
        """Type something; on a port that takes nothing it is lost, and a module that waits for it is asked again."""
        if data and self._port is not None:
            try:
                os.write(self._port.fileno(), data)
            except BlockingIOError:
                return
            except OSError:
                self.close()

    def close(self) -> None:
        """Let it go."""
        if self._port is not None:
            asyncio.get_running_loop().remove_reader(self._port.fileno())
            self._port.close()
            self._port = None

    def _read(self) -> None:
        arrival_s = time.monotonic()
        try:
            data = os.read(self._port.fileno(), READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._on_data(data, arrival_s)
        else:
            self.close()


@dataclass(frozen=True, slots=True)
class SerialDevice:
    """A serial port of this machine; ``usb_vendor`` is ``None`` for one that is not on USB."""

    path: str
    usb_vendor: int | None


def serial_devices() -> list[SerialDevice]:
    """Those that there are, USB first."""
    from serial.tools import list_ports

    found = [SerialDevice(str(each.device), each.vid) for each in list_ports.comports()]
    return sorted(found, key=lambda each: (each.usb_vendor is None, each.path))


async def find_module(kind: ModuleKind, devices: Iterable[SerialDevice], taken: Collection[str]) -> str | None:
    """The port on which a module of a kind speaks, of those that nobody holds; ``None`` if on none.

    All are listened to. Only boards of the kind's own vendors are spoken to: what hangs on another port is not known.
    """
    ports: list[tuple[ModulePort, Callable[[], int]]] = []
    try:
        for device in devices:
            if os.path.realpath(device.path) in taken:
                continue
            listener = _Listener(kind, device.usb_vendor in kind.usb_vendors)
            try:
                listener.port = ModulePort(device.path, kind.baud, listener.hear)
            except OPENING_FAULTS:
                continue
            ports.append((listener.port, listener.heard))
        until_s = time.monotonic() + LISTEN_S
        while ports and time.monotonic() < until_s:
            await asyncio.sleep(POLL_S)
            for port, heard in ports:
                if heard() > 0:
                    return port.device
        return None
    finally:
        for port, _ in ports:
            port.close()


class _Listener:
    """Counts what makes sense on a port."""

    def __init__(self, kind: ModuleKind, speaks: bool) -> None:
        from agent.uwb.modules.driver import ModuleDriver

        self._driver, self._speaks = ModuleDriver(kind, 0, {}), speaks
        self._driver.plugged(time.monotonic())
        self.port: ModulePort | None = None

    def hear(self, data: bytes, arrival_s: float) -> None:
        self._driver.feed(data, arrival_s)

    def heard(self) -> int:
        if self._speaks and self.port is not None:
            self.port.send(self._driver.to_send(time.monotonic()))
        return self._driver.counts.readings
