"""From settings to an estimator."""

from __future__ import annotations

from estimators.estimator import Estimator
from estimators.model.layout import Layout
from estimators.model.measurements import Matrix, Vector
from estimators.settings import EstimatorSettings


def make_estimator(
    settings: EstimatorSettings,
    layout: Layout,
    slot: int,
    prior_mean: Vector,
    prior_covariance: Matrix,
    period_s: float,
) -> Estimator:
    """The estimator of one agent (for ``centralized_ekf``: of the fleet; its slot does not matter).

    ``prior_mean`` ``(6n,)`` and ``prior_covariance`` ``(6n, 6n)`` hold at the first tick, NED m and m/s.
    """
    # each algorithm is imported where it is asked for: a daemon loads the kernels of one
    if settings.kind in ("dmhe_pre_ekf", "dmhe"):
        from estimators.algorithms.moving_horizon import MovingHorizonEstimator

        return MovingHorizonEstimator(settings, layout, slot, prior_mean, prior_covariance, period_s)
    if settings.kind == "dmhe_shared":
        from estimators.algorithms.shared_mhe import SharedMovingHorizonEstimator

        return SharedMovingHorizonEstimator(settings, layout, slot, prior_mean, prior_covariance, period_s)
    if settings.kind == "dekf_ci":
        from estimators.algorithms.dekf_ci import DistributedEkf

        return DistributedEkf(settings, layout, slot, prior_mean, prior_covariance, period_s)
    if settings.kind == "consensus_mhe":
        from estimators.algorithms.consensus_mhe import ConsensusMovingHorizonEstimator

        return ConsensusMovingHorizonEstimator(settings, layout, slot, prior_mean, prior_covariance, period_s)
    from estimators.algorithms.centralized import CentralizedEkf

    return CentralizedEkf(settings, layout, slot, prior_mean, prior_covariance, period_s)
