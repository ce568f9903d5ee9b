"""What an agent puts out about its estimate."""

from __future__ import annotations

import numpy as np
import pytest

from agent.outputs import estimate_message
from estimators.estimator import Estimate, Status


def test_an_estimate_travels_with_its_senders_own_block() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(12, 12))
    estimate = Estimate(5, rng.normal(size=12), half @ half.T, Status.OK, np.array([0, 3]))
    message = estimate_message(estimate, (1, 2), slice(6, 12))
    assert message.own_covariance == pytest.approx(estimate.covariance[6:, 6:])
    assert message.variance == pytest.approx(estimate.covariance.diagonal())
    assert (message.tick, message.status, message.age_ticks) == (5, 0, (0, 3))
