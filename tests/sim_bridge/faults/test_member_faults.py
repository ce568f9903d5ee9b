"""Members that lie: what their packets say, that the packets are good, and when they say it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from nacl.signing import SigningKey

from agent.config.reading import load_config
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from sim_bridge.faults.fault_tables import MemberStuck, MemberWrong
from sim_bridge.faults.member_faults import CorruptSealer
from sim_bridge.virtual.fleet_lockstep import FleetLockstep, Surroundings
from transport.link.streams import key_expression
from transport.messages.estimate_body import FleetEstimate
from transport.messages.information_body import Information
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    Measurements,
    PositionMeasurement,
    RangeMeasurement,
)
from transport.messages.report_body import Diagnostics
from transport.messages.window_body import WindowStates
from transport.security.auth import Identity
from transport.security.opening import Opener
from transport.security.sealing import Message

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
CONFIG = load_config(LINE3, ['fleet.name="test"'])
ROSTER = (1, 2, 3)
KEYS = {agent_id: SigningKey(bytes([agent_id]) * 32) for agent_id in ROSTER}
TRUST = {agent_id: (key.verify_key,) for agent_id, key in KEYS.items()}
START_UNIX_S = 1.8e9
PERIOD_S = 0.1
FROM_S, TO_S = 2.0, 3.0
OFFSET_M = (3.0, -4.0, 1.0)
LIE = MemberWrong(agents=(2,), from_s=FROM_S, to_s=TO_S, offset_m=OFFSET_M)
STUCK = MemberStuck(agents=(2,), from_s=FROM_S, to_s=TO_S)


class Member:
    """Drone 2 with faults, and neighbours that open what it seals, each message by one that has heard no other."""

    def __init__(self, *faults: MemberWrong | MemberStuck) -> None:
        self.sealer = CorruptSealer(CONFIG, 2, Identity(KEYS[2], TRUST, 5), faults, START_UNIX_S)

    def said(self, message: Message, time_s: float) -> Message:
        """What the neighbour takes out of the packets of a message at a time since the start."""
        t_ns = round((START_UNIX_S + time_s) * 1e9)
        opener = Opener("test", ROSTER, TRUST, own_id=1)
        heard = [
            opener.open(key_expression("test", 2, packet.stream), packet.data, now=time_s, unix_ns=t_ns)
            for packet in self.sealer.seal(message, t_ns=t_ns, double=True)
        ]
        assert heard[-1] is not None  # signature, numbering and content are good
        return heard[-1].message


def measurements(tick: int, north_m: float = 7.0, exchange: int = 0) -> Measurements:
    """Fix, range and input of its own, and a relayed fix of drone 3."""
    return Measurements(
        tick,
        (
            PositionMeasurement(2, tick, (north_m, 1.0, -5.0), (0.25, 0.25, 0.25)),
            RangeMeasurement(2, tick, 3, 8.0, 0.25),
            AccelerationMeasurement(2, tick - 1, (0.5, 0.0, 0.0), (0.25, 0.25, 0.25)),
            PositionMeasurement(3, tick - 2, (1.0, 2.0, -3.0), (0.25, 0.25, 0.25)),
        ),
        exchange,
    )


def information(tick: int, seed: int = 1, round_: int = 0) -> Information:
    root = np.random.default_rng(seed).standard_normal((18, 18))
    matrix = root @ root.T + np.eye(18)
    return Information(tick, round_, tick - 6, 18, ROSTER, matrix, matrix @ np.arange(18.0))


def mean_of(pair: Information) -> np.ndarray:
    return np.linalg.solve(pair.information, pair.vector)


def tick_at(time_s: float) -> int:
    return 1000 + round(time_s / PERIOD_S)


@pytest.mark.parametrize("time_s", [FROM_S - 0.1, TO_S, TO_S + 5.0])
@pytest.mark.parametrize("fault", [LIE, STUCK])
def test_outside_the_fault_a_member_says_what_is_so(fault, time_s):
    member, tick = Member(fault), tick_at(time_s)
    assert member.said(measurements(tick), time_s) == measurements(tick)
    np.testing.assert_array_equal(mean_of(member.said(information(tick), time_s)), mean_of(information(tick)))


def test_a_liar_moves_its_own_fixes_and_nothing_else_that_it_measured():
    told = Member(LIE).said(measurements(1020), FROM_S)
    fix, *others = told.records
    np.testing.assert_allclose(np.subtract(fix.position_m, (7.0, 1.0, -5.0)), OFFSET_M)
    assert tuple(others) == measurements(1020).records[1:]


def test_a_liars_pairs_are_off_and_too_sure():
    honest = information(1020)
    told = Member(LIE).said(honest, FROM_S)
    moved = (mean_of(told) - mean_of(honest)).reshape(3, 6)
    np.testing.assert_allclose(moved[:, :3], [OFFSET_M] * 3, atol=1e-6)
    np.testing.assert_allclose(moved[:, 3:], 0.0, atol=1e-6)
    np.testing.assert_allclose(told.information, 100.0 * honest.information, rtol=1e-12)
    assert (told.tick, told.state_tick, told.rank) == (honest.tick, honest.state_tick, honest.rank)


def test_a_liar_about_itself_leaves_the_others_where_it_believes_them():
    honest = information(1020)
    about_itself = MemberWrong(agents=(2,), offset_m=OFFSET_M, lies_about="itself", variance_divisor=25.0)
    told = Member(about_itself).said(honest, FROM_S)
    moved = (mean_of(told) - mean_of(honest)).reshape(3, 6)
    np.testing.assert_allclose(moved[1, :3], OFFSET_M, atol=1e-6)
    np.testing.assert_allclose(np.delete(moved, slice(6, 9)), 0.0, atol=1e-6)
    np.testing.assert_allclose(told.information, 25.0 * honest.information, rtol=1e-12)


def test_a_liars_window_is_off_in_all_its_states():
    honest = WindowStates(1020, 1, 1018, 2, ROSTER, np.arange(54.0).reshape(3, 18))
    told = Member(LIE).said(honest, FROM_S)
    moved = (told.path - honest.path).reshape(3, 3, 6)
    np.testing.assert_allclose(moved[..., :3], np.broadcast_to(OFFSET_M, (3, 3, 3)))
    np.testing.assert_array_equal(moved[..., 3:], 0.0)


def test_a_liars_estimate_is_off_and_too_sure():
    honest = FleetEstimate(1020, 0, ROSTER, np.arange(18.0), np.full(18, 4.0), (0, 0, 1), 4.0 * np.eye(6))
    told = Member(LIE).said(honest, FROM_S)
    np.testing.assert_allclose((told.mean - honest.mean).reshape(3, 6)[:, :3], [OFFSET_M] * 3)
    np.testing.assert_allclose(told.variance, 0.04)
    np.testing.assert_allclose(told.own_covariance, 0.04 * np.eye(6))


def test_a_zombie_repeats_its_last_packets_with_fresh_stamps():
    # GIVEN a member that spoke in two exchanges and two rounds before it stuck
    member, before = Member(STUCK), 1019
    for exchange in (0, 1):
        member.said(measurements(before, north_m=7.0 + exchange, exchange=exchange), FROM_S - 0.1)
        member.said(information(before, seed=exchange, round_=exchange), FROM_S - 0.1)
    for tick in (1020, 1025):
        for exchange in (0, 1):
            # WHEN it has something new to say THEN it says the old, each in its place, as if it were of now
            new = measurements(tick, north_m=99.0, exchange=exchange)
            told = member.said(new, FROM_S + 0.1 * (tick - 1020))
            assert told == measurements(tick, north_m=7.0 + exchange, exchange=exchange)
            pair = member.said(information(tick, seed=9, round_=exchange), FROM_S + 0.1 * (tick - 1020))
            old = information(before, seed=exchange, round_=exchange)
            np.testing.assert_array_equal(pair.information, old.information)
            np.testing.assert_array_equal(pair.vector, old.vector)
            assert (pair.tick, pair.round, pair.state_tick) == (tick, exchange, tick - 6)
    # and what it says of its daemon stays true
    diagnostics = Diagnostics(2, "x", counters={"ticks": 3})
    assert member.said(diagnostics, FROM_S) == diagnostics


def test_a_zombie_without_a_past_repeats_its_first_packet():
    member = Member(STUCK)
    assert member.said(measurements(1020), FROM_S) == measurements(1020)
    assert member.said(measurements(1023, north_m=50.0), FROM_S + 0.3) == measurements(1023)


class Flight:
    """A signed fleet with faults, and its estimates by agent and tick."""

    def __init__(self, *overrides: str) -> None:
        config = load_config(LINE3, overrides)
        self.estimates: dict[tuple[int, int], EstimateReady] = {}
        around = Surroundings(identities={i: Identity(KEYS[i], TRUST) for i in ROSTER})
        run = FleetLockstep(config, make_estimator, self._on_estimate, surroundings=around)
        self.report = run.run(4.0)

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        self.estimates[agent.agent_id, ready.estimate.tick] = ready


@pytest.mark.parametrize(
    ("fault", "reasons"),
    [('kind="member_wrong", offset_m=[3.0, 4.0, 0.0]', set()), ('kind="member_stuck"', {"rejected repeated"})],
    ids=["liar", "zombie"],
)
def test_a_fleet_takes_the_signed_words_of_a_member_from_its_first_tick_on(fault, reasons):
    # GIVEN one flight with a fault of a member from 2.5 s on, and the same without
    clean, lied = Flight(), Flight(f"sim.faults=[{{{fault}, agents=[2], from_s=2.5}}]")
    # THEN its neighbours refuse what it repeats, and nothing else
    for agent_id in (1, 3):
        assert {name for name in lied.report.counters[agent_id] if name.startswith("rejected")} == reasons
    # and up to the fault the flights are equal, after it the neighbours estimate something else
    first = min(tick for _, tick in clean.estimates)
    begin = first + round(2.5 / PERIOD_S)
    assert clean.estimates.keys() == lied.estimates.keys()
    for (agent, tick), ready in clean.estimates.items():
        same = np.array_equal(ready.estimate.mean, lied.estimates[agent, tick].estimate.mean)
        if tick < begin - 1:
            assert same, (agent, tick)
        elif tick > begin + 3 and agent != 2:
            assert not same, (agent, tick)
