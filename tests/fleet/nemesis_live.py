"""The nemesis on a live fleet: daemons are killed, suspended and deprived of their disk, links lose packets.

    python -m tests.fleet.nemesis --live udp --seeds 1..15 --out live.jsonl

A seed gives the same blows, not the same flight: the machine decides what passes between. A live daemon's clock is
the system's and its autopilot the simulator's: steps of the one and silence of the other are struck in virtual time.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.log.estimate_log import covariance_of, read_entries
from estimators.estimator import Status
from estimators.model.layout import Layout, position
from fleetloc.run import run_files
from sim_bridge.world.truth import Truth, load_truth
from tests.fleet.nemesis import Blow, Outcome
from tests.support.fleet_process import ROOT, FleetProcess, with_overrides
from tests.support.ports import HOST, bound_in_a_row, free_ports

PERIOD_S = 0.2
CALM_S, FAULTS_S, HEALED_S, JUDGED_S = 6.0, 12.0, 10.0, 4.0
END_WITHIN_S = 3.0
"""After SIGTERM a daemon is gone."""
MOST_SIGMAS = 5.0
"""An error beyond it, once the fleet is well again, was not claimed."""
KNOWN_WITHIN_TICKS = 8
START_S = 240.0
"""A fleet on a busy machine takes so long to be there."""
STRUCK = ("kill", "stop", "both_stop", "full_disk", "one_way")


def live_schedule(seed: int, ids: tuple[int, ...]) -> tuple[Blow, ...]:
    """The faults of a seed, one to three; times are since the simulated flight began."""
    rng = np.random.default_rng([seed, 29])
    blows: dict[tuple[str, int], Blow] = {}
    for _ in range(int(rng.integers(1, 4))):
        kind: Any = STRUCK[int(rng.integers(len(STRUCK)))]
        agent = int(rng.choice(ids))
        from_s = CALM_S + float(rng.uniform(0.0, FAULTS_S - 6.0))
        to_s = min(from_s + float(rng.uniform(1.0, 7.0)), CALM_S + FAULTS_S)
        of = int(rng.choice([other for other in ids if other != agent]))
        taken = any(each.agent == agent or each.of == agent for each in blows.values())
        if not taken and not any(of in (each.agent, each.of) for each in blows.values()):
            blows[kind, agent] = Blow(kind, agent, from_s, to_s, 0.0, of)
    return tuple(blows.values())


def radio_of(seed: int) -> tuple[float, float, float]:
    """Loss, delay in s and duplicates of all links for the whole flight; none in every second seed."""
    rng = np.random.default_rng([seed, 31])
    if seed % 2 == 0:
        return 0.0, 0.0, 0.0
    return float(rng.uniform(0.0, 0.3)), float(rng.uniform(0.0, 0.05)), float(rng.uniform(0.0, 0.3))


def overrides_of(seed: int, link: str, blows: tuple[Blow, ...]) -> list[str]:
    """The settings of the flight of a seed, on free ports."""
    kind = socket.SOCK_DGRAM if link == "udp" else socket.SOCK_STREAM
    udp = free_ports(socket.SOCK_DGRAM, 3)
    with bound_in_a_row(kind, 3) as radio:
        pass
    loss, delay_s, duplicate = radio_of(seed)
    outages = ", ".join(
        f"{{ from_s = {each.from_s:.2f}, to_s = {each.to_s:.2f}, receivers = [{each.agent}], senders = [{each.of}], "
        "one_way = true }"
        for each in blows
        if each.kind == "one_way"
    )
    return [
        *(f"agents.{i + 1}.mavlink=udpin:{HOST}:{port}" for i, port in enumerate(udp)),
        f"transport.link={link}",
        # datagrams go to the three ports above those of the devices
        f"transport.base_port={radio - 3 if link == 'udp' else radio}",
        f"fleet.period_s={PERIOD_S}",
        f"sim.seed={seed}", f"transport.seed={seed}",
        f"transport.loss={loss:.3f}", f"transport.delay_s={delay_s:.3f}",
        f"transport.faults.duplicate={duplicate:.3f}", f"transport.faults.outages=[{outages}]",
        "transport.lease_s=2.0", "transport.open_timeout_s=0.5", "transport.retry_max_s=0.3",
    ]  # fmt: skip


class LiveFlight:
    """line3 as processes, struck as its seed says; ``folder`` is its own."""

    def __init__(self, seed: int, link: str, folder: Path) -> None:
        self.seed, self.out = seed, folder / f"run{seed}"
        self.blows = live_schedule(seed, (1, 2, 3))
        self.broken: list[str] = []
        self.last_blow_s = max([CALM_S, *(each.to_s for each in self.blows)])
        """Later, where a daemon that was started anew takes its time: it is back when it has its autopilot."""
        self._restarted: list[subprocess.Popen[bytes]] = []
        self._fleet = FleetProcess(
            self.out, *with_overrides(overrides_of(seed, link, self.blows)), "--duration", "600"
        )
        self._began_s = 0.0

    def fly(self) -> None:
        """From start to end; whatever happens, no process of it is left."""
        try:
            process = self._fleet.process
            _until(lambda: self._fleet.flying() or process.poll() is not None, START_S, "the flight")
            assert process.poll() is None, process.communicate()[1].strip().splitlines()[-1:]
            self._began_s = time.monotonic()
            for at_s, act in sorted(self._acts(), key=lambda each: each[0]):
                self._wait_for(at_s)
                act()
            if self._restarted:
                _until(self._all_back, START_S, "daemons that were started anew")
                self.last_blow_s = max(self.last_blow_s, time.monotonic() - self._began_s)
            self._wait_for(self.last_blow_s + HEALED_S + JUDGED_S)
            self._end()
        finally:
            self._fleet.clean_up()
            for daemon in self._restarted:
                daemon.kill()
                daemon.wait()

    def judged(self) -> Outcome:
        """What the history must keep, held against it."""
        found = Outcome(self.seed, [asdict(each) for each in self.blows], list(self.broken))
        config = load_config(self.out / run_files.CONFIG)
        truth = load_truth(self.out / run_files.TRUTH)
        errors = [error for agent_id in config.ids for error in self._judge(found, config, truth, agent_id)]
        found.rmse_m = float(np.sqrt(np.mean(np.square(errors)))) if errors else 0.0
        return found

    # --- blows ----------------------------------------------------------------------------------------------

    def _acts(self) -> list[tuple[float, Callable[[], None]]]:
        acts: list[tuple[float, Callable[[], None]]] = []
        for each in self.blows:
            agents = (each.agent, each.of) if each.kind == "both_stop" else (each.agent,)
            for number, agent in enumerate(agents):
                from_s, to_s = each.from_s + 0.5 * number, each.to_s + 0.5 * number
                if each.kind in ("stop", "both_stop"):
                    acts.append((from_s, self._signalling(agent, signal.SIGSTOP)))
                    acts.append((to_s, self._signalling(agent, signal.SIGCONT)))
                elif each.kind == "kill":
                    acts.append((from_s, self._signalling(agent, signal.SIGKILL)))
                    acts.append((to_s, lambda agent=agent: self._restart(agent)))  # type: ignore[misc]
                elif each.kind == "full_disk":
                    acts.append((from_s, lambda agent=agent: self._fill_disk(agent)))  # type: ignore[misc]
        return acts

    def _signalling(self, agent_id: int, number: signal.Signals) -> Callable[[], None]:
        return lambda: os.kill(self._fleet.pid_of(agent_id), number)

    def _restart(self, agent_id: int) -> None:
        file = str(self.out / run_files.CONFIG)
        with self._log_of_restart(len(self._restarted)).open("wb") as log:
            self._restarted.append(
                subprocess.Popen(
                    [sys.executable, "-m", "fleetloc", "agent", file, "--id", str(agent_id), "-v"],
                    cwd=ROOT,
                    stderr=log,
                    start_new_session=True,
                )
            )

    def _log_of_restart(self, number: int) -> Path:
        return self.out / f"restarted_{number}.log"

    def _all_back(self) -> bool:
        logs = [self._log_of_restart(number).read_text() for number in range(len(self._restarted))]
        return all("autopilot connected" in log for log in logs)

    def _fill_disk(self, agent_id: int) -> None:
        """From now on no file of the daemon grows, as on a disk that is full."""
        resource.prlimit(self._fleet.pid_of(agent_id), resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))

    def _wait_for(self, at_s: float) -> None:
        time.sleep(max(0.0, self._began_s + at_s - time.monotonic()))

    def _end(self) -> None:
        """SIGTERM to every daemon; the run sees that none is left and ends by itself."""
        pids = {agent_id: self._fleet.pid_of(agent_id) for agent_id in (1, 2, 3)}
        asked_s = time.monotonic()
        for pid in pids.values():
            os.kill(pid, signal.SIGTERM)
        for agent_id, pid in pids.items():
            if not _gone(pid, asked_s + END_WITHIN_S):
                self.broken.append(f"{agent_id} still runs {END_WITHIN_S:g} s after SIGTERM")
        self._fleet.finish()
        if not self._fleet.nothing_left():
            self.broken.append("processes are left")

    # --- the history ----------------------------------------------------------------------------------------

    def _judge(self, found: Outcome, config: FleetConfig, truth: Truth, agent_id: int) -> list[float]:
        """The errors of the last seconds."""
        parts = [read_entries(path)[1] for path in run_files.records(self.out, agent_id)]
        for part in parts:
            if any(later <= earlier for earlier, later in pairwise(part["tick"].tolist())):
                found.broken.append(f"stamps of {agent_id} do not rise")
            if any(part["t_s"] > part["published_s"]):
                found.broken.append(f"an estimate of {agent_id} is newer than its publication")
        deprived = any(each.kind == "full_disk" and each.agent == agent_id for each in self.blows)
        if deprived:
            return []  # it flies on without a record
        healed_s = self.last_blow_s + HEALED_S
        start_s = float(truth.time_unix_s[0]) - config.fleet.epoch_unix_s
        entries = parts[-1] if parts else np.empty(0)
        last = entries[entries["t_s"] >= start_s + healed_s] if len(entries) else entries
        last = last[last["t_s"] <= float(truth.time_unix_s[-1]) - config.fleet.epoch_unix_s] if len(last) else last
        if len(last) < 10:
            found.broken.append(f"{agent_id} is not back {HEALED_S:g} s after the last fault")
            return []
        if not (last["status"] == Status.OK)[-10:].all():
            found.broken.append(f"{agent_id} is not well at the end")
        if last["age_ticks"].max() > KNOWN_WITHIN_TICKS:
            found.broken.append(f"{agent_id} does not know all others {HEALED_S:g} s after the last fault")
        return self._errors(found, config, truth, agent_id, last)

    def _errors(
        self, found: Outcome, config: FleetConfig, truth: Truth, agent_id: int, entries: Any
    ) -> list[float]:
        slot = config.ids.index(agent_id)
        own, errors = position(Layout(config.ids).slot(agent_id)), []
        for entry in entries:
            covariance = covariance_of(entry, len(config.bodies))
            if not (np.isfinite(entry["mean"]).all() and np.linalg.eigvalsh(covariance)[0] > 0.0):
                found.broken.append(f"{agent_id}: an estimate is not finite, or its covariance not positive definite")
                break
            error = entry["mean"][own] - truth.at(config.fleet.epoch_unix_s + float(entry["t_s"]))[slot, :3]
            errors.append(float(np.linalg.norm(error)))
            sigmas = float(np.sqrt(error @ np.linalg.solve(covariance[own, own], error)))
            if sigmas > MOST_SIGMAS:
                found.broken.append(f"{agent_id} is {sigmas:.1f} sigmas off once the fleet is well")
                break
        return errors


def fly_live(seed: int, link: str) -> Outcome:
    """The outcome of a seed; a fleet that does not come so far is one that broke."""
    with tempfile.TemporaryDirectory(prefix=f"nemesis_{link}_{seed}_") as folder:
        flight = LiveFlight(seed, link, Path(folder))
        try:
            flight.fly()
            return flight.judged()
        except (TimeoutError, AssertionError, OSError) as error:
            broken = [*flight.broken, f"not flown to the end: {type(error).__name__} {error}"]
            return Outcome(seed, [asdict(each) for each in flight.blows], broken)


def _until(condition: Callable[[], bool], patience_s: float, what: str) -> None:
    end_s = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(f"in {patience_s:g} s not seen: {what}")
        time.sleep(0.05)


def _gone(pid: int, by_s: float) -> bool:
    while time.monotonic() < by_s:
        with contextlib.suppress(OSError):
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
            if state != "Z":
                time.sleep(0.02)
                continue
        return True
    return False
