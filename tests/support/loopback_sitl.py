"""Our simulated autopilots, served as simulators serve theirs: ArduPilot as a TCP server, PX4 sending UDP.

As a process: ``python -m tests.support.loopback_sitl 1 tcp:127.0.0.1:5760`` is the simulator of agent 1 at an address
as the bridge opens it; odd agents are PX4, even ones ArduPilot. It ends with its stdin. Every drone has a process of
its own, as with real simulators: on a busy machine, where each process gets a share, one for all would fall behind.
"""

from __future__ import annotations

import asyncio
import sys
import time
import traceback
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

from agent.config.endpoints import Endpoint, LinkKind, parse_endpoint
from agent.sensing.frames import FleetFrame
from sim_bridge.autopilot.udp_autopilot import AutopilotPort, open_port
from sim_bridge.world.scenario import Scenario, Vehicle
from sim_bridge.world.simulation import Simulation

FRAME = FleetFrame(-35.363262, 149.165237, 584.0, True, None)
STEP_S = 0.005
HOMES_M = {1: (0.0, 0.0, 0.0), 2: (0.0, 12.0, 0.0), 3: (12.0, 0.0, 0.0)}


def flavour_of(agent_id: int) -> str:
    return "px4" if agent_id % 2 else "ardupilot"


def grounded_fleet(ids: tuple[int, ...] = (1, 2, 3), **settings: object) -> Scenario:
    """Both flavours at rest at their homes."""
    vehicles = tuple(
        Vehicle(agent, flavour_of(agent), agent, start_m=HOMES_M[agent], on_ground=True)  # type: ignore[arg-type]
        for agent in ids
    )
    return Scenario(vehicles=vehicles, frame=FRAME, **settings)  # type: ignore[arg-type]


class LoopbackSitl:
    """Serves the autopilots of a simulation in real time."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.received = {agent: bytearray() for agent in simulation.autopilots}
        self.sent = {agent: bytearray() for agent in simulation.autopilots}
        self._ports: dict[int, AutopilotPort] = {}
        self._writers: dict[int, asyncio.StreamWriter] = {}

    @asynccontextmanager
    async def serve(self, links: dict[int, Endpoint]) -> AsyncIterator[None]:
        servers = []
        for agent, link in links.items():
            if link.kind is LinkKind.TCP_OUT:
                servers.append(await asyncio.start_server(self._tcp(agent), link.host, link.port))
            else:
                self._ports[agent] = await open_port(link, self._udp(agent))
        running = asyncio.create_task(self._run())
        running.add_done_callback(_report)
        try:
            yield
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            for server in servers:
                server.close()
            for writer in self._writers.values():
                writer.close()
            for port in self._ports.values():
                port.close()

    def _accept(self, agent: int, data: bytes) -> list[bytes]:
        self.received[agent] += data
        frames = self.simulation.receive(agent, data, time.monotonic())
        self.sent[agent] += b"".join(frames)
        return frames

    def _udp(self, agent: int) -> Callable[[bytes], tuple[list[bytes], bool]]:
        return lambda data: (self._accept(agent, data), True)

    def _tcp(self, agent: int) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], object]:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self._writers[agent] = writer
            with suppress(ConnectionError):
                while data := await reader.read(4096):
                    writer.write(b"".join(self._accept(agent, data)))

        return serve

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(STEP_S)
            by_agent: dict[int, list[bytes]] = {}
            for agent, frame in self.simulation.advance(time.monotonic()).frames:
                by_agent.setdefault(agent, []).append(frame)
            for agent, frames in by_agent.items():
                self._send(agent, frames)

    def _send(self, agent: int, frames: list[bytes]) -> None:
        if agent in self._ports:
            self.sent[agent] += b"".join(frames)
            self._ports[agent].send(frames)
        elif agent in self._writers and not self._writers[agent].is_closing():
            self.sent[agent] += b"".join(frames)
            self._writers[agent].write(b"".join(frames))


def _report(task: asyncio.Task[None]) -> None:
    """A world that stops by itself says why."""
    if not task.cancelled() and task.exception() is not None:
        traceback.print_exception(task.exception())


async def _main(agent: int, link: str) -> None:
    scenario = grounded_fleet((agent,), seed=agent)
    simulation = Simulation(scenario, time.monotonic(), time.time() - time.monotonic())
    async with LoopbackSitl(simulation).serve({agent: parse_endpoint(link)}):
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(_main(int(sys.argv[1]), sys.argv[2]))
