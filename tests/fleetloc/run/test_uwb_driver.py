"""A driver process and simulated modules on pseudo terminals: plugged in, pulled out, searched for."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import pytest

from agent.uwb.modules.driver import ModuleDriver
from agent.uwb.modules.kinds import KINDS, SEGGER
from fleetloc.run import uwb_port
from fleetloc.run.uwb_driver import AUTO, UwbProcess
from fleetloc.run.uwb_port import SerialDevice, find_module
from sim_bridge.uwb_modules.speech import SPEECHES
from sim_bridge.uwb_modules.terminals import ModuleTerminal
from sim_bridge.world.sensors import SensedRange, SensedRanges
from transport.messages.uwb_body import UwbRange

pytestmark = pytest.mark.realtime
WAIT_S = 20.0


class Publisher:
    """Stands in for the session with the daemon."""

    agent_id, frames = 1, 0

    def __init__(self) -> None:
        self.came = asyncio.Event()
        self.ranges: list[tuple[UwbRange, ...]] = []
        self.ages_s: list[float] = []

    def publish(self, ranges: Sequence[UwbRange], taken_ns: int) -> bool:
        self.frames += 1
        self.ranges.append(tuple(ranges))
        self.ages_s.append(time.monotonic() - 1e-9 * taken_ns)
        self.came.set()
        return True

    async def next(self) -> tuple[UwbRange, ...]:
        self.came.clear()
        await asyncio.wait_for(self.came.wait(), WAIT_S)
        return self.ranges[-1]


@contextlib.asynccontextmanager
async def speaking(terminal: ModuleTerminal) -> AsyncIterator[None]:
    """The module measures ten times a second, while it is plugged in."""

    async def speak() -> None:
        ranges = tuple(SensedRange(other, 10.0 * other, 0.1, -80.0, -82.0, 0.0) for other in (2, 3))
        while True:
            terminal.answer()
            now_s = time.monotonic()
            terminal.send(terminal.speech.say(now_s, SensedRanges(1, now_s, ranges)))
            await asyncio.sleep(0.1)

    task = asyncio.create_task(speak())
    try:
        yield
    finally:
        task.cancel()
        terminal.unplug()


@contextlib.asynccontextmanager
async def running(kind: str, device: str) -> AsyncIterator[tuple[Publisher, UwbProcess]]:
    publisher, stop = Publisher(), asyncio.Event()
    driver = ModuleDriver(KINDS[kind], 1, {1: 1, 2: 2, 3: 3})
    process = UwbProcess(device, kind, publisher, driver, set())  # type: ignore[arg-type]
    task = asyncio.create_task(process.run(stop))
    try:
        yield publisher, process
    finally:
        stop.set()
        await task


@pytest.mark.parametrize("kind", KINDS)
async def test_ranges_come_from_a_terminal_and_come_again_when_the_module_was_pulled_out(
    kind: str, tmp_path: Path
) -> None:
    terminal = ModuleTerminal(tmp_path / "uwb", SPEECHES[kind](1))
    async with running(kind, str(terminal.path)) as (publisher, process), speaking(terminal):
        assert publisher.ranges == []
        # WHEN the module is plugged in, and later pulled out and plugged in again
        for _ in range(2):
            terminal.speech = SPEECHES[kind](1)
            terminal.plug()
            ranges = await publisher.next()
            assert [(each.other, each.range_m) for each in ranges] == [(2, 20.0), (3, 30.0)]
            terminal.unplug()
        assert max(publisher.ages_s) < 1.0
    assert process.unsent == 0


async def test_the_port_is_found_by_what_is_said_on_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terminals = [ModuleTerminal(tmp_path / kind, SPEECHES[kind](1)) for kind in ("uci", "linktrack", "dwm1001")]
    for terminal in terminals:
        terminal.plug()
    devices = [SerialDevice(str(terminal.path), None) for terminal in terminals]
    monkeypatch.setattr("fleetloc.run.uwb_driver.serial_devices", lambda: devices)
    async with contextlib.AsyncExitStack() as stack:
        for terminal in terminals:
            await stack.enter_async_context(speaking(terminal))
        assert await find_module(KINDS["uci"], devices, ()) == devices[0].path
        # THEN a port that is another's is not touched, and a board of unknown make is not spoken to
        assert await find_module(KINDS["uci"], devices, {os.path.realpath(devices[0].path)}) is None
        assert await find_module(KINDS["dwm1001"], devices[2:], ()) is None
        monkeypatch.setattr(uwb_port, "LISTEN_S", WAIT_S)
        known = [SerialDevice(devices[2].path, SEGGER)]
        assert await find_module(KINDS["dwm1001"], known, ()) == devices[2].path
        monkeypatch.undo()
        monkeypatch.setattr("fleetloc.run.uwb_driver.serial_devices", lambda: devices)
        async with running("linktrack", AUTO) as (publisher, _):
            assert [each.other for each in await publisher.next()] == [2, 3]
