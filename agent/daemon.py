"""The daemon of one drone: sockets, timers and signals around the agent core; nothing is decided here.

`run` is what ``fleetloc agent`` calls: it opens everything, works until SIGTERM or SIGINT, closes everything
and returns an exit code. Errors of the surroundings come out as one line on stderr.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agent.autopilot import AutopilotSession, LinkState
from agent.clock import FleetClock
from agent.config_tables import FleetConfig
from agent.core import AgentCore, EstimatorFactory
from agent.diagnostics import (
    ProcessUse,
    TickTimes,
    counters_of,
    diagnostics_of,
    gauges_of,
    neighbour_gauges,
)
from agent.endpoints import LinkKind, parse_endpoint
from agent.errors import AgentError, ConfigError, LinkError, NoAutopilotError, RecordError
from agent.exit_codes import ExitCode
from agent.health import State
from agent.mavlink_codec import mavlink
from agent.mavlink_link import create_link
from agent.outputs import EstimateReady, HealthChanged, Output, Send
from agent.radio import Radio
from agent.recording import SUFFIX, EstimateRecorder, RecordHeader, write_summary
from agent.samples import AttitudeSample, GpsSample, ImuSample, Sample
from agent.uwb import UwbAdapter
from agent.warmup import warm_up
from transport.errors import KeyFileError, SessionError, SettingsError
from transport.opening import Received

LOG = logging.getLogger("fleetloc.agent")
MAVLINK_PERIOD_S = 0.05
HOUSEKEEPING_PERIOD_S = 1.0
MAX_FAULT_TRACES = 10
FAULT_LINE_PERIOD_S = 10.0
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
SYSTEM_STATUS = {
    State.INIT: mavlink.MAV_STATE_BOOT,
    State.ALIGNING: mavlink.MAV_STATE_STANDBY,
    State.OK: mavlink.MAV_STATE_ACTIVE,
    State.DEGRADED: mavlink.MAV_STATE_CRITICAL,
    State.FAULT: None,  # a component that is at fault sends no heartbeat
}
EXIT_CODE_OF: tuple[tuple[type[Exception], ExitCode], ...] = (
    (ConfigError, ExitCode.CONFIG),
    (SettingsError, ExitCode.CONFIG),
    (NoAutopilotError, ExitCode.NO_AUTOPILOT),
    (LinkError, ExitCode.LINK),
    (KeyFileError, ExitCode.KEYS),
    (SessionError, ExitCode.SESSION),
    (RecordError, ExitCode.RECORD),
)


def run(config: FleetConfig, agent_id: int, make_estimator: EstimatorFactory, *, base: Path = Path()) -> ExitCode:
    """Run the daemon of one agent until it is told to stop.

    ``base`` is the folder of the configuration file, which the key folder is relative to.
    """
    try:
        if agent_id not in config.ids:
            raise ConfigError("agent", "id", f"one of {', '.join(map(str, config.ids))}", str(agent_id))
        daemon = Daemon(config, agent_id, make_estimator, base)
        warm_up(config, agent_id, make_estimator)
        asyncio.run(daemon.run())
    except KeyboardInterrupt:  # before the loop takes over the signals: nothing is open yet
        return ExitCode.OK
    except (AgentError, KeyFileError, SessionError, SettingsError) as error:
        LOG.error("agent %d: %s", agent_id, error)
        codes = (code for kind, code in EXIT_CODE_OF if isinstance(error, kind))
        return next(codes, ExitCode.FAILURE)
    return ExitCode.OK


class Daemon:
    """One agent with its surroundings; made for one `run`.

    ``core`` and ``radio`` are there to be looked at; a step of the system's clock brings a new core.
    """

    def __init__(self, config: FleetConfig, agent_id: int, make_estimator: EstimatorFactory, base: Path) -> None:
        self._config = config
        self._agent_id = agent_id
        self._make_core: Callable[[], AgentCore] = lambda: AgentCore(config, agent_id, make_estimator)
        self._clock = FleetClock(config.fleet.epoch_unix_s, unix_s=time.time(), host_s=time.monotonic())
        self.core = self._make_core()
        endpoint = parse_endpoint(config.agent(agent_id).mavlink)
        datagrams = endpoint.kind in (LinkKind.UDP_IN, LinkKind.UDP_OUT)
        self._autopilot = AutopilotSession(config, agent_id, datagrams=datagrams)
        self._link = create_link(endpoint, self._on_mavlink)
        self._uwb = UwbAdapter(agent_id, config.ids, config.sensors)
        self.radio = Radio(config, agent_id, base, self._on_received, self._on_uwb, self._on_gone)
        self._ticks = TickTimes()
        self._use = ProcessUse()
        self._recorder = self._open_record()
        self._tick_timer: asyncio.TimerHandle | None = None
        self._computing_s = 0.0
        self._faults = 0
        self._next_fault_line_s = 0.0
        self._stop = asyncio.Event()
        self._failure: AgentError | None = None

    # --- life ----------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Open, work until stopped, close; raises what keeps it from working."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._on_callback_error)
        for number in STOP_SIGNALS:
            loop.add_signal_handler(number, self.stop)
        tasks: list[asyncio.Task[None]] = []
        try:
            await self._link.open()
            LOG.info("agent %d: mavlink %s", self._agent_id, self._link.description)
            await self.radio.open()
            tasks = [
                asyncio.create_task(self._serve_mavlink(), name="mavlink"),
                asyncio.create_task(self._keep_house(), name="housekeeping"),
            ]
            for task in tasks:
                task.add_done_callback(self._on_task_done)
            gc.collect()
            gc.freeze()  # a full collection over all modules would cost a tick
            self._advance()
            await self._stop.wait()
        finally:
            await self._close(tasks)
            for number in STOP_SIGNALS:
                loop.remove_signal_handler(number)
        if self._failure is not None:
            raise self._failure

    def stop(self) -> None:
        """End `run`; what a signal does."""
        self._stop.set()

    def _on_callback_error(self, _loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """A fault of the program in one callback: said loudly (at first), counted, and flown on with."""
        self._faults += 1
        if self._faults <= MAX_FAULT_TRACES:
            LOG.error("agent %d: %s", self._agent_id, context["message"], exc_info=context.get("exception"))

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        if task.cancelled():
            return
        error = task.exception()
        if isinstance(error, AgentError):
            self._failure = error
        elif error is not None:
            LOG.critical("agent %d: %s failed", self._agent_id, task.get_name(), exc_info=error)
            self._failure = AgentError(f"{task.get_name()} failed: {error!r}")
        self._stop.set()

    async def _close(self, tasks: list[asyncio.Task[None]]) -> None:
        if self._tick_timer is not None:
            self._tick_timer.cancel()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)  # their failures are in `_failure` already
        await self.radio.close()
        await self._link.close()
        if self._recorder is not None:
            self._recorder.close()
            write_summary(self._recorder.path.with_suffix(".json"), self.summary())

    # --- MAVLink -------------------------------------------------------------------------------------------

    def _on_mavlink(self, data: bytes) -> bool:
        """Whether the autopilot's system sent it: a stranger's frames must not draw our answers away from it."""
        host_s = time.monotonic()
        self._autopilot.fleet_offset_s = self._clock.offset_s
        before = self._autopilot.heard
        for sample in self._autopilot.receive(data, host_s):
            self._on_sample(sample, self._clock.fleet_s(host_s))
        return self._autopilot.heard > before

    def _on_sample(self, sample: Sample, now_s: float) -> None:
        if isinstance(sample, ImuSample):
            self.core.on_imu(sample, now_s)
        elif isinstance(sample, AttitudeSample):
            self.core.on_attitude(sample, now_s)
        elif isinstance(sample, GpsSample):
            self.core.on_gps(sample, now_s)

    async def _serve_mavlink(self) -> None:
        """Send what is due on the autopilot's link, and say when its state changes."""
        state = LinkState.SEARCHING
        started_s = time.monotonic()
        limit_s = self._config.mavlink.appear_timeout_s
        while True:
            host_s = time.monotonic()
            self._autopilot.system_status = SYSTEM_STATUS[self.core.health.health.state]
            for frame in self._autopilot.to_send(host_s):
                self._link.send(frame)
            if self._autopilot.state is not state:
                state = self._autopilot.state
                LOG.info("agent %d: autopilot %s, %s", self._agent_id, state, self._link.description)
            self.core.autopilot_state = str(state)
            if state is LinkState.SEARCHING and 0 < limit_s < host_s - started_s:
                raise NoAutopilotError(self._searched_in_vain(limit_s))
            await asyncio.sleep(MAVLINK_PERIOD_S)

    def _searched_in_vain(self, limit_s: float) -> str:
        seen = ", ".join(self._autopilot.ignored) or "nothing"
        system = self._config.system_id(self._agent_id)
        flavour = self._config.agent(self._agent_id).autopilot
        return (
            f"mavlink {self._link.description}: expected heartbeats of an autopilot ({flavour}) with system id "
            f"{system} within {limit_s:g} s, found {seen}; check address, baud rate and agents.system_id"
        )

    # --- radio ---------------------------------------------------------------------------------------------

    def _on_received(self, received: Received) -> None:
        self.core.on_packet(received, self._now_s())
        self._advance()

    def _on_uwb(self, payload: bytes, arrived_s: float) -> None:
        now_s = self._clock.fleet_s(arrived_s)
        unix_s = now_s + self._config.fleet.epoch_unix_s
        for sample in self._uwb.receive(payload, now_s=now_s, host_s=arrived_s, unix_s=unix_s):
            self.core.on_range(sample, now_s)

    def _on_gone(self, agent_id: int) -> None:
        self.core.on_gone(agent_id)
        self._advance()

    # --- the core ------------------------------------------------------------------------------------------

    def _now_s(self) -> float:
        return self._clock.fleet_s(time.monotonic())

    def _advance(self) -> None:
        """Let the core do what is due, put out what it gives, and come back when it wants to."""
        if self._stop.is_set():
            return
        if self._tick_timer is not None:
            self._tick_timer.cancel()
        # Should the core fail, the loop reports it and the next period tries again.
        retry_s = self._now_s() + self._config.fleet.period_s
        due_s: float | None = retry_s
        began_s = time.perf_counter()
        try:
            outputs = self.core.advance(self._now_s())
            for output in outputs:
                if isinstance(output, Send):
                    self.radio.send(output.message)
            self._computing_s += time.perf_counter() - began_s
            self._report(outputs)
            due_s = self.core.next_due_s()
        finally:
            loop = asyncio.get_running_loop()
            self._tick_timer = loop.call_at((due_s or retry_s) - self._clock.offset_s, self._advance)

    def _report(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, EstimateReady):
                published_s = self._now_s()
                period_s = self._config.fleet.period_s
                self._ticks.add(self._computing_s, published_s - output.t_s - period_s)
                if self._recorder is not None:
                    self._recorder.write(output, published_s, self._computing_s)
                self._computing_s = 0.0
            elif isinstance(output, HealthChanged):
                LOG.info("agent %d: %s", self._agent_id, output.health)
        self._report_fault()

    def _report_fault(self) -> None:
        """Say what the estimator raised, once in a while; every fault is counted."""
        fault, self.core.last_fault = self.core.last_fault, None
        host_s = time.monotonic()
        if fault is not None and host_s >= self._next_fault_line_s:
            self._next_fault_line_s = host_s + FAULT_LINE_PERIOD_S
            LOG.error("agent %d: estimator fault, starting it anew: %r", self._agent_id, fault)

    # --- once a second -------------------------------------------------------------------------------------

    async def _keep_house(self) -> None:
        while True:
            await asyncio.sleep(HOUSEKEEPING_PERIOD_S)
            if self._clock.sync(unix_s=time.time(), host_s=time.monotonic()):
                LOG.warning("agent %d: the system's clock stepped; starting anew", self._agent_id)
                self.core = self._make_core()
                self._advance()
            now_s = self._now_s()
            self.radio.expire(time.monotonic())
            counters, gauges, neighbours = self._state(now_s)
            self.radio.send(diagnostics_of(self._agent_id, self.core, counters, gauges, neighbours))
            await self.radio.ask_clocks()

    def _state(self, now_s: float) -> tuple[dict[str, int], dict[str, float], dict[str, dict[str, float]]]:
        opener = self.radio.opener
        counters = counters_of(self.core, self._autopilot, self._link, self._uwb, opener)
        counters |= self.radio.counters() | {"program faults": self._faults}
        gauges = gauges_of(self.core, self._autopilot, now_s)
        gauges |= self._ticks.gauges() | self._use.gauges()
        return counters, gauges, neighbour_gauges(opener, self.core, time.monotonic(), now_s)

    def summary(self) -> dict[str, object]:
        """What is written beside the record at the end."""
        counters, gauges, neighbours = self._state(self._now_s())
        health = self.core.health.health
        return {
            "agent": self._agent_id,
            "state": str(health.state),
            "reasons": list(health.reasons),
            "counters": counters,
            "gauges": gauges,
            "neighbours": neighbours,
        }

    def _open_record(self) -> EstimateRecorder | None:
        settings = self._config.record
        if settings.directory is None:
            return None
        header = RecordHeader(
            fleet=self._config.fleet.name,
            agent=self._agent_id,
            agents=self._config.ids,
            period_s=self._config.fleet.period_s,
            epoch_unix_s=self._config.fleet.epoch_unix_s,
        )
        path = Path(settings.directory) / f"agent_{self._agent_id:03d}{SUFFIX}"
        return EstimateRecorder(path, header, int(settings.max_mb * 1e6))
