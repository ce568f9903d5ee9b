"""Fleets under faults drawn from a seed, in virtual time, and what their history must keep whatever happens.

    python -m tests.fleet.nemesis --seeds 1..200 --out nemesis.jsonl
    python -m tests.fleet.nemesis --live udp --seeds 1..15 --out nemesis_udp.jsonl

One line a seed; seeds that the file has already are not flown again. A seed gives the same flight bit by bit.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import typer

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady, Output
from agent.sensing.samples import Sample
from estimators.factory import make_estimator
from sim_bridge.virtual.fleet_events import FleetEvents, Interval
from sim_bridge.virtual.fleet_lockstep import HOST_START_S, FleetLockstep, LockstepReport, Surroundings
from transport.link.channel import ChannelSettings, Outage

LINE3 = Path(__file__).parents[2] / "configs" / "line3.toml"
CALM_S = 6.0
"""Nothing happens before."""
FAULTS_S = 14.0
HEALED_S = 10.0
"""After the last fault everybody knows everybody again within this."""
JUDGED_S = 4.0
"""Flown after that."""
FLIGHT_S = CALM_S + FAULTS_S + HEALED_S + JUDGED_S
MOST_FAULTS = 4
STALE_S = 3.0
"""What is played back is this old."""
OUTSIDE_SHARE = 0.01
"""Of the estimates of a flight that may be farther off than their protection level; 0.001 each way are promised, and
errors last for a second."""

USABLE = ("NOMINAL", "DEGRADED")
"""States in which a protection level is promised."""

Kind = Literal[
    "kill",
    "stop",
    "one_way",
    "loss",
    "delay",
    "duplicate",
    "clock_forward",
    "clock_back",
    "silent_autopilot",
    "replay",
]
LiveKind = Literal["both_stop", "full_disk"]
"""Struck on live fleets only, with some of the others."""


@dataclass(frozen=True, slots=True)
class Blow:
    """One fault: what, to whom, when; ``value`` is a share, a delay or a step, ``of`` who is not heard."""

    kind: Kind | LiveKind
    agent: int
    from_s: float
    to_s: float
    value: float = 0.0
    of: int = 0


def schedule(seed: int, ids: tuple[int, ...]) -> tuple[Blow, ...]:
    """The faults of a seed, one to four; none of a kind twice at the same drone."""
    rng = np.random.default_rng([seed, 13])
    blows: dict[tuple[str, int], Blow] = {}
    for _ in range(int(rng.integers(1, MOST_FAULTS + 1))):
        kind: Kind = get_args(Kind)[int(rng.integers(len(get_args(Kind))))]
        agent = int(rng.choice(ids))
        from_s = CALM_S + float(rng.uniform(0.0, FAULTS_S - 4.0))
        to_s = min(from_s + float(rng.uniform(0.3, 8.0)), CALM_S + FAULTS_S)
        value = {
            "loss": float(rng.uniform(0.2, 0.95)),
            "delay": float(rng.uniform(0.02, 0.5)),
            "duplicate": float(rng.uniform(0.1, 1.0)),
            "clock_forward": float(rng.uniform(0.1, 8.0)),
            "clock_back": -float(rng.uniform(0.1, 4.0)),
        }.get(kind, 0.0)
        of = int(rng.choice([other for other in ids if other != agent]))
        blows.setdefault((kind, agent), Blow(kind, agent, from_s, to_s, value, of))
    return tuple(blows.values())


@dataclass(frozen=True, slots=True)
class Told:
    """One estimate of a drone's life; ``life`` counts its starts, and steps of its clock."""

    agent: int
    life: int
    tick: int
    host_s: float
    t_s: float
    finite: bool
    least_eigenvalue: float
    own_m: np.ndarray
    level_m: tuple[float, float]
    age_ticks: tuple[int, ...]
    state: str


class StruckAgent(OnboardAgent):
    """An agent that its nemesis can suspend, cut off from its autopilot, or feed with what was said before."""

    def __init__(self, config: FleetConfig, agent_id: int, *arguments: Any, **options: Any) -> None:
        super().__init__(config, agent_id, *arguments, **options)
        self.blows: tuple[Blow, ...] = ()
        self.stale_taken = 0
        self._heard: list[tuple[float, str, bytes]] = []
        self._stopped_until_s = -math.inf

    def _struck(self, kind: Kind, host_s: float) -> Blow | None:
        at_s = host_s - HOST_START_S
        return next((each for each in self.blows if each.kind == kind and each.from_s <= at_s < each.to_s), None)

    def advance(self, host_s: float) -> list[Output]:
        blow = self._struck("stop", host_s)
        self._stopped_until_s = -math.inf if blow is None else HOST_START_S + blow.to_s
        return [] if blow else super().advance(host_s)

    def next_due_host_s(self) -> float:
        """Nothing is due while it is suspended: asked for what was due before, the queue would not get on."""
        return max(super().next_due_host_s(), self._stopped_until_s)

    def keep_house(self, *, unix_s: float, host_s: float) -> list[Output]:
        return [] if self._struck("stop", host_s) else super().keep_house(unix_s=unix_s, host_s=host_s)

    def on_sample(self, sample: Sample, host_s: float) -> None:
        if not (self._struck("stop", host_s) or self._struck("silent_autopilot", host_s)):
            super().on_sample(sample, host_s)

    def on_packet(self, key: str, data: bytes, *, arrived_s: float, host_s: float, unix_ns: int) -> None:
        if self._struck("stop", host_s):
            return
        super().on_packet(key, data, arrived_s=arrived_s, host_s=host_s, unix_ns=unix_ns)
        self._heard.append((host_s, key, data))
        if self._struck("replay", host_s):
            before = sum(peer.received for _, peer in self.opener.peers.items())
            for _, old_key, old in [each for each in self._heard if host_s - each[0] >= STALE_S][-3:]:
                super().on_packet(old_key, old, arrived_s=arrived_s, host_s=host_s, unix_ns=unix_ns)
            self.stale_taken += sum(peer.received for _, peer in self.opener.peers.items()) - before


@dataclass(slots=True)
class Outcome:
    """Of one seed: what was broken, in words."""

    seed: int
    blows: list[dict[str, Any]]
    broken: list[str] = field(default_factory=list)
    rmse_m: float = 0.0
    outside: float = 0.0


class Flight:
    """line3 under the faults of a seed."""

    def __init__(self, seed: int, config: FleetConfig | None = None) -> None:
        self.config = config or load_config(LINE3, [f"sim.seed={seed}", f"transport.seed={seed}"])
        self.seed, self.blows = seed, schedule(seed, self.config.ids)
        self.told: list[Told] = []
        self.agents: list[StruckAgent] = []
        away = [Interval(each.agent, each.from_s, each.to_s) for each in self.blows if each.kind == "kill"]
        around = Surroundings(events=FleetEvents(away=tuple(away)), make_agent=self._make)
        self._run = FleetLockstep(self.config, make_estimator, self._on_estimate, "values", around)
        for each in self.blows:
            for at_s in (each.from_s, each.to_s):
                self._run.queue.at(HOST_START_S + at_s, self._set_surroundings)
        self.report: LockstepReport = self._run.run(FLIGHT_S)

    def _make(self, config: FleetConfig, agent_id: int, *arguments: Any, **options: Any) -> StruckAgent:
        agent = StruckAgent(config, agent_id, *arguments, **options)
        agent.blows = tuple(each for each in self.blows if each.agent == agent_id)
        self.agents.append(agent)
        return agent

    def _set_surroundings(self) -> None:
        """Channels and clocks as they are at this instant."""
        at_s = self._run.queue.now_s - HOST_START_S + 1e-6
        for agent_id, drone in self._run.fleet.drones.items():
            now = [each for each in self.blows if each.agent == agent_id and each.from_s <= at_s < each.to_s]
            settings = ChannelSettings()
            for each in now:
                if each.kind == "one_way":
                    outage = Outage(HOST_START_S + each.from_s, HOST_START_S + each.to_s, (each.of,))
                    settings = _changed(settings, outages=(*settings.outages, outage))
                elif each.kind == "loss":
                    settings = _changed(settings, loss=each.value)
                elif each.kind == "delay":
                    settings = _changed(settings, delay_s=each.value)
                elif each.kind == "duplicate":
                    settings = _changed(settings, duplicate=each.value)
            drone.channel.change(settings)
            drone.utc_error_s = sum(each.value for each in now if each.kind.startswith("clock"))
            self._run.fleet.advance(drone)

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        estimate, slot = ready.estimate, self.config.ids.index(agent.agent_id)
        finite = bool(np.isfinite(estimate.mean).all() and np.isfinite(estimate.covariance).all())
        level = ready.integrity.own if ready.integrity is not None else None
        self.told.append(
            Told(
                agent.agent_id,
                id(agent),
                estimate.tick,
                self._run.queue.now_s,
                ready.t_s,
                finite,
                float(np.linalg.eigvalsh(estimate.covariance)[0]) if finite else -1.0,
                estimate.mean[6 * slot : 6 * slot + 3].copy(),
                (level.horizontal_m, level.vertical_m) if level is not None else (0.0, 0.0),
                tuple(estimate.age_ticks.tolist()),
                str(ready.integrity.state) if ready.integrity is not None else "",
            )
        )

    def judged(self) -> Outcome:
        """What the history must keep, held against it."""
        found = Outcome(self.seed, [asdict(each) for each in self.blows])
        broken = found.broken
        if not all(each.finite and each.least_eigenvalue > 0.0 for each in self.told):
            broken.append("an estimate is not finite, or its covariance not positive definite")
        for agent in self.agents:
            ticks = [each.tick for each in self.told if each.life == id(agent)]
            if any(later <= earlier for earlier, later in pairwise(ticks)):
                broken.append(f"stamps of {agent.agent_id} do not rise")
            faults = {name: agent.core.counters[name] for name in ("estimator faults", "core faults")}
            broken += [f"{count} {name} of {agent.agent_id}" for name, count in faults.items() if count]
            if agent.stale_taken:
                broken.append(f"{agent.agent_id} took {agent.stale_taken} packets that were played back")
        self._judge_errors(found)
        self._judge_healing(found)
        return found

    def _judge_errors(self, found: Outcome) -> None:
        """Errors and protection levels of what may be used, and that no output is of the future."""
        epoch_s, start_s = self.config.fleet.epoch_unix_s, self.report.start_unix_s
        stepped = {each.agent for each in self.blows if each.kind.startswith("clock")}
        outside, errors = [], []
        for each in self.told:
            true_unix_s = start_s + each.host_s - HOST_START_S
            if each.agent in stepped:
                continue  # by its own clock it is elsewhere in time
            if epoch_s + each.t_s > true_unix_s + 1e-6:
                found.broken.append(f"an estimate of {each.agent} is newer than now")
                break
            recorded = start_s <= epoch_s + each.t_s <= start_s + FLIGHT_S - 1.0
            if each.state not in USABLE or not recorded:
                continue
            truth = self.report.truth.at(epoch_s + each.t_s)[self.config.ids.index(each.agent), :3]
            off = each.own_m - truth
            errors.append(float(np.linalg.norm(off)))
            outside.append(np.hypot(*off[:2]) > each.level_m[0] or abs(off[2]) > each.level_m[1])
        found.rmse_m = float(np.sqrt(np.mean(np.square(errors)))) if errors else 0.0
        found.outside = float(np.mean(outside)) if outside else 0.0
        if found.outside > OUTSIDE_SHARE:
            found.broken.append(f"{100 * found.outside:.1f} % of the usable estimates outside their protection level")

    def _judge_healing(self, found: Outcome) -> None:
        """At the end all drones are there, know all others, and are well."""
        last_s = max(each.to_s for each in self.blows)
        from_s = HOST_START_S + last_s + HEALED_S
        for agent_id in self.config.ids:
            late = [each for each in self.told if each.agent == agent_id and each.host_s >= from_s]
            if len(late) < 10:
                found.broken.append(f"{agent_id} is not back {HEALED_S:g} s after the last fault")
            elif max(max(each.age_ticks) for each in late) > 5:
                found.broken.append(f"{agent_id} does not know all others {HEALED_S:g} s after the last fault")
            elif late[-1].state not in USABLE:
                found.broken.append(f"{agent_id} is {late[-1].state} at the end")


def _changed(settings: ChannelSettings, **values: Any) -> ChannelSettings:
    known = {name: getattr(settings, name) for name in settings.__struct_fields__}
    return ChannelSettings(**(known | values))


def seeds_of(text: str) -> range:
    """``A..B``, both included."""
    first, _, last = text.partition("..")
    return range(int(first), int(last or first) + 1)


def _fly_live(seed: int, link: str) -> Outcome:
    from tests.fleet.nemesis_live import fly_live

    return fly_live(seed, link)


def main(arguments: Iterable[str]) -> int:
    """Fly seeds; the exit code is 1 if any broke something."""
    parser = argparse.ArgumentParser(prog="python -m tests.fleet.nemesis")
    parser.add_argument("--seeds", type=seeds_of, required=True, help="A..B")
    parser.add_argument("--out", type=Path, help="keeps the outcomes, and goes on from there")
    parser.add_argument("--live", choices=("udp", "tcp"), help="a fleet of processes, linked so; one file for each")
    options = parser.parse_args(list(arguments))
    done: dict[int, bool] = {}
    if options.out is not None and options.out.exists():
        lines = map(json.loads, options.out.read_text().splitlines())
        done = {line["seed"]: bool(line["broken"]) for line in lines}
    for seed in options.seeds:
        if seed in done:
            continue
        found = Flight(seed).judged() if options.live is None else _fly_live(seed, options.live)
        done[seed] = bool(found.broken)
        kinds = ", ".join(f"{blow['kind']} {blow['agent']}" for blow in found.blows)
        typer.echo(f"{seed}: {'; '.join(found.broken) or 'ok'} ({kinds}; RMSE {found.rmse_m:.3f} m)")
        if options.out is not None:
            with options.out.open("a") as file:
                file.write(json.dumps(asdict(found)) + "\n")
    wrong = [seed for seed in options.seeds if done[seed]]
    named = f", not {wrong}" if wrong else ""
    typer.echo(f"{len(options.seeds) - len(wrong)} of {len(options.seeds)} seeds ok{named}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
