"""What comes out of an agent, as values; the shell around it (daemon, virtual fleet, replay) carries them out."""

from __future__ import annotations

from dataclasses import dataclass

from agent.mavlink.session import LinkState
from agent.watch.health import Health
from estimators.estimator import Estimate
from estimators.integrity.protection.statement import Statement
from transport.errors import EncodeError
from transport.messages.estimate_body import MAX_AGE_TICKS, FleetEstimate
from transport.security.sealing import Message, Packet


@dataclass(frozen=True, slots=True)
class Tell:
    """A message of the core for the neighbours, not sealed yet; no shell sees it."""

    message: Message


@dataclass(frozen=True, slots=True)
class Send:
    """Packets for the neighbours, in this order, each on its own stream; ``message`` is what they say."""

    packets: tuple[Packet, ...]
    message: Message


@dataclass(frozen=True, slots=True)
class ToAutopilot:
    """MAVLink frames for the autopilot's link."""

    frames: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class LinkChanged:
    """The autopilot appeared, was lost, or is back."""

    state: LinkState


@dataclass(frozen=True, slots=True)
class EstimateReady:
    """The estimate of a tick, at fleet time ``t_s``, finished by ``ready_s``.

    ``on_time``: within one period of the tick's end. ``joint``: ids of those who were estimated together; the others'
    blocks are what they report of themselves, or nothing, independent of all. Absent: not known.
    """

    estimate: Estimate
    t_s: float
    ready_s: float
    on_time: bool
    joint: tuple[int, ...] | None = None
    integrity: Statement | None = None
    """What is promised of it; absent: nothing, as of estimates that were not made here."""


@dataclass(frozen=True, slots=True)
class HealthChanged:
    """The agent's state or the reasons for it changed."""

    health: Health


@dataclass(frozen=True, slots=True)
class Faulted:
    """Something failed and was flown on with: ``of_estimator``, whose numerics broke, or a fault of the program."""

    error: Exception
    of_estimator: bool


@dataclass(frozen=True, slots=True)
class ClockStepped:
    """The system's clock stepped, so the core begins anew."""


@dataclass(frozen=True, slots=True)
class NotSent:
    """A message that fits into no packet, and why."""

    message: Message
    error: EncodeError


CoreOutput = Tell | EstimateReady | HealthChanged | Faulted
Output = Send | NotSent | ToAutopilot | LinkChanged | EstimateReady | HealthChanged | Faulted | ClockStepped


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
