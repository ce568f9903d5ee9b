"""What kinds of estimators are called, and what they say of themselves."""

from __future__ import annotations

from typing import get_args

import msgspec
import numpy as np
import pytest

from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.settings import DEFAULT_KIND, FORMER_KINDS, EstimatorSettings, Kind, with_kind_defaults

KINDS = get_args(Kind)


@pytest.mark.parametrize("former", FORMER_KINDS)
def test_a_former_name_stands_for_the_present_kind_with_its_defaults(former: str) -> None:
    # GIVEN a table that calls a kind by a former name, and one of its keys
    table = with_kind_defaults({"kind": former, "window": 9})
    # THEN it is read as the present kind's, and shown so
    assert msgspec.convert(table, EstimatorSettings) == msgspec.convert(
        with_kind_defaults({"kind": FORMER_KINDS[former], "window": 9}), EstimatorSettings
    )
    assert table["kind"] in KINDS
    assert former not in KINDS


def test_a_kind_that_never_was_is_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match="dmhe_raley"):
        msgspec.convert(with_kind_defaults({"kind": "dmhe_raley"}), EstimatorSettings)
    assert with_kind_defaults({})["kind"] == DEFAULT_KIND


@pytest.mark.parametrize("kind", KINDS)
def test_an_estimator_of_fixed_fleets_says_so(kind: Kind) -> None:
    estimator = make_estimator(EstimatorSettings(kind=kind), Layout((1, 2)), 0, np.zeros(12), np.eye(12), 0.1)
    assert estimator.fixed_members == (kind == "centralized_ekf")
    if estimator.fixed_members:
        with pytest.raises(RuntimeError, match="fixed"):
            estimator.change_members((1,), 1, {})
    else:
        estimator.change_members((2, 1), 1, {})
        assert estimator.layout.agents == (2, 1)
