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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agent.config.endpoints import parse_endpoint
from agent.config.tables import FleetConfig
from agent.core import AgentCore, EstimatorFactory
from agent.errors import AgentError, ConfigError, LinkError, LogFileError, NoAutopilotError
from agent.exit_codes import ExitCode
from agent.log.run_logs import RunLogs
from agent.mavlink.link import create_link
from agent.mavlink.session import LinkState
from agent.mavlink.signing_stamps import StampKeeper
from agent.mavlink.slow_streams import SlowStreamLog
from agent.onboard import OnboardAgent
from agent.outputs import (
    ClockStepped,
    EstimateReady,
    Faulted,
    HealthChanged,
    LinkChanged,
    NotSent,
    Output,
    Send,
    ToAutopilot,
)
from agent.radio.earlier_packets import EarlierPackets
from agent.radio.radio import Listener, Radio
from agent.radio.security import mavlink_signing, seen_file, stamp_file
from agent.warmup import warm_up
from agent.watch.diagnostics import (
    ProcessUse,
    TickTimes,
    counters_of,
    diagnostics_of,
    gauges_of,
    neighbour_gauges,
    target_states,
)
from agent.watch.faults import ProgramFaults
from agent.watch.log_lines import level_of
from agent.watch.observers import DaemonState, Observer
from estimators.integrity.finding import Finding, Gravity, What
from transport.errors import KeyFileError, SessionError, SettingsError, UnwritableError

LOG = logging.getLogger("fleetloc.agent")
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
EXIT_CODE_OF: tuple[tuple[type[Exception], ExitCode], ...] = (
    (ConfigError, ExitCode.BAD_INPUT),
    (SettingsError, ExitCode.BAD_INPUT),
    (NoAutopilotError, ExitCode.NO_AUTOPILOT),
    (LinkError, ExitCode.LINK),
    (UnwritableError, ExitCode.STATE),
    (KeyFileError, ExitCode.KEYS),
    (SessionError, ExitCode.SESSION),
    (LogFileError, ExitCode.RECORD),
)


@dataclass(frozen=True, slots=True)
class Periods:
    """How often the daemon does what no packet and no tick asks for, in s."""

    housekeeping_s: float = 1.0
    renew_link_s: float = 10.0
    """While the autopilot is lost, a connection is dialled anew this often: its other end may be gone."""
    fault_line_s: float = 10.0
    """Between lines about faults of the estimator; every one is counted."""


def run(
    config: FleetConfig,
    agent_id: int,
    make_estimator: EstimatorFactory,
    *,
    base: Path = Path(),
    observers: Sequence[Observer] = (),
    unrecorded: str = "",
) -> ExitCode:
    """Run the daemon of one agent until it is told to stop.

    ``base`` is the folder of the configuration file, which the key folder is relative to; ``observers`` are told
    of every estimate, and of the state once a second. ``unrecorded`` says why there is to be no record, although the
    configuration wants one; the health says so then.
    """
    try:
        if agent_id not in config.ids:
            raise ConfigError("--id", "", f"one of {', '.join(map(str, config.ids))}", str(agent_id))
        daemon = Daemon(config, agent_id, make_estimator, base, observers, unrecorded=unrecorded)
        warm_up(config, agent_id, make_estimator)
        asyncio.run(daemon.run())
    except KeyboardInterrupt:  # before the loop takes over the signals: nothing is open yet
        return ExitCode.OK
    except (AgentError, KeyFileError, SessionError, SettingsError) as error:
        LOG.error("agent %d: %s", agent_id, error)
        codes = (code for kind, code in EXIT_CODE_OF if isinstance(error, kind))
        return next(codes, ExitCode.FAILURE)
    return ExitCode.OK


@dataclass(slots=True)
class LinkWatch:
    """Since when the autopilot's link is in which state, and when it is to be dialled anew."""

    since_s: float
    state: LinkState = LinkState.SEARCHING
    renew_s: float = 0.0


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
        periods: Periods | None = None,
        unrecorded: str = "",
    ) -> None:
        """``unrecorded``: why there is to be no record, although the configuration wants one."""
        self._config = config
        self._agent_id = agent_id
        self._periods = periods or Periods()
        self._link = create_link(parse_endpoint(config.agent(agent_id).mavlink), self._on_mavlink)
        listener = Listener(
            self._on_packet, self._on_uwb, self._on_gone, self._on_clock_question, self._last_heard_s
        )
        self.radio = Radio(config, agent_id, base, listener)
        identity = self.radio.identity
        unix_s, host_s = time.time(), time.monotonic()
        signing = mavlink_signing(config, agent_id, base, unix_s=unix_s)
        self._record: RunLogs | None = None
        self._unrecorded = unrecorded
        if config.record.directory is not None and not unrecorded:
            directory = Path(config.record.directory)
            try:
                self._record = RunLogs(config, agent_id, directory, identity.trust, unix_s=unix_s, host_s=host_s)
            except LogFileError as error:  # a full disk grounds no drone
                self._unrecorded = str(error)
        if self._unrecorded:
            LOG.error("agent %d: %s; flying without a record", agent_id, self._unrecorded)
        self.onboard = OnboardAgent(
            config,
            agent_id,
            make_estimator,
            identity,
            unix_s=unix_s,
            host_s=host_s,
            link_signing=signing,
            journal=None if self._record is None else self._record.flight,
        )
        self._observers = tuple(observers)
        self._earlier: EarlierPackets | None = None
        seen = seen_file(config, agent_id, base)
        if seen is not None:
            self._earlier = EarlierPackets(seen, config.fleet.name, lambda: self.onboard.opener.replay.state)
            self._observers += (self._earlier,)
        if signing is not None:
            self._observers += (StampKeeper(signing, stamp_file(config, agent_id, base)),)
        self._ticks = TickTimes()
        self._use = ProcessUse()
        self._tick_timer: asyncio.TimerHandle | None = None
        self._computing_s = 0.0
        self._faults = ProgramFaults(agent_id)
        self._left_out = 0
        self._next_fault_line_s = 0.0
        self._link_watch = LinkWatch(time.monotonic())
        self._slow_streams = SlowStreamLog()
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
        task: asyncio.Task[None] | None = None
        try:
            await self._link.open()
            LOG.info("agent %d: mavlink %s", self._agent_id, self._link.description)
            await self.radio.open()
            for observer in self._observers:
                await observer.open()
            task = asyncio.create_task(self._keep_house(), name="housekeeping")
            task.add_done_callback(self._on_task_done)
            gc.collect()
            gc.freeze()  # a full collection over all modules would cost a tick
            self._link_watch = LinkWatch(time.monotonic())
            self._advance()
            await self._stop.wait()
        finally:
            await self._close(task)
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

    async def _close(self, task: asyncio.Task[None] | None) -> None:
        if self._tick_timer is not None:
            self._tick_timer.cancel()
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)  # its failure is in `_failure` already
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

    def _look_at_link(self, host_s: float) -> None:
        """End or dial anew where the autopilot is away for long; raises `NoAutopilotError`."""
        watch, mavlink = self._link_watch, self._config.mavlink
        limit_s, end_after_s = mavlink.appear_timeout_s, mavlink.end_after_lost_s
        away_s = host_s - watch.since_s
        if watch.state is LinkState.SEARCHING and 0 < limit_s < away_s:
            raise NoAutopilotError(self._searched_in_vain(limit_s))
        if watch.state is not LinkState.LOST:
            return
        if host_s >= watch.renew_s:
            watch.renew_s = host_s + self._periods.renew_link_s
            self._link.renew()
        if end_after_s is not None and away_s > end_after_s:
            LOG.info("agent %d: autopilot lost for %g s: end, as configured", self._agent_id, end_after_s)
            self.stop()

    def _searched_in_vain(self, limit_s: float) -> str:
        autopilot = self.onboard.autopilot
        systems = [f"system {each}" for each in sorted(autopilot.other_systems)]
        seen = ", ".join([*systems, *autopilot.ignored]) or "nothing"
        system = self._config.system_id(self._agent_id)
        flavour = self._config.agent(self._agent_id).autopilot
        return (
            f"mavlink {self._link.description}: expected heartbeats of an autopilot ({flavour}) with system id "
            f"{system} within {limit_s:g} s, found {seen}; check address, baud rate and agents.system_id"
        )

    # --- radio ---------------------------------------------------------------------------------------------

    def _on_packet(self, key: str, data: bytes, arrived_s: float, unix_ns: int) -> None:
        if self._earlier is not None and self._earlier.has(data):
            return
        with self._faults.survived("taking a packet"):
            self.onboard.on_packet(key, data, arrived_s=arrived_s, host_s=time.monotonic(), unix_ns=unix_ns)
        self._advance()

    def _on_uwb(self, payload: bytes, arrived_s: float) -> None:
        with self._faults.survived("taking a range"):
            self.onboard.on_uwb(payload, arrived_s)

    def _on_clock_question(self, question: bytes, arrived_ns: int) -> bytes | None:
        return self.onboard.answer_clock(question, arrived_ns=arrived_ns, now_ns=time.time_ns())

    def _last_heard_s(self, agent_id: int) -> float | None:
        return self.onboard.opener.peers[agent_id].last_received_s

    def _on_gone(self, agent_id: int) -> None:
        with self._faults.survived("letting a neighbour go"):
            self.onboard.on_gone(agent_id, time.monotonic())
        self._advance()

    # --- the agent -----------------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Let the agent do what is due, carry out what it gives, and come back when it wants to.

        Raises nothing, for it is called from the midst of other things; should the agent fail, the next period tries
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
            self._computing_s += time.perf_counter() - began_s
            self._carry_out(outputs)
            due_host_s = self.onboard.next_due_host_s()
        if due_host_s <= host_s:  # what failed is not tried again at once
            due_host_s = retry_host_s
        self._tick_timer = asyncio.get_running_loop().call_at(due_host_s, self._advance)

    def _carry_out(self, outputs: Sequence[Output]) -> None:
        """Everything that the agent wants done is done here."""
        for output in outputs:
            match output:
                case Send():
                    self.radio.send(output.packets)
                case ToAutopilot():
                    for frame in output.frames:
                        self._link.send(frame)
                case EstimateReady():
                    self._on_estimate(output)
                case HealthChanged():
                    LOG.log(level_of(output.health), "agent %d: %s", self._agent_id, output.health)
                case LinkChanged():
                    self._on_link_changed(output.state)
                case Faulted():
                    self._on_fault(output)
                case NotSent():
                    first = self.onboard.unsent[type(output.message).__name__] == 1
                    LOG.log(
                        logging.WARNING if first else logging.DEBUG,
                        "agent %d: not sent: %s",
                        self._agent_id,
                        output.error,
                    )
                case ClockStepped():
                    LOG.warning("agent %d: the system's clock stepped; starting anew", self._agent_id)

    def _on_estimate(self, ready: EstimateReady) -> None:
        published_s = self.onboard.fleet_s(time.monotonic())
        self._ticks.add(self._computing_s, published_s - ready.t_s - self._config.fleet.period_s)
        tick_time_s, self._computing_s = self._computing_s, 0.0
        if self._record is not None:  # at once: it says how many inputs the estimate had
            self._record.on_estimate(ready, published_s, tick_time_s)
        for observer in self._observers:
            self._tell(observer.on_estimate, ready, published_s, tick_time_s)

    def _on_link_changed(self, state: LinkState) -> None:
        host_s = time.monotonic()
        self._link_watch = LinkWatch(host_s, state, renew_s=host_s)
        if state is LinkState.CONNECTED:
            self.radio.begin_flight(host_s)
        LOG.info("agent %d: autopilot %s, %s", self._agent_id, state, self._link.description)

    def _on_fault(self, fault: Faulted) -> None:
        """Say what failed, of the estimator's faults one once in a while."""
        host_s = time.monotonic()
        if not fault.of_estimator:
            self._faults.note("a step of the tick failed; its estimate is made of the last one", fault.error)
        elif host_s >= self._next_fault_line_s:
            self._next_fault_line_s = host_s + self._periods.fault_line_s
            LOG.error("agent %d: estimator fault, starting it anew: %r", self._agent_id, fault.error)

    def _tell(self, listener: Callable[..., None], *what: object) -> None:
        """Each in a callback of its own: one that fails is reported by the loop and stops no other."""
        asyncio.get_running_loop().call_soon(listener, *what)

    # --- once a second -------------------------------------------------------------------------------------

    async def _keep_house(self) -> None:
        while True:
            await asyncio.sleep(self._periods.housekeeping_s)
            self._look_at_link(time.monotonic())
            with self._faults.survived("keeping house"):
                self.onboard.hold(self._found())
                self._carry_out(self.onboard.keep_house(unix_s=time.time(), host_s=time.monotonic()))
                self._advance()
            with self._faults.survived("looking at the streams"):
                self._tell_slow_streams()
            with self._faults.survived("telling the state"):
                self._tell_state()
            with self._faults.survived("asking for clocks"):
                await self.radio.ask_clocks()

    def _tell_slow_streams(self) -> None:
        for line in self._slow_streams.lines(self.onboard.autopilot.slow_streams(), time.monotonic()):
            LOG.warning("agent %d: %s", self._agent_id, line)

    def _found(self) -> tuple[Finding, ...]:
        """What is wrong with the daemon itself."""
        trouble = self._unrecorded or ("" if self._record is None else self._record.trouble)
        return (Finding(What.NOT_RECORDED, Gravity.DEGRADED, detail=trouble),) if trouble else ()

    def _tell_state(self) -> None:
        state = self.state()
        for observer in self._observers:
            self._tell(observer.on_second, state)
        if self._record is not None:
            self._record.on_second(state)
        stated = str(self.core.integrity.statement or "")
        message = diagnostics_of(
            self._agent_id, state.health, state.counters, state.gauges, state.neighbours, stated, state.targets
        )
        self._left_out += len(state.neighbours) - len(message.neighbours)
        self._carry_out(self.onboard.tell(message, time.monotonic()))

    def state(self) -> DaemonState:
        """How the daemon is at this moment."""
        onboard, host_s = self.onboard, time.monotonic()
        now_s = onboard.fleet_s(host_s)
        counters = counters_of(onboard) | self._link.counters()
        radio = self.radio.counters()
        counters["packets unsent"] += radio.pop("packets unsent")
        counters |= radio | {"program faults": self._faults.count}
        counters["diagnostics left out"] = self._left_out
        if self._earlier is not None and self._earlier.refused:
            counters["rejected seen before the start"] = self._earlier.refused
        if self._record is not None:
            counters |= self._record.counters()
        gauges = gauges_of(onboard, now_s) | self._ticks.gauges() | self._use.gauges()
        neighbours = neighbour_gauges(onboard, host_s, now_s)
        health, targets = self.core.health.health, target_states(onboard)
        return DaemonState(self._agent_id, now_s, health, counters, gauges, neighbours, targets)
