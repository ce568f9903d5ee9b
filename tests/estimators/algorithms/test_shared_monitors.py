"""What the monitors leave of an estimate's covariance."""

from __future__ import annotations

import numpy as np

from estimators.algorithms.shared_monitors import understated, widened
from estimators.model.layout import block


def test_a_covariance_is_widened_where_it_is_too_small_and_keeps_what_agents_share() -> None:
    shared = np.tile(np.eye(6), (2, 2))
    covariance = shared + 0.1 * np.eye(12)
    moment = np.diag([9.0, 0.5, 1.1, 1.1, 1.1, 1.1])
    out = widened(covariance, moment, 1)
    own = block(1)
    assert np.linalg.eigvalsh(out[own, own] - moment).min() > -1e-12
    np.testing.assert_allclose(out[own, own].diagonal(), [9.0, 1.1, 1.1, 1.1, 1.1, 1.1])
    np.testing.assert_array_equal(out[block(0), :], covariance[block(0), :])
    assert understated(out, covariance).tolist() == [False, False]
    assert understated(widened(covariance, 9.0 * np.eye(6), 1), covariance).tolist() == [False, True]
