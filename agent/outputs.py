"""What the agent core hands out."""

from __future__ import annotations

from dataclasses import dataclass

from agent.watch.health import Health
from estimators.estimator import Estimate
from transport.messages.estimate_body import MAX_AGE_TICKS, FleetEstimate
from transport.messages.information_body import Information
from transport.messages.measurement_body import Measurements


@dataclass(frozen=True, slots=True)
class Send:
    """A message for the neighbours."""

    message: Measurements | Information | FleetEstimate


@dataclass(frozen=True, slots=True)
class EstimateReady:
    """The estimate of a tick, at fleet time ``t_s``, finished by ``ready_s``.

    ``on_time``: within one period of the tick's end.
    """

    estimate: Estimate
    t_s: float
    ready_s: float
    on_time: bool


@dataclass(frozen=True, slots=True)
class HealthChanged:
    """The agent's state or the reasons for it changed."""

    health: Health


Output = Send | EstimateReady | HealthChanged


def estimate_message(estimate: Estimate, agents: tuple[int, ...], own: slice) -> FleetEstimate:
    """An estimate as it is sent; ``own`` is the block of the sender."""
    return FleetEstimate(
        tick=estimate.tick,
        status=int(estimate.status),
        agents=agents,
        mean=estimate.mean,
        variance=estimate.covariance.diagonal().copy(),
        age_ticks=tuple(min(age, MAX_AGE_TICKS) for age in estimate.age_ticks.tolist()),
        own_covariance=estimate.covariance[own, own],
    )
