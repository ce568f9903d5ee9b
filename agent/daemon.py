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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from agent.config.endpoints import parse_endpoint
from agent.config.tables import FleetConfig
from agent.core import ESTIMATOR_FAULTS, AgentCore, EstimatorFactory
from agent.errors import AgentError, ConfigError, LinkError, NoAutopilotError, RecordError
from agent.exit_codes import ExitCode
from agent.log.run_record import RunRecord
from agent.mavlink.link import create_link
from agent.mavlink.session import LinkState
from agent.mavlink.signing_stamps import StampKeeper
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady, HealthChanged, Output, Send
from agent.radio.radio import Radio
from agent.radio.security import mavlink_signing, stamp_file
from agent.warmup import warm_up
from agent.watch.diagnostics import (
    ProcessUse,
    TickTimes,
    counters_of,
    diagnostics_of,
    gauges_of,
    neighbour_gauges,
)
from agent.watch.faults import ProgramFaults
from agent.watch.observers import DaemonState, Observer
from transport.errors import KeyFileError, SessionError, SettingsError, UnwritableError

LOG = logging.getLogger("fleetloc.agent")
MAVLINK_PERIOD_S = 0.05
HOUSEKEEPING_PERIOD_S = 1.0
RENEW_PERIOD_S = 10.0
"""While the autopilot is lost, a link that is a connection is dialled anew this often: the other end may be gone."""
FAULT_LINE_PERIOD_S = 10.0
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
EXIT_CODE_OF: tuple[tuple[type[Exception], ExitCode], ...] = (
    (ConfigError, ExitCode.CONFIG),
    (SettingsError, ExitCode.CONFIG),
    (NoAutopilotError, ExitCode.NO_AUTOPILOT),
    (LinkError, ExitCode.LINK),
    (UnwritableError, ExitCode.STATE),
    (KeyFileError, ExitCode.KEYS),
    (SessionError, ExitCode.SESSION),
    (RecordError, ExitCode.RECORD),
)


def run(
    config: FleetConfig,
    agent_id: int,
    make_estimator: EstimatorFactory,
    *,
    base: Path = Path(),
    observers: Sequence[Observer] = (),
) -> ExitCode:
    """Run the daemon of one agent until it is told to stop.

    ``base`` is the folder of the configuration file, which the key folder is relative to; ``observers`` are told
    of every estimate, and of the state once a second.
    """
    try:
        if agent_id not in config.ids:
            raise ConfigError("agent", "id", f"one of {', '.join(map(str, config.ids))}", str(agent_id))
        daemon = Daemon(config, agent_id, make_estimator, base, observers)
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

    ``onboard`` (the agent itself) and ``radio`` are there to be looked at.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        make_estimator: EstimatorFactory,
        base: Path,
        observers: Sequence[Observer] = (),
    ) -> None:
        self._config = config
        self._agent_id = agent_id
        self._link = create_link(parse_endpoint(config.agent(agent_id).mavlink), self._on_mavlink)
        self.radio = Radio(config, agent_id, base, self._on_packet, self._on_uwb, self._on_gone)
        unix_s, host_s = time.time(), time.monotonic()
        trust = self.radio.trust
        signing = mavlink_signing(config, agent_id, base, unix_s=unix_s)
        self.onboard = OnboardAgent(
            config, agent_id, make_estimator, trust, unix_s=unix_s, host_s=host_s, signing=signing
        )
        self._record: RunRecord | None = None
        if config.record.directory is not None:
            directory = Path(config.record.directory)
            self._record = RunRecord(config, agent_id, directory, trust, unix_s=unix_s, host_s=host_s)
            self.onboard.journal = self._record.flight
        self._observers = tuple(observers)
        if signing is not None:
            self._observers += (StampKeeper(signing, stamp_file(config, agent_id, base)),)
        self._ticks = TickTimes()
        self._use = ProcessUse()
        self._tick_timer: asyncio.TimerHandle | None = None
        self._computing_s = 0.0
        self._faults = ProgramFaults(agent_id)
        self._left_out = 0
        self._next_fault_line_s = 0.0
        self._stop = asyncio.Event()
        self._failure: AgentError | None = None

    @property
    def core(self) -> AgentCore:
        """The agent's core; a step of the system's clock brings a new one."""
        return self.onboard.core

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
            for observer in self._observers:
                await observer.open()
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
        """A fault of the program in one callback: counted, and flown on with."""
        self._faults.note(context["message"], context.get("exception"))

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
        with self._faults.survived("closing the radio"):  # whatever fails here, the record gets its end
            await self.radio.close()
        with self._faults.survived("closing the autopilot's link"):
            await self._link.close()
        state = self._last_state()
        last: list[Observer] = [] if self._record is None else [self._record]
        ends = [observer.close(state) for observer in (*self._observers, *last)]
        for error in await asyncio.gather(*ends, return_exceptions=True):
            if isinstance(error, AgentError):
                self._failure = self._failure or error
            elif error is not None:
                LOG.error("agent %d: an observer failed to close", self._agent_id, exc_info=error)

    def _last_state(self) -> DaemonState:
        with self._faults.survived("taking stock"):
            return self.state()
        counters = {"program faults": self._faults.count}
        return DaemonState(self._agent_id, 0.0, self.core.health.health, counters, {}, {})

    # --- MAVLink -------------------------------------------------------------------------------------------

    def _on_mavlink(self, data: bytes) -> bool:
        with self._faults.survived("reading the autopilot's link"):
            return self.onboard.on_mavlink(data, time.monotonic())
        return False

    async def _serve_mavlink(self) -> None:
        """Send what is due on the autopilot's link, and say when its state changes."""
        state = LinkState.SEARCHING
        started_s = time.monotonic()
        changed_s = renew_s = started_s
        limit_s, end_after_s = self._config.mavlink.appear_timeout_s, self._config.mavlink.end_after_lost_s
        while True:
            host_s = time.monotonic()
            with self._faults.survived("serving the autopilot"):
                for frame in self.onboard.serve_autopilot(host_s):
                    self._link.send(frame)
            if self.onboard.autopilot.state is not state:
                state, changed_s = self.onboard.autopilot.state, host_s
                if state is LinkState.CONNECTED:
                    self.radio.begin_flight(host_s)
                LOG.info("agent %d: autopilot %s, %s", self._agent_id, state, self._link.description)
            if state is LinkState.LOST and host_s >= renew_s:
                renew_s = host_s + RENEW_PERIOD_S
                self._link.renew()
            if state is LinkState.SEARCHING and 0 < limit_s < host_s - started_s:
                raise NoAutopilotError(self._searched_in_vain(limit_s))
            if state is LinkState.LOST and end_after_s is not None and host_s - changed_s > end_after_s:
                LOG.info("agent %d: autopilot lost for %g s: end, as configured", self._agent_id, end_after_s)
                self.stop()
                return
            await asyncio.sleep(MAVLINK_PERIOD_S)

    def _searched_in_vain(self, limit_s: float) -> str:
        seen = ", ".join(self.onboard.autopilot.ignored) or "nothing"
        system = self._config.system_id(self._agent_id)
        flavour = self._config.agent(self._agent_id).autopilot
        return (
            f"mavlink {self._link.description}: expected heartbeats of an autopilot ({flavour}) with system id "
            f"{system} within {limit_s:g} s, found {seen}; check address, baud rate and agents.system_id"
        )

    # --- radio ---------------------------------------------------------------------------------------------

    def _on_packet(self, key: str, data: bytes, arrived_s: float, unix_ns: int) -> None:
        with self._faults.survived("taking a packet"):
            self.onboard.on_packet(key, data, arrived_s=arrived_s, host_s=time.monotonic(), unix_ns=unix_ns)
        self._advance()

    def _on_uwb(self, payload: bytes, arrived_s: float) -> None:
        with self._faults.survived("taking a range"):
            self.onboard.on_uwb(payload, arrived_s)

    def _on_gone(self, agent_id: int) -> None:
        with self._faults.survived("letting a neighbour go"):
            self.onboard.on_gone(agent_id, time.monotonic())
        self._advance()

    # --- the core ------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Let the core do what is due, put out what it gives, and come back when it wants to.

        Raises nothing, for it is called from the midst of other things; should the core fail, the next period tries
        again.
        """
        if self._stop.is_set():
            return
        if self._tick_timer is not None:
            self._tick_timer.cancel()
        host_s = time.monotonic()
        due_host_s = retry_host_s = host_s + self._config.fleet.period_s
        began_s = time.perf_counter()
        with self._faults.survived("the tick"):
            outputs = self.onboard.advance(host_s)
            for output in outputs:
                if isinstance(output, Send):
                    self.radio.send(output.message)
            self._computing_s += time.perf_counter() - began_s
            self._report(outputs)
            due_host_s = self.onboard.next_due_host_s() or retry_host_s
        self._tick_timer = asyncio.get_running_loop().call_at(due_host_s, self._advance)

    def _report(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, EstimateReady):
                published_s = self.onboard.fleet_s(time.monotonic())
                self._ticks.add(self._computing_s, published_s - output.t_s - self._config.fleet.period_s)
                tick_time_s, self._computing_s = self._computing_s, 0.0
                if self._record is not None:  # at once: it says how many inputs the estimate had
                    self._record.on_estimate(output, published_s, tick_time_s)
                for observer in self._observers:
                    self._tell(observer.on_estimate, output, published_s, tick_time_s)
            elif isinstance(output, HealthChanged):
                LOG.info("agent %d: %s", self._agent_id, output.health)
        self._report_fault()

    def _tell(self, listener: Callable[..., None], *what: object) -> None:
        """Each in a callback of its own: one that fails is reported by the loop and stops no other."""
        asyncio.get_running_loop().call_soon(listener, *what)

    def _report_fault(self) -> None:
        """Say what the estimator raised, once in a while; every fault is counted."""
        fault, self.core.last_fault = self.core.last_fault, None
        host_s = time.monotonic()
        if fault is not None and not isinstance(fault, ESTIMATOR_FAULTS):
            self._faults.note("a step of the tick failed; its estimate is made of the last one", fault)
        elif fault is not None and host_s >= self._next_fault_line_s:
            self._next_fault_line_s = host_s + FAULT_LINE_PERIOD_S
            LOG.error("agent %d: estimator fault, starting it anew: %r", self._agent_id, fault)

    # --- once a second -------------------------------------------------------------------------------------

    async def _keep_house(self) -> None:
        while True:
            await asyncio.sleep(HOUSEKEEPING_PERIOD_S)
            with self._faults.survived("keeping house"):
                if self.onboard.keep_house(unix_s=time.time(), host_s=time.monotonic()):
                    LOG.warning("agent %d: the system's clock stepped; starting anew", self._agent_id)
                    self._advance()
            with self._faults.survived("telling the state"):
                self._tell_state()
            with self._faults.survived("asking for clocks"):
                await self.radio.ask_clocks()

    def _tell_state(self) -> None:
        state = self.state()
        for observer in self._observers:
            self._tell(observer.on_second, state)
        if self._record is not None:
            self._record.on_second(state)
        message = diagnostics_of(self._agent_id, self.core, state.counters, state.gauges, state.neighbours)
        self._left_out += len(state.neighbours) - len(message.neighbours)
        self.radio.send(message)

    def state(self) -> DaemonState:
        """How the daemon is at this moment."""
        onboard, host_s = self.onboard, time.monotonic()
        now_s = onboard.fleet_s(host_s)
        counters = counters_of(self.core, onboard.autopilot, self._link, onboard.uwb, onboard.opener)
        counters |= self.radio.counters() | {"program faults": self._faults.count}
        counters["diagnostics left out"] = self._left_out
        if self._record is not None:
            counters |= self._record.counters()
        gauges = gauges_of(self.core, onboard.autopilot, now_s) | self._ticks.gauges() | self._use.gauges()
        neighbours = neighbour_gauges(onboard.opener, self.core, host_s, now_s)
        return DaemonState(self._agent_id, now_s, self.core.health.health, counters, gauges, neighbours)
