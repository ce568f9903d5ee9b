"""The consensus MHE: frozen cases, limits, membership, and what it does with bad windows of neighbours."""

from __future__ import annotations

import ast
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.algorithms.consensus_mhe import ConsensusMovingHorizonEstimator
from estimators.consensus.information import metropolis_weights
from estimators.estimator import Payload, Status
from estimators.model.layout import BodyKind, Layout, block
from estimators.model.measurements import (
    RowTable,
    empty_rows,
    input_rows,
    position_rows,
    range_row,
    velocity_rows,
)
from estimators.settings import EstimatorSettings, LocalWindowTable
from estimators.solvers.qp import make_engine
from estimators.window.local_problem import LocalModel, LocalWindow, solve_local

CASES = Path(__file__).resolve().parents[2] / "data" / "targets"
SHARP = 1e-9
"""Smoothing of norms in m: the cases have none."""


@dataclass(frozen=True)
class Case:
    """A frozen case: arrays by name, and the reference's parameters."""

    arrays: dict[str, NDArray[Any]]
    parameters: dict[str, Any]

    @classmethod
    def load(cls, path: Path) -> Case:
        with np.load(path) as found:
            arrays = {name: found[name] for name in found.files}
        text = str(arrays.pop("params", "{}"))
        return cls(arrays, ast.literal_eval(text))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.arrays[name]

    def model(self) -> LocalModel:
        p = self.parameters
        return LocalModel(
            own_process=(p["qp"], p["qv"]),
            target_process=(p["tqp"], p["tqv"]),
            own_prior=(p["ap"], p["av"]),
            target_prior=(p["tap"], p["tav"]),
            neighbour_sigma_m=p["snbr"],
            range_gate_m=np.inf if p["gate"] is None else p["gate"],
            box_m=p["Rs"],
            ceiling_m=np.inf if p["tDmin"] is None else -p["tDmin"],
        )

    def rows(self, tick: int, agent: int, targets: tuple[int, ...], ranges: NDArray[Any]) -> RowTable:
        """What an agent measured; ``ranges`` ``(B,)``, NaN where it saw nothing."""
        p, gps = self.parameters, self["gps"]
        fix = gps[tick] if gps.ndim == 2 else gps[tick, agent]
        tables = [empty_rows()]
        if np.isfinite(fix[:3]).all():
            tables.append(position_rows(tick, agent, fix[:3], [p["sp"] ** 2] * 3))
        if np.isfinite(fix[3:]).all():
            tables.append(velocity_rows(tick, agent, fix[3:], [p["sv"] ** 2] * 3))
        for other in np.flatnonzero(np.isfinite(ranges)).tolist():
            sigma = p["st"] if other in targets else p["sr"]
            tables.append(range_row(tick, agent, other, float(ranges[other]), sigma**2))
        return np.concatenate(tables)


def local_window(case: Case) -> LocalWindow:
    path, own = case["Xi"], int(case["i"])
    targets = tuple(case["tg"].tolist())
    slots, bodies = path.shape[:2]
    tables = []
    for s in range(slots):
        ranges = np.full(bodies, np.nan)
        seen = case["nbr_idx"][s] >= 0
        ranges[case["nbr_idx"][s][seen]] = case["nbr_r"][s][seen]
        ranges[list(targets)] = case["tgt_r"][s]
        tables.append(case.rows(s, own, targets, ranges))
    start = np.concatenate(([0], np.cumsum([len(table) for table in tables])))
    bodies_of = (own, *targets)
    period_s = case.parameters["Ts"]
    flat = path.reshape(slots, -1)
    return LocalWindow(flat, bodies_of, case["prior"], np.concatenate(tables), start, case["U"], period_s, SHARP)


@pytest.mark.parametrize("name", ["dmhe_localqp_free", "dmhe_localqp_box"])
def test_the_local_problem_is_the_frozen_one(name: str) -> None:
    case = Case.load(CASES / f"{name}.npz")
    solution = solve_local(local_window(case), case.model(), make_engine("osqp"))
    assert solution.solved
    assert bool(solution.programs) == (name != "dmhe_localqp_free")
    np.testing.assert_allclose(solution.states, case["x"], rtol=0.0, atol=float(case["atol"]))


def test_a_target_stays_under_its_ceiling_at_the_least_cost() -> None:
    # GIVEN a problem whose target comes out below the origin, and a ceiling further down
    case = Case.load(CASES / "dmhe_localqp_free.npz")
    window, model = local_window(case), replace(case.model(), ceiling_m=-3.0)
    free = solve_local(window, case.model(), make_engine("osqp"))
    assert free.states[:, 1, 2].max() < 3.0
    # WHEN it is solved with the limit
    limited = solve_local(window, model, make_engine("osqp"))
    # THEN all states keep it, one at least by touching it
    assert limited.active > 0
    assert limited.states[:, 1, 2].min() == pytest.approx(3.0, abs=1e-6)


def test_metropolis_weights_are_the_frozen_ones() -> None:
    case = Case.load(CASES / "dmhe_metropolis.npz")
    for graph in ("chain", "cycle", "ladder", "fail"):
        linked, expected = case[f"adj_{graph}"], case[f"W_{graph}"]
        degree = linked.sum(axis=1)
        for agent in range(len(linked)):
            others = np.flatnonzero(linked[agent])
            own, weights = metropolis_weights(int(degree[agent]), [int(d) for d in degree[others]])
            found = np.zeros(len(linked))
            found[agent], found[others] = own, weights
            np.testing.assert_allclose(found, expected[agent], rtol=float(case["rtol"]), atol=1e-16)


def fleet(case: Case, bodies: int) -> list[ConsensusMovingHorizonEstimator]:
    p, count = case.parameters, len(case["X0"])
    settings = EstimatorSettings(
        kind="consensus_mhe",
        window=p["N"],
        rounds=p["L"],
        norm_smoothing_m=SHARP,
        local_window=LocalWindowTable(reinject_own=p["reinject"]),
    )
    kinds = (BodyKind.VEHICLE,) * count + (BodyKind.TARGET,) * (bodies - count)
    layout = Layout(tuple(range(1, bodies + 1)), kinds)
    return [
        ConsensusMovingHorizonEstimator(
            settings, layout, slot, case["X0"][slot].ravel(), np.eye(6 * bodies), p["Ts"], case.model()
        )
        for slot in range(count)
    ]


def run_fleet(case: Case) -> NDArray[Any]:
    """States ``(T, n, B, 6)``, every agent's at every tick."""
    ticks, count, bodies = case["xhat"].shape[:3]
    agents, targets = fleet(case, bodies), tuple(range(count, bodies))
    found = np.empty(case["xhat"].shape)
    for tick in range(ticks):
        linked = case["adj"][tick]
        for slot, agent in enumerate(agents):
            inputs = input_rows(tick - 1, slot, case["u_meas"][tick, slot], 1.0)
            agent.begin(tick, case.rows(tick, slot, targets, case["ranges"][tick, slot]), inputs[: tick > 0])
        for round_ in range(case.parameters["L"]):
            # the reference knows the graph of a tick; agents know it after the first round
            sent = [
                replace(agent.outgoing(round_), degree=int(linked[slot].sum())) for slot, agent in enumerate(agents)
            ]
            for slot, agent in enumerate(agents):
                agent.mix(round_, {other: sent[other] for other in np.flatnonzero(linked[slot]).tolist()})
        for slot, agent in enumerate(agents):
            found[tick, slot] = agent.solve().mean.reshape(bodies, 6)
    return found


@pytest.mark.parametrize("path", sorted(CASES.glob("dmhe_fleet_*.npz")), ids=lambda path: path.stem)
def test_a_fleet_estimates_as_the_frozen_one(path: Path) -> None:
    case = Case.load(path)
    np.testing.assert_allclose(run_fleet(case), case["xhat"], rtol=0.0, atol=float(case["atol"]))


# --- what it does with the rest ---------------------------------------------------------------------------------

SETTINGS = EstimatorSettings(kind="consensus_mhe", rounds=1, weights="metropolis")
DT = 1.0


def hovering(agents: tuple[int, ...] = (1, 2, 3)) -> ConsensusMovingHorizonEstimator:
    """The first of three drones, each held by its prior."""
    mean = np.concatenate([[10.0 * agent, 0.0, 0.0, 0.0, 0.0, 0.0] for agent in agents])
    return ConsensusMovingHorizonEstimator(SETTINGS, Layout(agents), 0, mean, np.eye(len(mean)), DT)


def tick_alone(
    estimator: ConsensusMovingHorizonEstimator, tick: int, received: dict[int, Payload] | None = None
) -> Any:
    place = [10.0 * estimator.layout.agents[estimator.slot], 0.0, 0.0]
    estimator.begin(
        tick, position_rows(tick, estimator.slot, place, [0.01] * 3), input_rows(tick - 1, 0, [0] * 3, 1.0)
    )
    estimator.mix(0, received or {})
    return estimator.solve()


def test_a_neighbours_window_moves_what_is_known_of_others_and_not_the_own_place() -> None:
    estimator = hovering()
    estimator.begin(0, position_rows(0, 0, [10.0, 0.0, 0.0], [0.01] * 3), input_rows(0, 0, [0] * 3, 1.0)[:0])
    theirs = estimator.outgoing(0)
    assert theirs.path is not None
    moved = theirs.path + 4.0
    estimator.mix(0, {1: replace(theirs, path=moved, degree=1)})
    estimate = estimator.solve()
    assert estimate.mean[block(0)] == pytest.approx(theirs.path[-1, block(0)])
    assert estimate.mean[block(2)] == pytest.approx(theirs.path[-1, block(2)] + 2.0)


@pytest.mark.parametrize("wrong", ["not finite", "another shape", "another tick", "a pair"])
def test_a_window_that_cannot_be_averaged_is_left_out(wrong: str) -> None:
    estimator, twin = hovering(), hovering()
    for each in (estimator, twin):
        tick_alone(each, 0)
        each.begin(1, position_rows(1, 0, [10.0, 0.0, 0.0], [0.01] * 3), input_rows(0, 0, [0] * 3, 1.0))
    theirs = estimator.outgoing(0)
    assert theirs.path is not None
    payload = {
        "not finite": replace(theirs, path=np.full_like(theirs.path, np.nan)),
        "another shape": replace(theirs, path=theirs.path[1:]),
        "another tick": replace(theirs, tick=theirs.tick + 1, path=theirs.path + 5.0),
        "a pair": Payload(theirs.tick, np.eye(18), np.zeros(18), 6),
    }[wrong]
    estimator.mix(0, {1: payload})
    twin.mix(0, {})
    assert estimator.refused_pairs == (wrong != "another tick")
    np.testing.assert_array_equal(estimator.solve().mean, twin.solve().mean)


def test_a_drone_that_joins_begins_with_its_prior_and_moves_nobody() -> None:
    estimator = hovering()
    for tick in range(4):
        before = tick_alone(estimator, tick)
    fresh = np.array([1.0, 2.0, 3.0, 0.5, 0.0, 0.0])
    estimator.change_members((1, 3, 7), 1, {7: (fresh, np.eye(6))})
    lead_s = (4 - estimator.prior_tick) * DT
    after = tick_alone(estimator, 4)
    assert after.mean[block(1)] == pytest.approx(before.mean[block(2)], abs=1e-9)
    assert after.mean[block(2)] == pytest.approx(fresh + np.array([0.5 * lead_s, 0, 0, 0, 0, 0]))


def test_it_says_when_there_is_nothing_to_go_by() -> None:
    estimator = hovering()
    estimator.begin(0, empty_rows(), input_rows(0, 0, [0] * 3, 1.0)[:0])
    estimator.mix(0, {})
    estimate = estimator.solve()
    assert estimate.status is Status.NO_DATA
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
