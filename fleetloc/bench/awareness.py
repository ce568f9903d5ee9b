"""``fleetloc bench awareness``: who knows where the others are, and a target, over a sparse graph.

The four tests of Bassolillo, D'Amato and Notaro 2025, flown by the drones' own agents in virtual time; noises and
paths are ours (`sim_bridge.studies.awareness`). Their estimator, reconstructed, is the kind ``consensus_mhe``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimators.settings import EstimatorSettings, with_kind_defaults
from fleetloc.output import print_table, progress_bar
from sim_bridge.studies.awareness import DRONES, TARGET_BIAS_M, AwarenessScenario, Graph, measure
from sim_bridge.studies.awareness_flight import AwarenessFlight, fly_awareness
from sim_bridge.studies.monte_carlo import Hangar

Floats = NDArray[np.float64]

SETTLED_S = 50
"""From here on the fleet is taken to have found itself."""
OUTAGES = ((60.0, 90.0), (120.0, 150.0))
FOUND_M = 5.0
CEILING_M = 5.0
"""Altitude that no target is above, below the fleet: what a user says who knows that targets are on the ground."""
SCENARIOS: Mapping[str, AwarenessScenario] = {
    "1": AwarenessScenario(),
    "2": AwarenessScenario(duration_s=180.0, hover=False, outages=OUTAGES),
    "3-under": AwarenessScenario(
        duration_s=150.0, speed_mps=5.0, hover=False, spacing_m=(40.0, 60.0), target=(-40.0, 20.0, 0.0, 0.0, 0.0, 0.0)
    ),
    "3-ahead": AwarenessScenario(
        duration_s=150.0, speed_mps=5.0, hover=False, spacing_m=(40.0, 60.0), target=(150.0, 30.0, 0.0, 0.0, 0.0, 0.0)
    ),
    "4-under": AwarenessScenario(
        duration_s=150.0, speed_mps=5.0, hover=False, spacing_m=(40.0, 60.0), target=(-40.0, 20.0, 0.0, 3.0, 0.3, 0.0)
    ),
    "4-ahead": AwarenessScenario(
        duration_s=150.0, speed_mps=5.0, hover=False, spacing_m=(40.0, 60.0), target=(200.0, 20.0, 0.0, 3.0, 0.3, 0.0)
    ),
}
"""By test; what a target's place is relative to the fleet stands behind its number."""


@dataclass(frozen=True, slots=True)
class AwarenessPlan:
    """One row of the table: a test, a graph, an estimator."""

    test: str
    graph: Graph
    kind: str
    rounds: int
    window: int | None
    loss: float
    seed: int

    def settings(self) -> EstimatorSettings:
        """Of the estimator; all else are its kind's defaults."""
        table: dict[str, Any] = {"kind": self.kind, "rounds": self.rounds}
        if self.window is not None:
            table["window"] = self.window
        if self.scenario().target is not None:
            table["limits"] = {"target": {"ceiling_m": CEILING_M}}
        return msgspec.convert(with_kind_defaults(table), EstimatorSettings)

    def scenario(self) -> AwarenessScenario:
        """What is flown."""
        found = SCENARIOS[self.test]
        return AwarenessScenario(
            self.graph, found.duration_s, found.speed_mps, found.hover, found.spacing_m, found.target, found.outages
        )


def fly_run(plan: AwarenessPlan, run: int) -> dict[str, float]:
    """The figures of one run."""
    flight = fly_awareness(measure(plan.scenario(), plan.seed + run), plan.settings(), loss=plan.loss, seed=run)
    own = range(DRONES)
    found = {
        "own_position_m": float(flight.error_m[SETTLED_S:, own, own].mean()),
        "anees_own_position": _mean(flight.nees[SETTLED_S:, own, own]),
        "availability": float(flight.ok[SETTLED_S:].mean()),
    }
    if plan.test == "1":
        return found | of_others(flight)
    if plan.test == "2":
        return found | of_outages(flight)
    return found | of_target(flight)


def of_others(flight: AwarenessFlight) -> dict[str, float]:
    """Test 1: what drone 1 knows of its neighbour and of the farthest, and all of all."""
    error_m = flight.error_m[SETTLED_S:]
    return {
        "error_of_2_seen_by_1_m": float(error_m[:, 0, 1].mean()),
        "error_of_9_seen_by_1_m": float(error_m[:, 0, 8].mean()),
        "error_of_all_m": float(error_m.mean()),
        "anees_of_9_seen_by_1": _mean(flight.nees[SETTLED_S:, 0, 8]),
    }


def of_outages(flight: AwarenessFlight) -> dict[str, float]:
    """Test 2: what drone 1 knows of drone 8, which an outage separates from it."""
    error_m, nees = flight.error_m[:, 0, 7], flight.nees[:, 0, 7]
    spans = {"before": (40, 60), "late_in_outage": (70, 90), "3s_after": (93, 103)}
    found = {f"error_of_8_seen_by_1_{name}_m": float(error_m[a:b].mean()) for name, (a, b) in spans.items()}
    return found | {"anees_of_8_seen_by_1_in_outage": _mean(nees[60:90])}


def of_target(flight: AwarenessFlight) -> dict[str, float]:
    """Tests 3 and 4: the target seen by drone 1. Before it is known its error is infinite."""
    error_m, nees = flight.error_m[:, 0, DRONES], flight.nees[:, 0, DRONES]
    near = np.flatnonzero(error_m < FOUND_M)
    return {
        "found_after_s": float(near[0]) if len(near) else np.inf,
        "error_of_target_50s_to_100s_m": float(error_m[50:100].mean()),
        "error_of_target_from_100s_m": float(error_m[100:].mean()),
        "anees_of_target": _mean(nees[SETTLED_S:]),
        "bias_of_target_off_by_m": _mean(np.abs(flight.bias_m[SETTLED_S:, 0] - TARGET_BIAS_M)),
        "share_beyond_5_sigma": float((nees[np.isfinite(nees)] * 3.0 > 25.0).mean())
        if np.isfinite(nees).any()
        else 0.0,
    }


def _mean(values: Floats) -> float:
    """Of what is there; NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def awareness(plans: Sequence[AwarenessPlan], *, runs: int, jobs: int) -> dict[str, Any]:
    """Fly the plans, print one table a test, return the figures."""
    rows: list[dict[str, Any]] = []
    with Hangar(min(jobs, runs)) as hangar, progress_bar("runs", runs * len(plans)) as advance:
        for plan in plans:
            found = []
            for each in hangar.map(partial(fly_run, plan), range(runs)):
                found.append(each)
                advance()
            figures = {key: float(np.mean([each[key] for each in found])) for key in found[0]}
            spread = float(np.std([each["own_position_m"] for each in found]))
            rows.append(msgspec.to_builtins(plan) | {"runs": runs} | figures | {"own_position_sd_m": spread})
    for test in dict.fromkeys(plan.test for plan in plans):
        _print([row for row in rows if row["test"] == test], test)
    return {"rows": rows}


def _print(rows: Sequence[Mapping[str, Any]], test: str) -> None:
    keys = [key for key in rows[0] if key not in ("test", "seed", "window", "runs", "own_position_sd_m")]
    cells = [[f"{row[key]:.3g}" if isinstance(row[key], float) else str(row[key]) for key in keys] for row in rows]
    print_table([key.replace("_", " ") for key in keys], cells, title=f"Test {test}, {rows[0]['runs']} runs")
