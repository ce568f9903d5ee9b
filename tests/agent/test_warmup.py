"""Warming up: the estimator that is to come is run once before the flight."""

from __future__ import annotations

from collections.abc import Callable
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
