"""The bridge process between simulated autopilots and the daemons of a fleet.

It holds the simulators' links and relays every byte; it listens for the truth on the way, and plays the UWB modules
and the record of what really happened, as the simulator of our own does.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from agent.config.tables import FleetConfig
from sim_bridge.sitl.session import TimedTruth
from sim_bridge.sitl.setup import vehicle_links
from sim_bridge.sitl.sitl_table import sitl_table
from sim_bridge.sitl.vehicle import NOBODY, SitlVehicle, VehicleReport
from sim_bridge.sitl.world import SitlWorld
from sim_bridge.world.range_sessions import open_range_sessions
from sim_bridge.world.sim_table import GpsOutage, sim_table
from sim_bridge.world.simulator import PublishRanges, stop_signals
from sim_bridge.world.truth import TruthError
from sim_bridge.world.uwb_frames import UwbDrivers

LOG = logging.getLogger(__name__)
STEP_S = 0.01
PROGRESS_S = 5.0
DAEMONS_WAIT_S = 10.0
GIVE_BACK_S = 2.0


class SimulatorAbsent(OSError):
    """A simulator did not show itself, or will never tell its truth; the message names its address."""


@dataclass(frozen=True, slots=True)
class BridgeProgress:
    """Where the bridge is: simulators that are missing yet, for people; all there; the run has begun."""

    missing: tuple[str, ...] = ()
    ready: bool = False
    begun_unix_s: float | None = None


OnProgress = Callable[[BridgeProgress], None]
OnStep = Callable[[SitlWorld, float], None]
"""Called about a hundred times a second of the run with the world and the present time."""


@dataclass(frozen=True, slots=True)
class BridgeReport:
    """How a run of the bridge went; times in s."""

    duration_s: float
    max_behind_s: float
    """Longest that the bridge itself slept past its time."""
    ranges_published: int
    ranges_failed: int
    truth_missing_s: float
    """For how long a vehicle's truth was too old for ranges."""
    lost: tuple[str, ...]
    """Simulators whose truth ended before the run did."""
    vehicles: tuple[VehicleReport, ...]


class SitlBridge:
    """One run; `serve` opens everything, `run` works until it is told to stop."""

    def __init__(self, config: FleetConfig, world: SitlWorld, publish_ranges: PublishRanges) -> None:
        """Raises `ConfigError` for addresses that cannot be used."""
        self._sitl = sitl_table(config)
        self._gps_outages = sim_table(config).gps_outages
        self._no_answer: set[int] = set()
        """Whose GPS should be off and is not."""
        self._world = world
        self._publish_ranges = publish_ranges
        self._drivers = UwbDrivers()
        self._published = self._failed = 0
        self._max_behind_s = 0.0
        self._end_s = 0.0
        self._lost: list[str] = []
        self.vehicles = [
            SitlVehicle(config, links, self._on_truth, self._gps_out) for links in vehicle_links(config).values()
        ]

    def _on_truth(self, agent_id: int, truth: TimedTruth) -> None:
        self._world.tracks[agent_id].put(truth)

    def _gps_out(self, agent_id: int) -> bool:
        return self._is_out(self._gps_outages, agent_id)

    def _is_out(self, outages: tuple[GpsOutage, ...], agent_id: int) -> bool:
        start_s = self._world.start_s
        if start_s is None:
            return False
        flown_s = time.monotonic() - start_s
        return any(each.agent == agent_id and each.from_s <= flown_s < each.to_s for each in outages)

    async def open(self) -> None:
        """Open all links; raises `PortError` or `LinkError`."""
        for vehicle in self.vehicles:
            await vehicle.open()

    async def close(self) -> None:
        """Close all links."""
        for vehicle in self.vehicles:
            await vehicle.close()

    async def run(self, stop: asyncio.Event, on_progress: OnProgress, on_step: OnStep | None = None) -> BridgeReport:
        """Wait for simulators and daemons, then record and range until ``stop``; raises `SimulatorAbsent`."""
        await self._simulators_there(stop, on_progress)
        on_progress(BridgeProgress(ready=True))
        await self._daemons_there(stop)
        if stop.is_set():
            return self.report()
        start_s = self._world.begin(time.monotonic())
        on_progress(BridgeProgress(ready=True, begun_unix_s=start_s + self._world.unix_offset_s))
        while not stop.is_set() and not self._lost:
            await self._step()
            now_s = time.monotonic()
            self._switch_gps()
            self._range(now_s)
            self._note_silence(now_s)
            if on_step is not None:
                on_step(self._world, now_s)
        self._end_s = time.monotonic()
        await self._give_gps_back()
        return self.report()

    async def _give_gps_back(self) -> None:
        """The simulators outlive the run: what was taken away is put back."""
        until_s = time.monotonic() + GIVE_BACK_S
        while any(vehicle.has_gps_off() for vehicle in self.vehicles) and time.monotonic() < until_s:
            for vehicle in self.vehicles:
                vehicle.session.gps_off = False
                vehicle.serve(time.monotonic())
            await asyncio.sleep(STEP_S)

    def _switch_gps(self) -> None:
        """Take the autopilots' GPS away, or give it back; say once where that does not work."""
        for vehicle in self.vehicles:
            session, agent_id = vehicle.session, vehicle.agent_id
            session.gps_off = self._is_out(self._sitl.autopilot_gps, agent_id)
            unknown = session.gps_off and session.receiver is not None and not session.receiver.known
            if unknown and agent_id not in self._no_answer:
                assert session.receiver is not None
                self._no_answer.add(agent_id)
                LOG.warning("drone %s: its simulator has no %s: its GPS stays on", agent_id, session.receiver.name)

    async def _simulators_there(self, stop: asyncio.Event, on_progress: OnProgress) -> None:
        deadline_s = time.monotonic() + self._sitl.appear_timeout_s
        told_s = float("-inf")
        while not stop.is_set():
            self._check_refusals()
            missing = tuple(line for vehicle in self.vehicles if (line := vehicle.missing()) is not None)
            now_s = time.monotonic()
            if not missing:
                return
            if now_s > deadline_s:
                limit_s = self._sitl.appear_timeout_s
                nobody = any(line.endswith(NOBODY) for line in missing)
                doubt = ": is it running there?" if nobody else ""
                raise SimulatorAbsent(f"{'; '.join(missing)}; waited {limit_s:g} s{doubt}")
            if now_s - told_s >= PROGRESS_S:
                told_s = now_s
                on_progress(BridgeProgress(missing))
            await self._step()

    async def _daemons_there(self, stop: asyncio.Event) -> None:
        """Until all daemons have spoken, or the first one has waited long enough for the others."""
        first_s: float | None = None
        while not stop.is_set() and not all(vehicle.daemon_there for vehicle in self.vehicles):
            await self._step()
            now_s = time.monotonic()
            if first_s is None and any(vehicle.daemon_there for vehicle in self.vehicles):
                first_s = now_s
            if first_s is not None and now_s - first_s > DAEMONS_WAIT_S:
                absent = ", ".join(str(vehicle.agent_id) for vehicle in self.vehicles if not vehicle.daemon_there)
                LOG.warning("daemon of drone %s not heard within %g s; beginning without", absent, DAEMONS_WAIT_S)
                return

    def _check_refusals(self) -> None:
        for vehicle in self.vehicles:
            refusal = vehicle.session.refusal
            if refusal is not None:
                raise SimulatorAbsent(f"{vehicle.links.name}: {refusal}")

    async def _step(self) -> None:
        wake_s = time.monotonic() + STEP_S
        await asyncio.sleep(STEP_S)
        now_s = time.monotonic()
        self._max_behind_s = max(self._max_behind_s, now_s - wake_s)
        for vehicle in self.vehicles:
            vehicle.serve(now_s)

    def _range(self, now_s: float) -> None:
        for taken_s, ranges in self._world.ranges(now_s):
            taken = self._publish_ranges(ranges.observer, self._drivers.payload(taken_s, ranges))
            self._published += taken
            self._failed += not taken

    def _note_silence(self, now_s: float) -> None:
        limit_s = self._sitl.silence_s
        for vehicle in self.vehicles:
            last = self._world.tracks[vehicle.agent_id].last
            if last is not None and now_s - last.host_s > limit_s:
                self._lost.append(f"{vehicle.links.name}: no truth for {limit_s:g} s, the run ends")
                LOG.error("%s", self._lost[-1])

    def report(self) -> BridgeReport:
        """How it went so far."""
        start_s = self._world.start_s
        return BridgeReport(
            duration_s=0.0 if start_s is None else max(self._end_s - start_s, 0.0),
            max_behind_s=self._max_behind_s,
            ranges_published=self._published,
            ranges_failed=self._failed,
            truth_missing_s=self._world.stale_s,
            lost=tuple(self._lost),
            vehicles=tuple(
                vehicle.report(self._world.tracks[vehicle.agent_id].max_gap_s) for vehicle in self.vehicles
            ),
        )


async def bridge(
    config: FleetConfig,
    *,
    truth_file: Path | None = None,
    stop: asyncio.Event | None = None,
    on_progress: OnProgress = lambda _progress: None,
    on_step: OnStep | None = None,
    base: Path = Path(),
) -> BridgeReport:
    """Run the bridge of a fleet until ``stop``, SIGTERM or SIGINT, and then write the truth.

    ``base`` is the folder that the key folder is relative to. Raises `ConfigError`, `ScenarioError`, `PortError`,
    `LinkError`, `KeyFileError` or `SessionError` before anything is relayed, `SimulatorAbsent` for a simulator that
    does not come.
    """
    world = SitlWorld(config, time.time() - time.monotonic())
    stop = stop or asyncio.Event()
    sessions = await open_range_sessions(config, base)
    try:
        sitl = SitlBridge(config, world, sessions.publish)
        try:
            await sitl.open()
            with stop_signals(stop):
                return await sitl.run(stop, on_progress, on_step)
        finally:
            await sitl.close()
    finally:
        await sessions.close()
        _save(world, truth_file)


def _save(world: SitlWorld, truth_file: Path | None) -> None:
    if truth_file is None or world.start_s is None:
        return
    try:
        world.truth(time.monotonic()).save(truth_file)
    except TruthError as error:
        LOG.error("%s", error)
