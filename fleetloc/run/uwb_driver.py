"""The process that stands between a UWB module and the daemon of its drone: port in, ``uwb-range/1`` out."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path

from agent.config.endpoints import LinkKind, parse_endpoint
from agent.config.tables import FleetConfig
from agent.errors import OPENING_FAULTS, cause_of
from agent.uwb.modules.driver import ModuleDriver
from agent.uwb.modules.kinds import KINDS
from fleetloc.api.uwb import UwbDriver
from fleetloc.run.uwb_port import ModulePort, find_module, serial_devices
from fleetloc.whole_config import load_whole
from sim_bridge.world.simulator import stop_signals

LOG = logging.getLogger("fleetloc.uwb")
AUTO = "auto"
GONE = "is not there; waiting for it"
RETRY_S = 0.25
"""A port that is not there is looked for this often."""
HOUSE_S = 0.1
REPORT_S = 10.0


class UwbProcess:
    """Runs until it is stopped; a port that is not there, or no longer, is waited for."""

    def __init__(self, device: str, kind: str, publisher: UwbDriver, driver: ModuleDriver, taken: set[str]) -> None:
        self._device, self._kind, self._publisher, self._driver = device, KINDS[kind], publisher, driver
        self._taken = taken
        self._port: ModulePort | None = None
        self._told = ""
        self._named: set[int] = set()
        self._plugged_s = 0.0
        self._first = True
        self.unsent = 0
        """Frames that the session did not take."""

    async def run(self, stop: asyncio.Event) -> None:
        """Until ``stop``."""
        report_s = time.monotonic() + REPORT_S
        try:
            while not stop.is_set():
                if self._port is None or not self._port.open:
                    await self._plug()
                else:
                    self._port.send(self._driver.to_send(time.monotonic()))
                self._name_strangers()
                if time.monotonic() >= report_s:
                    report_s += REPORT_S
                    LOG.debug("%s", self.summary())
                await _pause(stop, RETRY_S if self._port is None else HOUSE_S)
        finally:
            if self._port is not None:
                self._port.close()
            LOG.info("%s", self.summary())

    def summary(self) -> str:
        """What has become of everything so far, for people."""
        counts = self._driver.counts
        parts = [f"{self._driver.ranges} ranges, {self._publisher.frames} frames", f"{counts.used} bytes used"]
        parts += [f"{count} bytes refused ({reason})" for reason, count in sorted(counts.refused.items())]
        left_out = counts.left_out + self._driver.left_out
        parts += [f"{count} ranges left out ({reason})" for reason, count in sorted(left_out.items())]
        return f"{self._who}: " + ", ".join(parts)

    @property
    def _who(self) -> str:
        return f"uwb drone {self._publisher.agent_id}"

    async def _plug(self) -> None:
        """Open the port, if it is there; each state is told once."""
        if self._port is not None:
            self._port = None
            self._tell(logging.WARNING, f"{self._device} {GONE}")
        device: str | None = self._device
        if self._device == AUTO:
            device = await find_module(self._kind, serial_devices(), self._taken)
            if device is None:
                self._tell(logging.WARNING, f"no free serial port speaks {self._kind.name}; listening on")
                return
        assert device is not None
        try:
            self._port = ModulePort(device, self._kind.baud, self._on_data)
        except OPENING_FAULTS as error:
            gone = not os.path.exists(device)
            self._tell(logging.WARNING, f"{device} {GONE}" if gone else f"{cause_of(error)}; trying again")
            return
        self._plugged_s, self._first = time.monotonic(), True
        self._driver.plugged(self._plugged_s)
        self._tell(logging.INFO, f"{self._kind.name} on {device} opened")

    def _tell(self, level: int, words: str) -> None:
        if words != self._told:
            self._told = words
            LOG.log(level, "%s: %s", self._who, words)

    def _on_data(self, data: bytes, arrival_s: float) -> None:
        for taken in self._driver.feed(data, arrival_s):
            if not self._publisher.publish(taken.ranges, max(round(1e9 * taken.taken_s), 0)):
                self.unsent += 1
            if self._first:
                self._first = False
                others = ", ".join(str(each.other) for each in taken.ranges)
                after_s = time.monotonic() - self._plugged_s
                LOG.info("%s: first ranges, to %s, %.1f s after the port was opened", self._who, others, after_s)

    def _name_strangers(self) -> None:
        for module in self._driver.strange.keys() - self._named:
            self._named.add(module)
            words = "%s: nobody is known to carry module %d (0x%04x), which is left out; --map says who"
            LOG.warning(words, self._who, module, module)


async def _pause(stop: asyncio.Event, seconds: float) -> None:
    try:
        await asyncio.wait_for(stop.wait(), seconds)
    except TimeoutError:
        return


async def drive(
    config_file: Path,
    agent_id: int,
    kind: str,
    device: str,
    *,
    drone_of: Mapping[int, int],
    sigma_m: float | None = None,
    lag_s: float = 0.0,
) -> None:
    """Be the driver of a drone's module until SIGTERM or SIGINT; ``drone_of`` beats module id = drone id.

    Raises `ConfigError`, `KeyFileError`, `SessionError`.
    """
    publisher = UwbDriver(config_file, agent_id)
    fleet = load_whole(config_file)
    carried = {each: each for each in fleet.ids if each not in drone_of.values()} | dict(drone_of)
    driver = ModuleDriver(KINDS[kind], agent_id, carried, sigma_m=sigma_m, lag_s=lag_s)
    stop = asyncio.Event()
    with stop_signals(stop):
        async with publisher:
            await UwbProcess(device, kind, publisher, driver, _autopilots_ports(fleet)).run(stop)


def _autopilots_ports(fleet: FleetConfig) -> set[str]:
    """Serial ports on which autopilots are: they are not listened to."""
    endpoints = (parse_endpoint(agent.mavlink) for agent in fleet.agents)
    return {os.path.realpath(each.host) for each in endpoints if each.kind is LinkKind.SERIAL}
