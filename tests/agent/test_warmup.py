"""Warming up: the estimator that is to come is run once before the flight."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from agent.config.tables import FleetConfig
from agent.warmup import warm_up
from estimators.estimator import Status
from estimators.factory import make_estimator

MakeConfig = Callable[..., FleetConfig]


@pytest.mark.parametrize("kind", ["dekf_ci", "dmhe_pre_ekf"])
def test_warming_up_runs_the_estimator_that_is_to_come(make_config: MakeConfig, kind: str) -> None:
    solved = []

    def factory(*arguments: Any) -> Any:
        made = make_estimator(*arguments)
        solve = made.solve
        made.solve = lambda budget=None: solved.append(solve(budget))  # type: ignore[assignment,method-assign,func-returns-value]
        return made

    warm_up(make_config(3, f"estimator.kind={kind}"), 2, factory)
    assert len(solved) == 3
    assert {estimate.status for estimate in solved} <= {Status.OK, Status.NOT_CONVERGED}


FLIGHT = """
import os, sys
from pathlib import Path
from agent.config.reading import load_config
from agent.warmup import warm_up
from estimators.compiled import entries as compiled
from estimators.factory import make_estimator
from sim_bridge.virtual.fleet_lockstep import FleetLockstep

config = load_config(Path(sys.argv[1]))
warm_up(config, 1, make_estimator)
os.environ["FLEETLOC_CACHE"] = sys.argv[2]
said, ready = [], []
compiled.on_progress(lambda progress: said.append(f"{progress.what} {progress.name} {progress.detail}"))
FleetLockstep(config, make_estimator, lambda agent, estimate: ready.append(estimate), "values").run(4.0)
print(len(ready), said)
"""


def test_in_flight_no_kernel_is_looked_for_any_more(tmp_path: Path) -> None:
    # GIVEN a warm daemon, WHEN the folder of the kernels is gone, THEN a flight compiles nothing
    line3 = Path(__file__).parents[2] / "configs" / "line3.toml"
    command = [sys.executable, "-c", FLIGHT, str(line3), str(tmp_path / "gone")]
    flown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    count, _, said = flown.stdout.partition(" ")
    assert int(count) >= 3 * 39
    assert said.strip() == "[]"
    assert not (tmp_path / "gone").exists()
