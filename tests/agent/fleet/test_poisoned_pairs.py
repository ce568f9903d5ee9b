"""A member whose information pairs are wrong and sure: nobody else is moved, and whose they were is counted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.config.tables import FleetConfig
from estimators.estimator import Estimator, Payload
from estimators.factory import make_estimator
from estimators.model.layout import Layout, position
from tests.support.circling_fleet import CirclingFleet, position_of

LIAR = 2
FROM_TICK = 30
OFFSET = np.array([3.0, -4.0, 0.0, 0.0, 0.0, 0.0])


class PoisonedPairs:
    """An estimator that is right, and tells its neighbours something else from `FROM_TICK` of its ticks on."""

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self._first: int | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimator, name)

    def outgoing(self, round_: int) -> Payload:
        pair = self._estimator.outgoing(round_)
        self._first = pair.tick if self._first is None else self._first
        if pair.tick < self._first + FROM_TICK:
            return pair
        shift = np.tile(OFFSET, len(pair.vector) // 6)
        mean = np.linalg.solve(pair.information, pair.vector) + shift
        return Payload(pair.tick, 100.0 * pair.information, 100.0 * pair.information @ mean, pair.rank)


def factory(liars: tuple[int, ...]) -> Any:
    def make(settings: Any, layout: Layout, slot: int, *rest: Any) -> Any:
        estimator = make_estimator(settings, layout, slot, *rest)
        return PoisonedPairs(estimator) if layout.agents[slot] in liars else estimator

    return make


def flown(config: FleetConfig, liars: tuple[int, ...], loss: float) -> CirclingFleet:
    """Nine seconds, the lies in the last six, with packets lost at random."""
    rng = np.random.default_rng(3)
    fleet = CirclingFleet(config, factory=factory(liars), cut=lambda *_: rng.random() < loss)
    fleet.run(9.0)
    return fleet


def worst_m(fleet: CirclingFleet) -> float:
    """Largest error of any position that an agent but the liar holds, in the last five seconds."""
    worst = 0.0
    for agent_id, estimates in fleet.estimates.items():
        for ready in estimates[-50:] if agent_id != LIAR else []:
            for slot, other in enumerate(fleet.config.ids):
                error = ready.estimate.mean[position(slot)] - position_of(other, ready.t_s)[0]
                worst = max(worst, float(np.linalg.norm(error)))
    return worst


def refused(fleet: CirclingFleet) -> dict[int, int]:
    """How many pairs the agents have refused, by sender."""
    counts = dict.fromkeys(fleet.config.ids, 0)
    for core in fleet.cores.values():
        for agent_id in counts:
            counts[agent_id] += core.counters[f"information: refused of {agent_id}"]
    return counts


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_a_poisoned_neighbour_moves_nobody_and_is_counted(make_config: Any, loss: float) -> None:
    # GIVEN a fleet with one member whose pairs are 5 m off with a hundredth of their covariance, and the same without
    config = make_config(3, "estimator.kind=dmhe_shared")
    clean, lied = flown(config, (), loss), flown(config, (LIAR,), loss)
    # THEN nobody refuses an honest pair
    assert refused(clean) == dict.fromkeys(config.ids, 0)
    counts = refused(lied)
    assert counts.pop(LIAR) > 100
    assert not any(counts.values())
    # and nobody is moved
    assert worst_m(lied) < 1.3 * worst_m(clean)
