"""What cannot be, said by a member with a good key or by an own receiver: told at once, and not followed."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from agent.sensing.samples import GpsSample, Sample
from estimators.factory import make_estimator
from sim_bridge.virtual.fleet_lockstep import FleetLockstep, Surroundings
from transport.messages.measurement_body import Measurements, PositionMeasurement, as_sent
from transport.security.auth import UNSIGNED
from transport.security.sealing import Message, Packet, Sealer

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
LIAR = 2
POISON_S, FLIGHT_S = 4.0, 8.0
SIGMA_M = 6e-8


class Poisoner(Sealer):
    """Says for two ticks that it is a thousand kilometres away, and quite sure of it."""

    def __init__(self, agent: OnboardAgent, config: FleetConfig, start_s: float) -> None:
        super().__init__(config.fleet.name, LIAR, boot=1, signing=UNSIGNED, agreement=agent.sealer._agreement)
        self._from_s = start_s + POISON_S
        self.said = 0

    def seal(self, message: Message, *, t_ns: int, double: bool | None = None) -> list[Packet]:
        if isinstance(message, Measurements) and 0.0 <= 1e-9 * t_ns - self._from_s < 0.2:
            there = PositionMeasurement(LIAR, message.tick, (1e6, -1e6, 1e6), (SIGMA_M**2,) * 3)
            others = tuple(each for each in message.records if not isinstance(each, PositionMeasurement))
            message = replace(message, records=(as_sent(there), *others))
            self.said += 1
        return super().seal(message, t_ns=t_ns, double=double)


class Jumping(OnboardAgent):
    """Its own receiver gives two fixes ten kilometres off."""

    jumped = 0
    start_s: float | None = None

    def on_sample(self, sample: Sample, host_s: float) -> None:
        self.start_s = host_s if self.start_s is None else self.start_s
        jumps = self.agent_id == LIAR and host_s - self.start_s >= POISON_S and self.jumped < 2
        if jumps and isinstance(sample, GpsSample):
            self.jumped += 1
            north, east, down = sample.position_m
            sample = replace(sample, position_m=(north + 1e4, east, down))
        super().on_sample(sample, host_s)


class Flight:
    """line3; own positions ``(3,)`` and healths by tick, for each agent."""

    def __init__(self, kind: str, fault: str) -> None:
        self.config = load_config(LINE3, [f'estimator.kind="{kind}"', "estimator.window=6"])
        self.places: dict[int, dict[int, np.ndarray]] = {agent: {} for agent in self.config.ids}
        self.healths: dict[int, dict[int, str]] = {agent: {} for agent in self.config.ids}
        self.agents: dict[int, OnboardAgent] = {}
        self._fault = fault
        around = Surroundings(make_agent=self._make)
        fleet = FleetLockstep(self.config, make_estimator, self._on_estimate, "values", around)
        report = fleet.run(FLIGHT_S)
        self.first_tick = min(self.places[1])
        period_s = self.config.fleet.period_s
        self.truth = {
            tick: report.truth.at(tick * period_s + self.config.fleet.epoch_unix_s)[:, :3]
            for tick in sorted(self.places[1])[5:-5]
        }

    def _make(self, config: FleetConfig, agent_id: int, *arguments: Any, **options: Any) -> OnboardAgent:
        made = Jumping if self._fault == "fixes" else OnboardAgent
        agent = self.agents[agent_id] = made(config, agent_id, *arguments, **options)
        if self._fault == "record" and agent_id == LIAR:
            agent.sealer = Poisoner(agent, config, options["unix_s"])
        return agent

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        slot, tick = self.config.ids.index(agent.agent_id), ready.estimate.tick
        self.places[agent.agent_id][tick] = ready.estimate.mean[6 * slot : 6 * slot + 3]
        self.healths[agent.agent_id][tick] = str(agent.core.health.health)

    def errors_m(self) -> np.ndarray:
        """``(K, n)`` of own positions after the poison."""
        ticks = [tick for tick in self.truth if tick >= self.first_tick + POISON_S / self.config.fleet.period_s]
        own = np.array([[self.places[agent][tick] for agent in self.config.ids] for tick in ticks])
        return np.asarray(np.linalg.norm(own - np.array([self.truth[tick] for tick in ticks]), axis=-1))


@functools.cache
def clean_flight(kind: str) -> Flight:
    return Flight(kind, "none")


@pytest.mark.parametrize("fault", ["record", "fixes"])
@pytest.mark.parametrize("kind", ["dmhe_shared", "dmhe_pre_ekf", "dekf_ci"])
def test_no_estimate_follows_what_cannot_be_and_it_is_told_at_once(kind: str, fault: str) -> None:
    clean, poisoned = clean_flight(kind), Flight(kind, fault)
    liar = poisoned.agents[LIAR]
    assert getattr(liar.sealer, "said", 0) >= 4 or getattr(liar, "jumped", 0) == 2
    # THEN the output moves by less than 2 m, and the fleet errs by at most twice what it does otherwise
    for agent_id in poisoned.config.ids:
        moved = [np.linalg.norm(poisoned.places[agent_id][t] - clean.places[agent_id][t]) for t in clean.places[1]]
        assert max(moved) < 2.0
    rmse_m = [float(np.sqrt(np.mean(flight.errors_m() ** 2))) for flight in (clean, poisoned)]
    assert 0.005 < rmse_m[1] <= 2.0 * rmse_m[0]
    # AND within a second everybody that heard it says who measured what cannot be, until a second later
    from_tick = poisoned.first_tick + round(POISON_S / 0.1)
    who = "own measurements" if fault == "fixes" else None
    for agent_id in poisoned.config.ids:
        told = [t for t, text in poisoned.healths[agent_id].items() if "impossible" in text]
        if agent_id == LIAR and who is None:
            assert told == []  # what it measured is as it should be: it lies to the others
            continue
        assert from_tick - 2 <= min(told) <= from_tick + 10
        assert max(told) <= from_tick + 30
        name = who if agent_id == LIAR else f"measurements of {LIAR}"
        assert f"{name} impossible" in poisoned.healths[agent_id][min(told)]
        assert poisoned.healths[agent_id][min(told)].startswith("ALARM") == (agent_id == LIAR)
        assert poisoned.healths[agent_id][from_tick + 31] == clean.healths[agent_id][from_tick + 31]
    assert all(agent.core.counters["estimator faults"] == 0 for agent in poisoned.agents.values())
