"""A live fleet on this machine: a simulator and one daemon per drone as processes, watched until they are done."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live

from agent.config.tables import FleetConfig
from agent.exit_codes import ExitCode
from fleetloc.errors import BAD_INPUT, REFUSED, FleetlocError
from fleetloc.run import live_table, live_targets, run_files
from fleetloc.run.fleet_observer import RunObserver
from fleetloc.run.live_truth import LiveTruth
from fleetloc.run.processes import GRACE_S, Child, cpu_time_s, resident_mb, stop_all
from sim_bridge.uwb_modules.terminals import device_path
from sim_bridge.world.sim_table import sim_table
from transport.messages.report_body import Diagnostics

START_TIMEOUT_S = 120.0
"""All daemons have to be there within this, on the slowest machine."""
REFRESH_S, LINE_PERIOD_S, WATCH_S = 0.5, 10.0, 0.1
SIMULATOR_GRACE_S = 5.0
"""After Ctrl-C the simulator has this long to write its truth, a second one kills everything."""
DAEMONS_GRACE_S = 3.0
"""And the daemons so long to end after that."""
PLOTS_WITHIN_S = 6.0
"""So long after Ctrl-C the report may begin to draw a plot."""
LATE_SHARE, SAID_EVERY_S = 0.1, 30.0
"""Ticks late since the last look from which on the machine is said to be overloaded, and how often."""
LAST_TICKS_S = 0.5
"""After the simulator has ended the daemons have this long for the last tick."""
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class RunFailed(FleetlocError):
    """The fleet could not be flown; the message says who failed and why."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


@dataclass(frozen=True, slots=True)
class Death:
    """A process that ended though nobody asked it to; ``at_s`` since the simulator's start."""

    name: str
    at_s: float
    why: str


@dataclass(slots=True)
class Use:
    """What one daemon took from the machine while the simulator flew: CPU s at begin and end, MB at the end."""

    begin_cpu_s: float | None = None
    end_cpu_s: float | None = None
    wall_s: float = 0.0
    rss_mb: float | None = None

    @property
    def cpu_fraction(self) -> float | None:
        """Share of one core."""
        if self.begin_cpu_s is None or self.end_cpu_s is None or self.wall_s <= 0.0:
            return None
        return (self.end_cpu_s - self.begin_cpu_s) / self.wall_s


@dataclass(slots=True)
class RunOutcome:
    """What the files in the run's folder do not tell."""

    wall_s: float = 0.0
    interrupted: bool = False
    plots_until_s: float | None = None
    """Instant of the monotonic clock from which on the report draws no more; ``None``: it draws all."""
    deaths: list[Death] = field(default_factory=list)
    use: dict[int, Use] = field(default_factory=dict)
    lives: dict[int, list[Diagnostics]] = field(default_factory=dict)
    """Last diagnostics of every daemon an agent had, in order."""


class FleetRun:
    """One run. ``out`` is its folder and holds the configuration already (`run_files.CONFIG`)."""

    def __init__(self, config: FleetConfig, out: Path, console: Console) -> None:
        self._config, self._out, self._console = config, out, console
        file = str(out / run_files.CONFIG)
        self._daemons = {
            agent_id: Child(
                f"agent {agent_id}",
                ("agent", file, "--id", str(agent_id)),
                run_files.log_path(out, agent_id),
            )
            for agent_id in config.ids
        }
        self._drivers = _module_drivers(config, out, file)
        self._simulator = Child(
            "simulator",
            ("sim", file, "--out", str(out), "--truth-lines"),
            out / run_files.SIMULATOR_LOG,
            reads_stdout=True,
        )
        self._stop = asyncio.Event()
        self._changed = asyncio.Event()
        self._observer = RunObserver(config, out, self._changed.set)
        self._truth = LiveTruth()
        self._outcome = RunOutcome(use={agent_id: Use() for agent_id in config.ids})
        self._seen_dead: set[str] = set()
        self._flying_since_s: float | None = None
        self._kill_by_s: float | None = None
        """When the simulator is killed if it still runs; ``None``: nobody wants it to end."""
        self._late: dict[int, tuple[int, int]] = {}
        """Ticks and late ticks of each agent when the machine was looked at last."""
        self._look_s = 0.0

    async def fly(self) -> RunOutcome:
        """Start everything, wait for the end of the simulated time or a signal, stop everything.

        Raises `RunFailed` if a process cannot begin or the simulator dies; no child outlives the call.
        """
        with self._signals():
            try:
                for child in (*self._daemons.values(), *self._drivers):
                    await child.start()
                await self._observer.open()
                await self._all_there()
                if not self._stop.is_set():
                    await self._simulate()
            finally:
                await self._close()
        return self._outcome

    @contextmanager
    def _signals(self) -> Iterator[None]:
        loop = asyncio.get_running_loop()
        for number in STOP_SIGNALS:
            loop.add_signal_handler(number, self._interrupt)
        try:
            yield
        finally:
            for number in STOP_SIGNALS:
                loop.remove_signal_handler(number)

    def _interrupt(self) -> None:
        if self._outcome.interrupted:  # a second time: at once
            for child in (self._simulator, *self._drivers, *self._daemons.values()):
                child.kill()
        if self._kill_by_s is None:
            now_s = time.monotonic()
            self._kill_by_s, self._outcome.plots_until_s = now_s + SIMULATOR_GRACE_S, now_s + PLOTS_WITHIN_S
        self._outcome.interrupted = True
        self._stop.set()
        self._changed.set()

    # --- start ----------------------------------------------------------------------------------------------

    async def _all_there(self) -> None:
        """Wait until every daemon has shown itself; raises `RunFailed` for one that ends or never comes."""
        self._say(f"starting {len(self._daemons)} daemons")
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not self._observer.all_there and not self._stop.is_set():
            self._fail_if_refused()
            if time.monotonic() > deadline_s:
                missing = [str(i) for i, observed in self._observer.agents.items() if not observed.alive]
                raise RunFailed(
                    f"agents {', '.join(missing)}: expected on the radio within {START_TIMEOUT_S:g} s, "
                    f"not seen; see the logs in {self._out}",
                    REFUSED,
                )
            await self._change(WATCH_S)

    def _fail_if_refused(self) -> None:
        for daemon in (*self._daemons.values(), *self._drivers):
            process = daemon.process
            if process is not None and process.returncode is not None:
                code = BAD_INPUT if process.returncode == ExitCode.BAD_INPUT else REFUSED
                raise RunFailed(f"{daemon.name} {daemon.why_it_ended()}", code)

    async def _change(self, timeout_s: float) -> None:
        """Until something has changed, or the time is over."""
        self._changed.clear()
        try:
            await asyncio.wait_for(self._changed.wait(), timeout_s)
        except TimeoutError:
            return

    # --- flight ---------------------------------------------------------------------------------------------

    async def _simulate(self) -> None:
        await self._simulator.start()
        reader = asyncio.create_task(self._read_truth())
        shower = asyncio.create_task(self._show())
        try:
            await self._watch()
        finally:
            for task in (reader, shower):
                task.cancel()
            await asyncio.gather(reader, shower, return_exceptions=True)

    async def _read_truth(self) -> None:
        process = self._simulator.process
        assert process is not None
        assert process.stdout is not None
        while line := await process.stdout.readline():
            if self._truth.on_line(line) and self._flying_since_s is None:
                self._begin()

    def _begin(self) -> None:
        """The world moves: from here on the daemons' use of the machine counts."""
        self._flying_since_s = time.monotonic()
        for agent_id, daemon in self._daemons.items():
            self._outcome.use[agent_id].begin_cpu_s = cpu_time_s(daemon.pid) if daemon.running else None

    async def _watch(self) -> None:
        """Until the simulator has ended; daemons that die are noted, the others fly on."""
        while self._simulator.running:
            self._note_deaths()
            self._say_if_overloaded()
            if not any(daemon.running for daemon in self._daemons.values()) and self._kill_by_s is None:
                self._say("no daemon is left; ending the run")
                self._kill_by_s = time.monotonic() + SIMULATOR_GRACE_S
                self._stop.set()
            if self._stop.is_set() and not self._simulator.stopped_by_us:
                self._simulator.terminate()
            if self._kill_by_s is not None and time.monotonic() >= self._kill_by_s:
                self._simulator.kill()
            await self._change(WATCH_S)
        self._note_use()
        self._note_deaths()
        code = await self._simulator.wait()
        if code != 0 and not (self._simulator.stopped_by_us and code < 0):
            exit_code = BAD_INPUT if code == BAD_INPUT else REFUSED
            raise RunFailed(f"simulator {self._simulator.why_it_ended()}", exit_code)
        await asyncio.sleep(LAST_TICKS_S)
        self._outcome.wall_s = time.monotonic() - (self._flying_since_s or time.monotonic())

    def _say_if_overloaded(self) -> None:
        """Once in a while: whose ticks have come late since the last look."""
        if time.monotonic() < self._look_s:
            return
        self._look_s = time.monotonic() + SAID_EVERY_S
        slow = []
        for agent_id, observed in self._observer.agents.items():
            counters = {} if observed.diagnostics is None else observed.diagnostics.counters
            now = counters.get("ticks", 0), counters.get("ticks: late", 0)
            ticks, late = (new - old for new, old in zip(now, self._late.get(agent_id, now), strict=True))
            self._late[agent_id] = now
            if ticks > 0 and late > LATE_SHARE * ticks:
                slow.append(f"agent {agent_id} {100 * late / ticks:.0f} %")
        if slow:
            self._say(f"late ticks: {', '.join(slow)}; is the machine overloaded?")

    def _note_use(self) -> None:
        if self._flying_since_s is None:
            return
        for agent_id, daemon in self._daemons.items():
            use = self._outcome.use[agent_id]
            use.wall_s = time.monotonic() - self._flying_since_s
            if daemon.running:
                use.end_cpu_s, use.rss_mb = cpu_time_s(daemon.pid), resident_mb(daemon.pid)

    def _note_deaths(self) -> None:
        for daemon in (*self._daemons.values(), *self._drivers):
            if daemon.running or daemon.stopped_by_us or daemon.name in self._seen_dead:
                continue
            self._seen_dead.add(daemon.name)
            death = Death(daemon.name, self._flown_s, daemon.why_it_ended())
            self._outcome.deaths.append(death)
            self._say(f"{death.name} {death.why}; the others fly on")

    @property
    def _flown_s(self) -> float:
        return 0.0 if self._flying_since_s is None else time.monotonic() - self._flying_since_s

    # --- picture --------------------------------------------------------------------------------------------

    def _say(self, sentence: str) -> None:
        self._console.print(f"fleetloc: {sentence}", markup=False, highlight=False, soft_wrap=True)

    def _picture(self) -> tuple[str, list[live_table.Row]]:
        ended = {
            agent_id: daemon.why_it_ended().partition(":")[0]
            for agent_id, daemon in self._daemons.items()
            if daemon.name in self._seen_dead
        }
        title = f"{self._config.fleet.name}: {self._flown_s:.0f} of {sim_table(self._config).duration_s:.0f} s"
        return title, live_table.rows(self._config, self._observer, self._truth, ended, time.monotonic())

    def _targets(self) -> list[live_targets.TargetRow]:
        return live_targets.target_rows(self._config, self._observer, self._truth, time.monotonic())

    async def _show(self) -> None:
        if not self._console.is_terminal:
            while True:
                await asyncio.sleep(LINE_PERIOD_S)
                for line in (*live_table.lines(*self._picture()), *live_targets.lines(self._targets())):
                    self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        with Live(console=self._console, auto_refresh=False) as live:
            while True:
                shown = [live_table.table(*self._picture())]
                if self._config.targets:
                    shown.append(live_targets.table(self._targets()))
                live.update(Group(*shown), refresh=True)
                await asyncio.sleep(REFRESH_S)

    # --- end ------------------------------------------------------------------------------------------------

    async def _close(self) -> None:
        for agent_id, observed in self._observer.agents.items():
            last = [] if observed.diagnostics is None else [observed.diagnostics]
            self._outcome.lives[agent_id] = [*observed.ended_lives, *last]
        try:
            await self._observer.close()
        finally:
            grace_s = DAEMONS_GRACE_S if self._outcome.interrupted else GRACE_S
            for name in await stop_all((self._simulator, *self._drivers, *self._daemons.values()), grace_s):
                self._say(f"{name} did not end when asked and was killed; see its log in {self._out}")


def _module_drivers(config: FleetConfig, out: Path, file: str) -> tuple[Child, ...]:
    """A driver process per drone where the simulator plays modules; it waits for its module to be plugged in."""
    kind = sim_table(config).uwb_module
    if kind == "none":
        return ()
    return tuple(
        Child(
            f"uwb driver {agent_id}",
            ("uwb", kind, str(device_path(out, agent_id)), file, "--id", str(agent_id)),
            run_files.uwb_log_path(out, agent_id),
        )
        for agent_id in config.ids
    )
