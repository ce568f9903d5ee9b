"""What is known of the errors of accelerations, beside the states that they have moved."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.systematic import slow_errors
from estimators.systematic.acceleration_errors import AccelerationErrors
from tests.support.builders import random_covariance

AGENTS = 3


def test_an_agents_state_goes_with_its_error_and_what_the_two_share() -> None:
    # GIVEN everything that an estimator knows of a fleet
    rng, errors = np.random.default_rng(3), slow_errors.count(AGENTS)
    states = 6 * AGENTS
    mean, covariance = rng.normal(size=states + errors), random_covariance(rng, states + errors)
    sizes = rng.uniform(0.1, 1.0, errors)
    known = AccelerationErrors.of(mean[states:], covariance, sizes, 0.2)
    for slot in range(AGENTS):
        # WHEN one agent is looked at
        own, spread = known.joined(mean[:states], covariance[:states, :states], slot)
        # THEN its state and its error are the marginal
        error = slow_errors.acceleration_of(slot, AGENTS)
        at = [*range(6 * slot, 6 * slot + 6), *range(states + error.start, states + error.stop)]
        np.testing.assert_array_equal(own, mean[at])
        np.testing.assert_allclose(spread, covariance[np.ix_(at, at)], atol=1e-12)
        np.testing.assert_array_equal(known.drift(slot).size_mps2, sizes[error])
        assert known.drift(slot).kept == pytest.approx(np.exp(-0.2 / slow_errors.ACCELERATION_S))


def test_after_a_reversal_states_say_nothing_of_the_errors() -> None:
    rng, errors = np.random.default_rng(4), slow_errors.count(AGENTS)
    covariance = random_covariance(rng, 6 * AGENTS + errors)
    known = AccelerationErrors.of(np.zeros(errors), covariance, np.ones(errors), 0.1)
    _, spread = known.apart().joined(np.zeros(6 * AGENTS), covariance[: 6 * AGENTS, : 6 * AGENTS], 1)
    assert not spread[:6, 6:].any()
    np.testing.assert_array_equal(spread[6:, 6:], known.joined(np.zeros(18), covariance[:18, :18], 1)[1][6:, 6:])
