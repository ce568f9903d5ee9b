"""Situational awareness: the scenario, and what agents make of it in flight."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from msgspec import convert

from estimators.settings import EstimatorSettings, with_kind_defaults
from sim_bridge.studies.awareness import (
    DRONES,
    EDGES,
    FAILING,
    RANGE_SIGMA_M,
    SIGHT_M,
    TARGET_BIAS_M,
    AwarenessScenario,
    measure,
)
from sim_bridge.studies.awareness_flight import AwarenessFlight, config_of, fly_awareness

UNDER = (-40.0, 20.0, 0.0, 3.0, 0.3, 0.0)
CEILING: Mapping[str, Any] = {"limits": {"target": {"ceiling_m": 5.0}}}
OWN = range(DRONES)


def settings(kind: str, rounds: int, **more: Any) -> EstimatorSettings:
    return convert(with_kind_defaults({"kind": kind, "rounds": rounds, **more}), EstimatorSettings)


def with_target(duration_s: float) -> AwarenessScenario:
    return AwarenessScenario("cycle", duration_s, 5.0, False, (40.0, 60.0), UNDER)


@functools.cache
def flown(kind: str, rounds: int, duration_s: float, target: bool) -> AwarenessFlight:
    scenario = with_target(duration_s) if target else AwarenessScenario("cycle", duration_s)
    return fly_awareness(measure(scenario, 0), settings(kind, rounds, **(CEILING if target else {})))


def test_what_is_measured_is_the_truth_with_the_stated_noise() -> None:
    found = measure(with_target(100.0), 3)
    truth = found.truth
    # positions follow from velocities and velocities from accelerations
    np.testing.assert_allclose(truth[1:, OWN, 3:] - truth[:-1, OWN, 3:], np.diff(truth[:, OWN, 3:], axis=0))
    np.testing.assert_allclose(
        truth[1:, :, :3] - truth[:-1, :, :3], 0.5 * (truth[1:, :, 3:] + truth[:-1, :, 3:]), atol=1e-9
    )
    away = np.linalg.norm(truth[:, OWN, None, :3] - truth[:, None, :, :3], axis=-1)
    between = (found.ranges - away)[:, :, :DRONES]
    seen = np.isfinite(between)
    assert (seen == (away[:, :, :DRONES] <= SIGHT_M) & ~np.eye(DRONES, dtype=bool)).all()
    assert between[seen].std() == pytest.approx(RANGE_SIGMA_M, rel=0.05)
    to_target = (found.ranges - away)[:, :, DRONES]
    assert to_target.mean() == pytest.approx(TARGET_BIAS_M, abs=0.1)
    assert (found.gps - truth[:, OWN])[..., :3].std() == pytest.approx(1.0, rel=0.05)


def test_graphs_are_the_papers() -> None:
    degree = {name: np.bincount(np.array(edges).ravel(), minlength=DRONES + 1)[1:] for name, edges in EDGES.items()}
    assert (degree["cycle"] == 2).all()
    assert sorted(degree["chain"]) == [1, 1, 2, 2, 2, 2, 2, 2, 2]
    assert sorted(degree["ladder"]) == [2, 2, 2, 3, 3, 3, 3, 3, 3]
    assert {frozenset(edge) for edge in FAILING} <= {frozenset(edge) for edge in EDGES["cycle"]}


def test_the_consensus_mhe_knows_its_neighbour_better_than_who_is_far_off() -> None:
    flight = flown("consensus_mhe", 4, 70.0, target=False)
    error_m = flight.error_m[40:]
    assert flight.ok[40:].all()
    assert np.isfinite(error_m).all()
    assert error_m[:, OWN, OWN].mean() < 1.0
    assert error_m[:, 0, 1].mean() < error_m[:, 0, 8].mean()


def test_a_target_is_located_by_its_ranges_and_costs_the_drones_nothing() -> None:
    # GIVEN nine drones over a target that walks, of which they are told no more than that it is on the ground
    flight = flown("dmhe_shared", 2, 45.0, target=True)
    error_m, nees = flight.error_m[:, 0, DRONES], flight.nees[:, 0, DRONES]
    # THEN it is no part of the estimate until the drones are and it is located, and near from then on
    known = np.flatnonzero(np.isfinite(error_m))
    assert np.flatnonzero(np.isfinite(flight.error_m[:, 0, 0]))[0] < known[0] <= 8
    assert np.isfinite(error_m[known[0] :]).all()
    assert error_m[30:].mean() < 1.5
    assert 0.1 < np.nanmean(nees[30:]) < 3.0
    # and the drones know themselves
    assert flight.error_m[30:, OWN, OWN].mean() < 1.0


def test_a_configuration_has_a_target_only_where_the_scenario_has() -> None:
    with_one = config_of(measure(with_target(2.0), 0), settings("dmhe_shared", 2))
    assert with_one.bodies == (*with_one.ids, 101)
    without = config_of(measure(AwarenessScenario("cycle", 2.0), 0), settings("dmhe_shared", 2))
    assert without.bodies == without.ids
