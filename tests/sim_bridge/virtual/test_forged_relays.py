"""A member with a good key that invents, alters and re-stamps what others measured: nobody takes any of it.

`FLEETLOC_FORGED` says how many records it forges; 100000 takes some minutes.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nacl.signing import SigningKey

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from sim_bridge.virtual.fleet_lockstep import FleetLockstep, LockstepReport, Surroundings
from transport.messages.header import MAX_DATAGRAM_BYTES
from transport.messages.measurement_body import Measurement, Measurements, PositionMeasurement, as_sent
from transport.messages.proofs import Proof
from transport.security.auth import Identity
from transport.security.sealing import Message, Packet, Sealer

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
KEYS = {agent: SigningKey(bytes([agent]) * 32) for agent in (1, 2, 3)}
TRUST = {agent: (key.verify_key,) for agent, key in KEYS.items()}
FORGED = int(os.environ.get("FLEETLOC_FORGED", "600"))
A_PACKET = 10
"""Forged records in each packet of the relay."""
FORGED_A_SECOND = 150
"""Fewer than are forged."""
VARIANCE = (1e-6, 1e-6, 1e-6)


class Forger(Sealer):
    """The middle drone's sealer: forges in every way that it has, in front of what is true and behind it."""

    def __init__(self, agent: OnboardAgent, config: FleetConfig) -> None:
        own = agent.sealer
        super().__init__(config.fleet.name, 2, boot=1, signing=KEYS[2], agreement=own._agreement)
        self.largest = 0
        self.forged: Counter[str] = Counter()
        self._known: dict[int, tuple[Measurement, Proof]] = {}

    def seal(self, message: Message, *, t_ns: int, double: bool | None = None) -> list[Packet]:
        if isinstance(message, Measurements):
            message = self._forge(message)
        packets = super().seal(message, t_ns=t_ns, double=double)
        self.largest = max(self.largest, *(len(packet.data) for packet in packets))
        return packets

    def _forge(self, message: Measurements) -> Measurements:
        for proof in message.proofs or ():
            for record in message.records:
                if record.observer == proof.owner and isinstance(record, PositionMeasurement):
                    self._known[proof.owner] = record, proof
        if len(self._known) < 2:
            return message
        way = ("no proof", "another's proof", "altered", "re-stamped", "own proof")[sum(self.forged.values()) % 7 % 5]
        records: list[Measurement] = []
        proofs: list[Proof] = []
        for number in range(A_PACKET):
            owner = (1, 3)[number % 2]
            record, proof = self._known[owner]
            assert isinstance(record, PositionMeasurement)
            far = as_sent(replace(record, position_m=(50.0 + number, -80.0, -5.0), variance_m2=VARIANCE))
            if way == "re-stamped":
                far = as_sent(replace(record, tick=message.tick, offset_s=record.offset_s + 1e-3 * number))
            elif way != "altered":
                far = as_sent(replace(far, tick=message.tick, offset_s=1e-3 * number))
            if way == "own proof":
                assert self._prover is not None
                proofs.append(replace(self._prover.prove((far.digest,)), owner=owner))
            elif way != "no proof" and number < 1:
                claimed = tuple(sorted({far.digest, *proof.digests}))
                proofs.append(replace(proof, digests=claimed))
            records.append(far)
        self.forged[way] += len(records)
        return replace(
            message, records=(*records[:1], *message.records, *records[1:]), proofs=(*proofs, *(message.proofs or ()))
        )


class Flight:
    """line3 with signed packets, the middle drone forging or not."""

    def __init__(self, duration_s: float, *, forging: bool) -> None:
        self.config = load_config(LINE3)
        self.estimates: list[tuple[int, EstimateReady]] = []
        self.agents: dict[int, OnboardAgent] = {}
        self._forging = forging
        identities = {agent: Identity(KEYS[agent], TRUST, 1) for agent in self.config.ids}
        around = Surroundings(identities=identities, make_agent=self._make)
        fleet = FleetLockstep(self.config, make_estimator, self._on_estimate, "values", around)
        self.report: LockstepReport = fleet.run(duration_s)

    def _make(self, config: FleetConfig, agent_id: int, *arguments: Any, **options: Any) -> OnboardAgent:
        agent = self.agents[agent_id] = OnboardAgent(config, agent_id, *arguments, **options)
        if self._forging and agent_id == 2:
            agent.sealer = Forger(agent, config)
        return agent

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        if agent.agent_id != 2:
            self.estimates.append((agent.agent_id, ready))


def test_no_forged_record_has_any_effect() -> None:
    # GIVEN the same flight with an honest relay, and with one that forges
    duration_s = max(3.0, FORGED / FORGED_A_SECOND)
    honest, forged = Flight(duration_s, forging=False), Flight(duration_s, forging=True)
    forger = forged.agents[2].sealer
    assert isinstance(forger, Forger)
    assert sum(forger.forged.values()) >= FORGED
    assert min(forger.forged[way] for way in forger.forged) > 0
    assert len(forger.forged) == 5
    assert forger.largest <= MAX_DATAGRAM_BYTES
    # THEN the other two estimate what they did, to the last bit
    assert len(honest.estimates) == len(forged.estimates) > 0
    for (one, mine), (other, theirs) in zip(honest.estimates, forged.estimates, strict=True):
        assert one == other
        np.testing.assert_array_equal(mine.estimate.mean, theirs.estimate.mean)
        np.testing.assert_array_equal(mine.estimate.covariance, theirs.estimate.covariance)
    # AND they count by reason and relay what they refused
    for agent_id in (1, 3):
        assert honest.report.counters[agent_id].get("refused heard: not proven, of 2", 0) == 0
        assert forged.report.counters[agent_id]["refused heard: not proven, of 2"] > FORGED / 4
        assert forged.agents[agent_id].opener.peers[2].rejections.as_dict().keys() == {"bad_proof"}


def test_what_is_relayed_honestly_is_all_proven() -> None:
    flight = Flight(3.0, forging=False)
    for agent_id in (1, 3):
        found = flight.report.counters[agent_id]
        assert not any("proven" in name or "bad_proof" in name for name in found)
        ages = [ready.estimate.age_ticks for who, ready in flight.estimates if who == agent_id]
        assert max(ages[-1]) == pytest.approx(0, abs=1)  # the far end of the line is there, with this tick's records
