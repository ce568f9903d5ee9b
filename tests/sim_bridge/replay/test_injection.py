"""Faults laid over recorded flights: what the agents hear then, and what a replay makes of it."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import numpy as np
import pytest

from agent.sensing.samples import AttitudeSample, GpsSample, ImuSample
from sim_bridge.faults.fault_tables import FaultTable
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.feed import Feed, Inputs
from sim_bridge.replay.injection import Injection, parsed_faults
from sim_bridge.replay.plan import make_plan
from sim_bridge.replay.side_files.range_files import RangeLine
from sim_bridge.replay.synthesis import Synthesiser, SyntheticNoise
from sim_bridge.replay.what_if import GpsDrops
from tests.sim_bridge.replay.test_replay_engine import CENTRES, SECONDS, FlightLog, Run, fleet

FROM_S, TO_S = 3.0, 6.0
IDS = tuple(CENTRES)
WHILE = f"from_s={FROM_S}, to_s={TO_S}"


def parsed(*texts: str) -> tuple[FaultTable, ...]:
    return parsed_faults(texts, fleet(), IDS, (0.0, SECONDS))


class References:
    """Keeps the fixes that go to the comparison."""

    def __init__(self) -> None:
        self.fixes: list[GpsSample] = []

    def on_reference(self, agent_id: int, sample: Any, arrival_s: float) -> None:
        if isinstance(sample, GpsSample):
            self.fixes.append(sample)

    def close(self) -> None:
        pass


class Heard:
    """What the agents hear with faults, by kind: (agent or pair, seconds from the start) -> sample."""

    def __init__(self, *texts: str, seed: int = 1) -> None:
        config = fleet()
        plan = make_plan(config, [FlightLog(i) for i in IDS])
        maker = Synthesiser({i: config.neighbours(i) for i in IDS}, SyntheticNoise(), 1)
        injection = Injection(parsed(*texts), seed, plan.start_s)
        drops = GpsDrops([], IDS, plan.start_s, plan.end_s)
        inputs = Inputs(plan, drops, plan.start_s, plan.end_s, None, maker, injection=injection)
        self.references = References()
        self.feed = Feed(inputs, self.references)
        self.by_kind: dict[type, dict[Any, Any]] = defaultdict(dict)
        for _, agent_id, heard in self.feed.arrivals():
            if isinstance(heard, RangeLine):
                key = heard.observer, heard.target, round(heard.time_s - plan.start_s, 4)
                self.by_kind[RangeLine][key] = heard
            elif heard is not None:
                self.by_kind[type(heard)][agent_id, round(heard.t_s - plan.start_s, 4)] = heard


@pytest.fixture(scope="module")
def clean() -> Heard:
    return Heard()


def split(clean: Heard, faulty: Heard, kind: type, agent: int) -> list[tuple[float, Any, Any]]:
    """(time, clean, faulty) of one agent's samples inside the fault; all others have to be equal."""
    inside = []
    for key, was in clean.by_kind[kind].items():
        if key[0] == agent and FROM_S <= key[-1] < TO_S:
            inside.append((key[-1], was, faulty.by_kind[kind].get(key)))
        else:
            assert faulty.by_kind[kind][key] == was
    for other in {ImuSample, AttitudeSample, GpsSample, RangeLine} - {kind}:
        assert faulty.by_kind[other] == clean.by_kind[other]
    return inside


def test_a_jump_moves_fixes_and_not_their_velocity(clean: Heard) -> None:
    faulty = Heard(f'kind="gps_wrong", agents=[2], {WHILE}, offset_m=[30, 0, -2]')
    inside = split(clean, faulty, GpsSample, 2)
    assert len(inside) == 15
    for _, was, now in inside:
        np.testing.assert_allclose(np.subtract(now.position_m, was.position_m), (30.0, 0.0, -2.0), atol=1e-9)
        assert (now.ground_velocity_mps, now.t_s) == (was.ground_velocity_mps, was.t_s)
    # what the receiver said is what the comparison has as its word
    assert {now for _, _, now in inside} <= set(faulty.references.fixes)


def test_a_drift_drags_position_and_velocity_alike(clean: Heard) -> None:
    faulty = Heard(f'kind="gps_drift", agents=[1], {WHILE}, rate_mps=[0.5, -0.5, 0]')
    for time_s, was, now in split(clean, faulty, GpsSample, 1):
        moved_m = 0.5 * (time_s - FROM_S)
        np.testing.assert_allclose(np.subtract(now.position_m, was.position_m), (moved_m, -moved_m, 0.0), atol=1e-6)
        np.testing.assert_allclose(np.subtract(now.ground_velocity_mps, was.ground_velocity_mps), (0.5, -0.5))


def test_a_stuck_receiver_repeats_one_fix_with_rising_stamps(clean: Heard) -> None:
    inside = split(clean, Heard(f'kind="gps_stuck", agents=[3], {WHILE}'), GpsSample, 3)
    assert {(now.position_m, now.ground_velocity_mps) for _, _, now in inside} == {
        (inside[0][1].position_m, inside[0][1].ground_velocity_mps)
    }
    assert [now.t_s for _, _, now in inside] == [was.t_s for _, was, _ in inside]


def test_without_gps_no_fix_reaches_the_agent_and_it_is_counted(clean: Heard) -> None:
    faulty = Heard(f'kind="gps_off", agents=[2], {WHILE}')
    inside = split(clean, faulty, GpsSample, 2)
    assert [now for _, _, now in inside] == [None] * 15
    assert faulty.feed.dropped == {2: 15}


def test_accelerometers_get_a_bias_and_clip(clean: Heard) -> None:
    faulty = Heard(f'kind="accel_wrong", agents=[2], {WHILE}, bias_mps2=[0.1, 0, 0], limit_mps2=9.5')
    inside = split(clean, faulty, ImuSample, 2)
    assert len(inside) == 150
    for _, was, now in inside:
        expected = np.clip(np.add(was.specific_force_mps2, (0.1, 0.0, 0.0)), -9.5, 9.5)
        np.testing.assert_allclose(now.specific_force_mps2, expected)
    assert min(now.specific_force_mps2[2] for _, _, now in inside) == -9.5


def test_ranges_of_a_pair_are_too_long_both_ways(clean: Heard) -> None:
    faulty = Heard(f'kind="uwb_wrong", pairs=[[3, 1]], {WHILE}, bias_m=0.4')
    changed = set()
    for (observer, target, time_s), was in clean.by_kind[RangeLine].items():
        now = faulty.by_kind[RangeLine][observer, target, time_s]
        hit = {observer, target} == {1, 3} and FROM_S <= time_s < TO_S
        assert now.range_m - was.range_m == pytest.approx(0.4 if hit else 0.0, abs=1e-9)
        changed |= {(observer, target)} if hit else set()
    assert changed == {(1, 3), (3, 1)}


def test_ranges_are_stuck_or_said_of_another(clean: Heard) -> None:
    stuck = Heard(f'kind="uwb_stuck", pairs=[[3, 1]], {WHILE}').by_kind[RangeLine]
    swapped = Heard(f'kind="uwb_swapped", agents=[2], between=[1, 3], {WHILE}').by_kind[RangeLine]
    said: dict[tuple[int, int], set[float]] = defaultdict(set)
    for (observer, target, time_s), was in clean.by_kind[RangeLine].items():
        during = FROM_S <= time_s < TO_S
        if during and {observer, target} == {1, 3}:
            said[observer, target].add(stuck[observer, target, time_s].range_m)
        else:
            assert stuck[observer, target, time_s] == was
        said_of = {1: 3, 3: 1}[target] if during and observer == 2 else target
        assert swapped[observer, said_of, time_s].range_m == was.range_m
    assert [len(each) for each in said.values()] == [1, 1]


def test_what_is_random_follows_the_seed() -> None:
    block = f'kind="uwb_wrong", agents=[1], {WHILE}, nlos_share=0.5'
    one, same, other = (Heard(block, seed=seed).by_kind[RangeLine] for seed in (1, 1, 2))
    assert one == same
    assert one != other


def test_a_member_of_a_replay_lies_to_the_others() -> None:
    lie = parsed(f'kind="member_wrong", agents=[2], {WHILE}, offset_m=[0, 5, 0]')
    honest, lied = Run(to_s=FROM_S + 1.5), Run(to_s=FROM_S + 1.5, faults=lie)
    for agent_id in IDS:
        for one, other in zip(honest.estimates[agent_id], lied.estimates[agent_id], strict=True):
            if one.t_s - honest.start_s < FROM_S - 0.25:
                assert one.estimate.mean.tobytes() == other.estimate.mean.tobytes()
    victims = [lied.errors_m(agent_id, FROM_S + 0.5).max() for agent_id in (1, 3)]
    assert max(victims) < 0.3
    # what it said was refused, by whose it was, and nothing of an honest drone was
    refused = "information: refused of 2"
    assert all(lied.counts.agents[agent_id][refused] > 10 for agent_id in (1, 3))
    assert not any(refused in honest.counts.agents[agent_id] for agent_id in (1, 3))
    assert not [name for name in lied.counts.agents[1] if name.startswith("rejected")]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gps_off", "--fault: expected kind="),
        ('kind="gps_of", agents=[1]', "--fault: kind: expected one of gps_off, .*found 'gps_of'"),
        ('kind="gps_off", agents=[9]', r"--fault: agents: expected ids of agents \(1, 2, 3\), found 9"),
        ('kind="gps_off", agents=[1], from_s=5, to_s=4', "--fault: to_s: expected later than from_s = 5, found 4"),
        ('kind="gps_off", agents=[1], from_s=500', "--fault: expected a part of what is replayed, 0.0 .*found 500"),
    ],
)
def test_a_fault_that_cannot_be_is_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(ReplayError, match=words) as refused:
        parsed(text)
    assert "\n" not in str(refused.value)


def test_a_fault_of_a_drone_without_a_log_is_refused() -> None:
    with pytest.raises(ReplayError, match=r"--fault: agents: expected drones with a log \(1, 2\), found 3"):
        parsed_faults(['kind="gps_off", agents=[3]'], fleet(), (1, 2), (0.0, math.inf))
