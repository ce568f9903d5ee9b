"""Consistency of an estimator: is the error as large as the covariance says?"""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from estimators.model.measurements import Matrix, Vector


def nees(error: Vector, covariance: Matrix) -> float:
    """Normalised estimation error squared, e' P^-1 e; its mean is the dimension where P is right.

    Raises ``numpy.linalg.LinAlgError`` where the covariance is not positive definite.
    """
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, error)
    return float(whitened @ whitened)


def nis(innovation: Vector, covariance: Matrix) -> float:
    """Normalised innovation squared: `nees` of an innovation with its covariance (23)."""
    return nees(innovation, covariance)


def average_nees_band(dimension: int, samples: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of the average NEES over independent samples, divided by the dimension (ANEES).

    The sum over ``samples`` is chi-square with dimension * samples degrees of freedom. Samples of one run are
    correlated: use the number of runs, not of ticks.
    """
    degrees = dimension * samples
    tail = (1.0 - probability) / 2.0
    low, high = (2.0 * float(gammaincinv(degrees / 2.0, p)) / degrees for p in (tail, 1.0 - tail))
    return low, high


def rms(errors: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    """Root mean square over all entries, the norm taken over the last axis."""
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=-1))))
