"""A member with a good key that invents, alters and re-stamps what others measured: nobody takes any of it.

`FLEETLOC_FORGED` says how many records are forged outside of a flight; 100000 takes a minute.
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
from agent.fleet.measurement_store import MeasurementStore
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from sim_bridge.virtual.fleet_lockstep import FleetLockstep, LockstepReport, Surroundings
from transport.link.streams import Stream, key_expression
from transport.messages.header import MAX_DATAGRAM_BYTES, fleet_hash
from transport.messages.measurement_body import (
    Measurement,
    Measurements,
    PositionMeasurement,
    RangeMeasurement,
    as_sent,
)
from transport.messages.proofs import Proof, Prover
from transport.security.auth import Identity
from transport.security.opening import Opener
from transport.security.sealing import Message, Packet, Sealer

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
KEYS = {agent: SigningKey(bytes([agent]) * 32) for agent in (1, 2, 3)}
TRUST = {agent: (key.verify_key,) for agent, key in KEYS.items()}
FORGED = 600
"""In a flight."""
FORGED_ALONE = int(os.environ.get("FLEETLOC_FORGED", "3000"))
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
                assert isinstance(far, PositionMeasurement)
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


def test_forged_records_alone_are_all_left_out_and_true_ones_between_them_are_not() -> None:
    # GIVEN drone 1, and packets of member 2 that forge in every way what 3 measured, one true record in each
    config, tick = load_config(LINE3), 1000
    opener = Opener("line3", config.ids, TRUST, own_id=1)
    store = MeasurementStore(config, 1)
    owner = Prover(3, fleet_hash("line3"), 0, KEYS[3])
    relay = Sealer("line3", 2, boot=1, signing=KEYS[2])
    rng = np.random.default_rng(1)
    forged, key = 0, key_expression("line3", 2, Stream.MEAS)
    while forged < FORGED_ALONE:
        tick += 1
        true = as_sent(PositionMeasurement(3, tick, tuple(rng.normal(0.0, 9.0, 3).tolist()), VARIANCE))
        proof = owner.prove((true.digest,))
        lies = [_forgery(true, number, rng) for number in range(A_PACKET)]
        claimed = replace(proof, digests=tuple(sorted({lie.digest for lie in lies} | {true.digest})))
        by_itself = replace(Prover(2, owner.fleet, 0, KEYS[2]).prove(lie.digest for lie in lies), owner=3)
        elsewhere = Prover(3, owner.fleet, 1, KEYS[3]).prove(lie.digest for lie in lies)
        fakes = ((), (claimed,), (by_itself,), (elsewhere,))[tick % 4]
        message = Measurements(tick, (*lies[:5], true, *lies[5:]), proofs=(*fakes, proof))
        (packet,) = relay.seal(message, t_ns=0)
        received = opener.open(key, packet.data, now=0.0, unix_ns=0)
        assert received is not None
        assert isinstance(received.message, Measurements)
        # THEN the true one is taken, and nothing else
        assert len(received.message.records) == A_PACKET + 1
        heard = received.message
        assert store.add_heard(2, heard.records, tick, heard.proofs, heard.acks) == [true]
        store.forget(tick)
        forged += len(lies)
    assert dict(store.refused).get("heard: not proven, of 2") == forged
    assert opener.peers[2].rejections.as_dict().keys() == {"bad_proof"}


def _forgery(true: Measurement, number: int, rng: np.random.Generator) -> Measurement:
    """Another place, a smaller variance, another tick, or something never measured at all."""
    assert isinstance(true, PositionMeasurement)
    match number % 4:
        case 0:
            north, east, down = rng.normal(0.0, 200.0, 3).tolist()
            return as_sent(replace(true, position_m=(north, east, down), offset_s=1e-4 * (number + 1)))
        case 1:
            return as_sent(replace(true, variance_m2=(1e-9, 1e-9, 1e-9), offset_s=1e-4 * (number + 1)))
        case 2:
            return as_sent(replace(true, tick=true.tick - number, offset_s=2e-4 * (number + 1)))
        case _:
            return as_sent(RangeMeasurement(3, true.tick - number, 1 + number % 2, 5.0 + number, 1e-6))
