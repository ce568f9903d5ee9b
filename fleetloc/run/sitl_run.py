"""A fleet on simulated autopilots: the bridge, one daemon per drone and, where asked, the mission as processes."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import msgspec
from rich.console import Console

from agent.config.tables import FleetConfig
from fleetloc.errors import BAD_INPUT, REFUSED
from fleetloc.run import live_table, run_files
from fleetloc.run.fleet_run import WATCH_S, Death, FleetRun, RunFailed, RunOutcome
from fleetloc.run.processes import Child, stop_all
from fleetloc.run.sitl_lines import ProgressLine, read_progress
from sim_bridge.sitl.mission import load_mission
from sim_bridge.sitl.sitl_table import sitl_table

MISSION_LOG = "mission.log"
AFTER_LANDING_S = 2.0
BEGIN_TIMEOUT_S = 30.0
"""From all daemons' presence to the first truth of the run."""


class SitlRun(FleetRun):
    """One run. It ends after ``duration_s``, or with the mission if that is absent, or on a signal."""

    def __init__(self, config: FleetConfig, out: Path, console: Console, duration_s: float | None) -> None:
        super().__init__(config, out, console)
        file = str(out / run_files.CONFIG)
        self._duration_s = duration_s
        self._simulator = Child(
            "bridge", ("sitl-bridge", file, "--out", str(out)), out / run_files.SIMULATOR_LOG, reads_stdout=True
        )
        self._mission: Child | None = None
        self._mission_limit_s = 0.0
        mission = sitl_table(config).mission
        if mission is not None:
            self._mission = Child("mission", ("sitl-mission", file), out / MISSION_LOG, reads_stdout=True)
            self._mission_limit_s = load_mission(Path(mission), config).limit_s
        self._ready = False
        self._failure: RunFailed | None = None
        self.mission_failure: str | None = None
        """Why the mission was broken off."""
        self.lost_simulators = False
        """A simulator went silent, which ended the run."""

    @property
    def outcome(self) -> RunOutcome:
        """What the files in the run's folder do not tell."""
        return self._outcome

    async def fly(self) -> RunOutcome:
        """Start the bridge, wait for the simulators, start the daemons, fly, stop everything.

        Raises `RunFailed` for a simulator that does not come and for a process that cannot begin; no child outlives
        the call.
        """
        tasks: list[asyncio.Task[None]] = []
        with self._signals():
            try:
                await self._simulator.start()
                tasks.append(asyncio.create_task(self._read_truth()))
                await self._simulators_there()
                if not self._stop.is_set():
                    for daemon in self._daemons.values():
                        await daemon.start()
                    await self._observer.open()
                    await self._all_there()
                if not self._stop.is_set():
                    tasks += [asyncio.create_task(self._show()), asyncio.create_task(self._direct())]
                    await self._watch()
                    self._note_lost()
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
                await self._close()
        if self._failure is not None:
            raise self._failure
        return self._outcome

    async def _simulators_there(self) -> None:
        while not self._ready and not self._stop.is_set():
            self._fail_if_bridge_ended()
            await self._change(WATCH_S)

    def _fail_if_bridge_ended(self) -> None:
        process = self._simulator.process
        if process is not None and process.returncode is not None:
            code = BAD_INPUT if process.returncode == BAD_INPUT else REFUSED
            words = self._simulator.last_lines() or [self._simulator.why_it_ended()]
            raise RunFailed(words[-1].removeprefix("fleetloc: error: "), code)

    async def _read_truth(self) -> None:
        """The bridge's lines: its progress, then the truth."""
        process = self._simulator.process
        assert process is not None
        assert process.stdout is not None
        while line := await process.stdout.readline():
            progress = read_progress(line)
            if progress is not None:
                self._note(progress)
            elif self._truth.on_line(line) and self._flying_since_s is None:
                self._begin()
                self._changed.set()

    def _note(self, progress: ProgressLine) -> None:
        for line in progress.missing:
            self._say(f"waiting for {line}")
        if progress.ready and not self._ready:
            self._ready = True
            self._say(f"all {len(self._daemons)} simulators are there")
        self._changed.set()

    def _note_lost(self) -> None:
        """Simulators that fell silent are in the bridge's report; the run ended with the first of them."""
        file = self._out / run_files.SIMULATOR_JSON
        if not file.exists():
            return
        for line in msgspec.json.decode(file.read_bytes())["lost"]:
            self.lost_simulators = True
            self._outcome.deaths.append(Death("simulator", self._flown_s, line))
            self._say(line)

    # --- flight ---------------------------------------------------------------------------------------------

    async def _direct(self) -> None:
        """Fly the mission if there is one, and end the run when it is time."""
        begin_by_s = time.monotonic() + BEGIN_TIMEOUT_S
        while self._flying_since_s is None:
            if time.monotonic() > begin_by_s:
                limit = f"within {BEGIN_TIMEOUT_S:g} s"
                self._failure = RunFailed(f"bridge: expected frames of all daemons {limit}; see {self._out}", REFUSED)
                break
            await asyncio.sleep(WATCH_S)
        else:
            await self._fly_and_wait()
        self._stop.set()
        self._changed.set()

    async def _fly_and_wait(self) -> None:
        left_s = float("inf") if self._duration_s is None else self._duration_s
        mission = None if self._mission is None else asyncio.create_task(self._fly_mission(self._mission))
        try:
            if self._duration_s is None and mission is not None:
                await mission
                await asyncio.sleep(AFTER_LANDING_S)
            else:
                await asyncio.sleep(max(left_s - self._flown_s, 0.0))
        finally:
            if mission is not None:
                mission.cancel()
                await asyncio.gather(mission, return_exceptions=True)

    async def _fly_mission(self, child: Child) -> None:
        await child.start()
        assert child.process is not None
        assert child.process.stdout is not None
        try:
            async with asyncio.timeout(self._mission_limit_s):
                while line := await child.process.stdout.readline():
                    self._say(f"mission {line.decode(errors='replace').strip()}")
                code = await child.wait()
        except TimeoutError:
            self._broken_off(f"no end within {self._mission_limit_s:g} s, more than all its waits together")
            return
        if code != 0 and not child.stopped_by_us:
            words = child.last_lines() or [child.why_it_ended()]
            self._broken_off(words[-1].removeprefix("fleetloc: error: "))

    def _broken_off(self, why: str) -> None:
        self.mission_failure = why
        self._outcome.deaths.append(Death("mission", self._flown_s, why))
        self._say(f"the mission was broken off: {why}")

    def _picture(self) -> tuple[str, list[live_table.Row]]:
        _, rows = super()._picture()
        until = "until the mission ends" if self._duration_s is None else f"of {self._duration_s:.0f} s"
        return f"{self._config.fleet.name}: {self._flown_s:.0f} s {until}", rows

    async def _close(self) -> None:
        if self._mission is not None:
            await stop_all([self._mission])
        await super()._close()
