"""The simulator process: steps the fleet in real time, serves its autopilots, publishes its ranges."""

from __future__ import annotations

import asyncio
import logging
import signal
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path

from agent.config.endpoints import Endpoint, parse_endpoint
from agent.config.tables import FleetConfig
from agent.radio.security import simulated_mavlink_keys
from sim_bridge.autopilot.udp_autopilot import AutopilotPort, open_port
from sim_bridge.companions.target_camera import CameraDrivers
from sim_bridge.uwb_modules.terminals import SimulatedModules
from sim_bridge.world.range_sessions import open_range_sessions
from sim_bridge.world.scenario import Scenario
from sim_bridge.world.scenario_config import scenario_from_config
from sim_bridge.world.sim_table import sim_table
from sim_bridge.world.simulation import Outputs, Simulation, aligned_start
from sim_bridge.world.uwb_frames import UwbDrivers
from transport.link.session_settings import SessionSettings

LOG = logging.getLogger(__name__)
LATE_S = 0.1
"""The world behind the clock by more than this is reported: the run is no longer in real time."""
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)

PublishRanges = Callable[[int, bytes], bool]
"""(observer, ``uwb-range/1`` or ``target-detection/1`` payload) -> whether it was taken."""

OnAdvance = Callable[[Simulation], None]
"""Called whenever the world has moved, e.g. to show it."""


@dataclass(frozen=True, slots=True)
class SimulatorReport:
    """How a run of the simulator went."""

    duration_s: float
    """Simulated time."""
    max_behind_s: float
    """Furthest that the world was behind the clock."""
    ranges_published: int
    ranges_failed: int
    frames_unsent: int
    """For daemons that have not spoken yet."""
    send_errors: int


class Simulator:
    """Drives a `Simulation` by the monotonic clock.

    Open it with `serve`; ``ports`` by agent are its autopilots' sockets.
    """

    def __init__(
        self,
        simulation: Simulation,
        publish_ranges: PublishRanges,
        on_advance: OnAdvance | None = None,
        modules: SimulatedModules | None = None,
    ) -> None:
        """``modules`` bring the ranges in place of frames."""
        self.simulation = simulation
        self._on_advance = on_advance
        self.ports: dict[int, AutopilotPort] = {}
        self._publish_ranges, self._modules = publish_ranges, modules
        self._drivers, self._cameras = UwbDrivers(), CameraDrivers()
        self._published = 0
        self._failed = 0
        self._max_behind_s = 0.0
        self._late = False

    @asynccontextmanager
    async def serve(self, links: dict[int, Endpoint]) -> AsyncIterator[None]:
        """Open the autopilots' sockets opposite to the daemons' links; raises `PortError`."""
        try:
            for agent, link in links.items():
                self.ports[agent] = await open_port(link, self._acceptor(agent))
            yield
        finally:
            for port in self.ports.values():
                port.close()

    def _acceptor(self, agent: int) -> Callable[[bytes], tuple[list[bytes], bool]]:
        def accept(data: bytes) -> tuple[list[bytes], bool]:
            link = self.simulation.autopilots[agent].link
            before = link.received
            frames = self.simulation.receive(agent, data, time.monotonic())
            return frames, link.received > before

        return accept

    async def run(self, duration_s: float, stop: asyncio.Event) -> SimulatorReport:
        """Step in real time until the simulated time is over or ``stop`` is set."""
        end_s = self.simulation.start_s + duration_s
        while not stop.is_set() and self.simulation.now < end_s:
            await _sleep_until(self.simulation.next_step_s(), stop)
            now = time.monotonic()
            self._watch(now - self.simulation.next_step_s())
            self._send(self.simulation.advance(min(now, end_s)))
            if self._on_advance is not None:
                self._on_advance(self.simulation)
        return self.report()

    def _watch(self, behind_s: float) -> None:
        self._max_behind_s = max(self._max_behind_s, behind_s)
        if (behind_s > LATE_S) != self._late:
            self._late = not self._late
            if self._late:
                LOG.warning("simulator %.0f ms behind the clock: is the machine overloaded?", 1e3 * behind_s)
            else:
                LOG.warning("simulator keeps up again")

    def _send(self, outputs: Outputs) -> None:
        frames: dict[int, list[bytes]] = {}
        for agent, frame in outputs.frames:
            frames.setdefault(agent, []).append(frame)
        for agent, waiting in frames.items():
            self.ports[agent].send(waiting)
        for taken_s, ranges in outputs.ranges:
            if self._modules is not None:
                taken = self._modules.say(taken_s, ranges)
            else:
                taken = self._publish_ranges(ranges.observer, self._drivers.payload(taken_s, ranges))
            self._published += taken
            self._failed += not taken
        for taken_s, seen in outputs.detections:
            self._failed += not self._publish_ranges(seen.observer, self._cameras.payload(taken_s, seen))

    def report(self) -> SimulatorReport:
        """How it went so far."""
        return SimulatorReport(
            duration_s=self.simulation.world.time_s,
            max_behind_s=self._max_behind_s,
            ranges_published=self._published,
            ranges_failed=self._failed,
            frames_unsent=sum(port.unsent for port in self.ports.values()),
            send_errors=sum(port.send_errors for port in self.ports.values()),
        )


async def _sleep_until(time_s: float, stop: asyncio.Event) -> None:
    """Until a time on the monotonic clock, or until ``stop``."""
    left_s = time_s - time.monotonic()
    if left_s <= 0.0:
        await asyncio.sleep(0)
    elif left_s < LATE_S:
        await asyncio.sleep(left_s)
    else:
        try:
            await asyncio.wait_for(stop.wait(), left_s)
        except TimeoutError:
            return


@contextmanager
def stop_signals(stop: asyncio.Event) -> Iterator[None]:
    """Set ``stop`` on SIGTERM and SIGINT."""
    loop = asyncio.get_running_loop()
    for number in STOP_SIGNALS:
        loop.add_signal_handler(number, stop.set)
    try:
        yield
    finally:
        for number in STOP_SIGNALS:
            loop.remove_signal_handler(number)


async def simulate(
    config: FleetConfig,
    *,
    duration_s: float | None = None,
    truth_file: Path | None = None,
    start_unix_s: float | None = None,
    session_settings: SessionSettings | None = None,
    stop: asyncio.Event | None = None,
    on_advance: OnAdvance | None = None,
    base: Path = Path(),
    modules_folder: Path = Path(),
) -> SimulatorReport:
    """Run the whole simulator of a fleet; ``base`` is the folder that the key folder is relative to.

    The ports of simulated UWB modules, where ``[sim]`` asks for such, appear in ``modules_folder``.

    Starts on the first tick at or after ``start_unix_s`` (absent: now), lasts ``duration_s`` (absent: that of
    ``[sim]``) or until ``stop``, SIGTERM or SIGINT, and then writes the truth. Raises `ScenarioError`,
    `PortError`, `EndpointError`, `KeyFileError` or `SessionError` of `transport.errors` before anything moves.
    """
    scenario = scenario_from_config(config)
    links = {agent.id: parse_endpoint(agent.mavlink) for agent in config.agents}
    simulation = _simulation_now(scenario, start_unix_s, simulated_mavlink_keys(config, base))
    stop = stop or asyncio.Event()
    sessions = await open_range_sessions(config, base, session_settings)
    modules = None
    try:
        if sim_table(config).uwb_module != "none":
            modules = SimulatedModules(sim_table(config).uwb_module, config.ids, modules_folder)
        simulator = Simulator(simulation, sessions.publish, on_advance, modules)
        async with simulator.serve(links):
            with stop_signals(stop):
                return await simulator.run(sim_table(config).duration_s if duration_s is None else duration_s, stop)
    finally:
        if modules is not None:
            modules.close()
        await sessions.close()
        if truth_file is not None and simulation.world.time_s > 0.0:
            simulation.truth().save(truth_file)


def _simulation_now(scenario: Scenario, start_unix_s: float | None, signing_keys: Mapping[int, bytes]) -> Simulation:
    """A simulation on the monotonic clock of this host."""
    unix_offset_s = time.time() - time.monotonic()
    earliest_s = time.monotonic()
    if start_unix_s is not None:
        earliest_s = max(earliest_s, start_unix_s - unix_offset_s)
    start_s = aligned_start(earliest_s, unix_offset_s, scenario)
    return Simulation(scenario, start_s, unix_offset_s, signing_keys)
