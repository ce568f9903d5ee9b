"""A changing fleet: removal is marginalisation, joining disturbs nobody, pairs of other fleets are mapped."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.consensus.mapping import FLAT_INFORMATION, mapped_pair, mapped_payload
from estimators.estimator import Estimate
from estimators.factory import make_estimator
from estimators.model.gaussian import marginal_pair
from estimators.model.layout import Layout, states_of
from estimators.model.measurements import RowTable, input_rows, position_rows, range_row, speed_row
from estimators.model.motion import input_matrix, transition_matrix
from estimators.model.unknown_motion import silence_sigma_m
from estimators.settings import EstimatorSettings
from tests.support.builders import fly, random_covariance

DT = 0.1
KINDS = ["dmhe_pre_ekf", "dmhe", "dmhe_shared", "dekf_ci"]


def settings(kind: str) -> EstimatorSettings:
    hold: Any = "hold" if kind == "dmhe_shared" else "zero"
    return EstimatorSettings(kind=kind, window=3, rounds=0, unknown_inputs=hold)  # type: ignore[arg-type]


class Flight:
    """A drone that measures a fleet of four by itself; of those in ``silent`` nothing is known from then on."""

    def __init__(self, kind: str, ids: tuple[int, ...] = (1, 2, 3, 4), seed: int = 3) -> None:
        rng = np.random.default_rng(seed)
        self.ids = ids
        self.states, self.accel = fly(rng, 4, 60, DT)
        self.noise = rng.normal(size=(61, 4, 8))
        covariance = random_covariance(rng, 24, 0.5)
        mean = self.states[0] + np.linalg.cholesky(covariance) @ rng.normal(size=24)
        at = states_of([i - 1 for i in ids])
        self.estimator: Any = make_estimator(settings(kind), Layout(ids), 0, mean[at], covariance[np.ix_(at, at)], DT)
        self.silent: dict[int, int] = {}

    def heard(self, agent: int, tick: int) -> bool:
        return agent in self.ids and tick < self.silent.get(agent, 1000)

    def rows(self, tick: int) -> RowTable:
        tables = []
        slots = {agent: slot for slot, agent in enumerate(self.ids)}
        for agent in self.ids:
            if not self.heard(agent, tick):
                continue
            slot, state = slots[agent], self.states[tick, 6 * agent - 6 : 6 * agent]
            noise = 0.05 * self.noise[tick, agent - 1]
            tables.append(position_rows(tick, slot, state[:3] + noise[:3], [0.0025] * 3))
            tables.append(speed_row(tick, slot, float(np.linalg.norm(state[3:]) + noise[3]), 0.0025))
            for other in (each for each in self.ids if each > agent and self.heard(each, tick)):
                away = state[:3] - self.states[tick, 6 * other - 6 : 6 * other - 3]
                tables.append(range_row(tick, slot, slots[other], float(np.linalg.norm(away) + noise[4]), 0.0025))
        return np.concatenate(tables)

    def run(self, first: int, last: int) -> list[Estimate]:
        estimates = []
        for tick in range(first, last):
            known = [agent for agent in self.ids if tick > 0 and self.heard(agent, tick)]
            inputs = [
                input_rows(tick - 1, self.ids.index(a), self.accel[tick - 1, 3 * a - 3 : 3 * a], 0.01) for a in known
            ]
            self.estimator.begin(tick, self.rows(tick), np.concatenate(inputs) if inputs else np.zeros(0, INPUT))
            estimates.append(self.estimator.solve())
        return estimates

    def change(self, ids: tuple[int, ...], fresh: dict[int, Any] | None = None) -> None:
        self.ids = ids
        self.estimator.change_members(ids, 1, fresh or {})


INPUT = input_rows(0, 0, np.zeros(3), 1.0).dtype


@pytest.mark.parametrize("kind", KINDS)
def test_a_silent_agent_is_removed_without_a_trace_in_the_others(kind: str) -> None:
    # GIVEN two equal flights in which agent 3 falls silent at tick 20, longer ago than the window reaches
    kept, removed = Flight(kind), Flight(kind)
    for flight in (kept, removed):
        flight.silent = {3: 20}
        flight.run(0, 30)
    # WHEN it is removed from one of them
    removed.change((1, 2, 4))
    at = states_of([0, 1, 3])
    for one, other in zip(kept.run(30, 45), removed.run(30, 45), strict=True):
        # THEN the blocks of the others are the marginals of the flight that keeps it
        assert other.mean == pytest.approx(one.mean[at], abs=1e-9)
        assert other.covariance == pytest.approx(one.covariance[np.ix_(at, at)], abs=1e-9)
        assert other.status == one.status
        assert other.age_ticks.tolist() == one.age_ticks[[0, 1, 3]].tolist()


@pytest.mark.parametrize("kind", KINDS)
def test_a_wide_newcomer_does_not_move_the_others_until_something_relates_them(kind: str) -> None:
    alone, joined = Flight(kind, (1, 2)), Flight(kind, (1, 2))
    for flight in (alone, joined):
        flight.run(0, 12)
    wide = (np.array([40.0, -30.0, 2.0, 0.0, 0.0, 0.0]), np.diag([2500.0] * 3 + [9.0] * 3))
    joined.change((1, 2, 4), {4: wide})
    joined.silent = {4: 0}
    at = states_of([0, 1])
    for one, other in zip(alone.run(12, 20), joined.run(12, 20), strict=True):
        assert other.mean[at] == pytest.approx(one.mean, abs=1e-9)
        assert other.covariance[np.ix_(at, at)] == pytest.approx(one.covariance, abs=1e-9)
        assert other.mean[12:18] == pytest.approx(wide[0], abs=1e-6)
        assert other.covariance[12, 12] > 2500.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_newcomer_is_known_as_well_as_the_others_after_a_window_of_its_fixes(kind: str) -> None:
    flight = Flight(kind, (1, 2))
    flight.run(0, 12)
    truth = flight.states[flight.estimator.prior_tick, 18:24]
    start = truth + np.array([0.3, -0.2, 0.1, 0.2, 0.2, 0.0])
    flight.change((1, 2, 4), {4: (start, np.diag([25.0] * 3 + [9.0] * 3))})
    last = flight.run(12, 26)[-1]
    error = last.mean - flight.states[25][states_of([0, 1, 3])]
    assert np.abs(error[12:15]).max() < 0.2
    assert 0.3 < float(error @ np.linalg.solve(last.covariance, error)) / 18 < 4.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_replaced_block_forgets_where_it_was_and_stays_in_order(kind: str) -> None:
    # GIVEN a drone that believes itself elsewhere, WHEN it is put to another place among known others
    flight = Flight(kind, (1, 2, 3))
    flight.run(0, 10)
    before = flight.estimator.window.rows()[0]
    place = (np.arange(6.0), 4.0 * np.eye(6))
    flight.change((1, 2, 3), {1: place})
    rows = flight.estimator.window.rows()[0]
    # THEN rows that name it are gone, those between the others are kept, and it is independent of them
    assert len(rows) == np.count_nonzero((before["agent"] != 0) & (before["other"] != 0)) > 0
    flight.estimator.begin(10, rows[:0], np.zeros(0, INPUT))
    told = flight.estimator.outgoing(0)
    assert not told.information[:6, 6:].any()
    mean, covariance = place
    if told.tick == 10:  # a filter: one tick after what the prior speaks of
        move, push = transition_matrix(1, DT), input_matrix(1, DT)
        mean, covariance = move @ mean, move @ covariance @ move.T + 4 / 3 * push @ push.T
    assert told.information[:6, :6] == pytest.approx(np.linalg.inv(covariance))
    assert np.linalg.solve(told.information, told.vector)[:6] == pytest.approx(mean)
    flight.estimator.solve()
    assert all(np.isfinite(e.mean).all() for e in flight.run(11, 20))


def test_agents_that_are_neither_old_nor_fresh_are_refused() -> None:
    flight = Flight("dmhe_shared", (1, 2))
    flight.run(0, 3)
    with pytest.raises(KeyError, match="agent 3 is not in the fleet"):
        flight.estimator.change_members((1, 2, 3), 1, {})


# --- pairs -------------------------------------------------------------------------------------------------

fleets = st.lists(st.integers(1, 7), min_size=1, max_size=5, unique=True)


@given(fleets, fleets, st.integers(0, 2**32 - 1))
def test_a_mapped_pair_is_the_dense_marginal_of_the_sender(sender: list[int], receiver: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    covariance = random_covariance(rng, 6 * len(sender), 2.0)
    mean = rng.normal(size=6 * len(sender))
    information = np.linalg.inv(covariance)
    mapped, vector = mapped_pair((information, information @ mean), sender, receiver)
    common = [agent for agent in receiver if agent in sender]
    there = states_of([receiver.index(agent) for agent in common])
    here = states_of([sender.index(agent) for agent in common])
    if common:
        dense = np.linalg.inv(covariance[np.ix_(here, here)])
        assert mapped[np.ix_(there, there)] == pytest.approx(dense, rel=1e-9, abs=1e-9)
        assert vector[there] == pytest.approx(dense @ mean[here], rel=1e-9, abs=1e-9)
    rest = np.setdiff1d(np.arange(len(vector)), there)
    assert not mapped[rest].any()
    assert not mapped[:, rest].any()
    assert not vector[rest].any()


@given(fleets, st.integers(0, 2**32 - 1))
def test_to_the_same_agents_in_another_order_nothing_is_lost(sender: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    information = random_covariance(rng, 6 * len(sender), 3.0)
    vector = rng.normal(size=6 * len(sender))
    shuffled = [sender[i] for i in rng.permutation(len(sender))]
    back = mapped_pair(mapped_pair((information, vector), sender, shuffled), shuffled, sender)
    assert back[0] == pytest.approx(0.5 * (information + information.T), abs=0)
    assert back[1] == pytest.approx(vector, abs=0)


def test_a_mapped_payload_is_definite_and_pulls_unknown_agents_nowhere() -> None:
    rng = np.random.default_rng(1)
    flight = Flight("dmhe_shared", (1, 2))
    flight.run(0, 6)
    payload = flight.estimator.outgoing(0)
    centre = 100.0 * rng.normal(size=18)
    mapped = mapped_payload(payload, (1, 2), (2, 3, 1), centre)
    assert np.linalg.eigvalsh(mapped.information)[0] > 0.5 * FLAT_INFORMATION
    assert np.linalg.solve(mapped.information, mapped.vector)[6:12] == pytest.approx(centre[6:12])
    assert (mapped.tick, mapped.rank) == (payload.tick, payload.rank)


def test_a_marginal_of_a_singular_rest_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        marginal_pair((np.diag([1.0] * 6 + [0.0] * 6), np.zeros(12)), [0])


def test_silence_widens_a_position_as_the_motion_model_says() -> None:
    covariance, n = np.zeros((6, 6)), 100
    move, push = transition_matrix(1, DT), input_matrix(1, DT)
    for _ in range(n):
        covariance = move @ covariance @ move.T + 4 / 3 * push @ push.T
    assert silence_sigma_m(n * DT, 4 / 3, DT) == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.02)
    assert silence_sigma_m(-1.0, 4 / 3, DT) == 0.0
