"""Faults injected into the radio of a live or virtual fleet: ``[transport.faults]``, and an agent's part of them.

One table describes all links of the fleet, so that one file makes a partition; every agent takes its own part, which
the receiver applies (`transport.link.channel`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import msgspec

from transport.link.channel import ChannelSettings, Outage

AgentId = Annotated[int, msgspec.Meta(ge=1, le=999)]
Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=3600)]


class RadioOutage(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[transport.faults.outages]]``: two groups that do not hear each other for a while."""

    from_s: Seconds
    """Since the agent first heard its autopilot: on one machine, since the simulated flight began."""
    to_s: Annotated[float, msgspec.Meta(gt=0, le=86_400)]
    """Likewise; later than ``from_s``."""
    receivers: tuple[AgentId, ...] = ()
    """Who hears nothing; none named = all."""
    senders: tuple[AgentId, ...] = ()
    """Of whom; none named = of all."""
    one_way: bool = False
    """Whether the senders still hear the receivers."""

    def unheard_by(self, agent_id: int) -> tuple[int, ...] | None:
        """Whom an agent does not hear: ``None`` = it is not concerned, empty = everybody."""
        sides = [(self.receivers, self.senders)] + ([] if self.one_way else [(self.senders, self.receivers)])
        unheard: set[int] = set()
        for deaf, mute in sides:
            if not deaf or agent_id in deaf:
                if not mute:
                    return ()
                unheard |= set(mute) - {agent_id}
        return tuple(sorted(unheard)) or None


class FaultsTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[transport.faults]``: more that can be injected than ``loss`` and ``delay_s``, on every link alike."""

    burst_start: Probability = 0.0
    """Gilbert-Elliott: probability per packet that a burst begins, in which all packets are lost."""
    burst_end: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.25
    """Gilbert-Elliott: probability per packet that it ends; bursts are 1/burst_end packets long on average."""
    reorder: Probability = 0.0
    """Probability that a packet is held back by 20 ms and overtaken."""
    duplicate: Probability = 0.0
    """Probability that a packet comes twice, the copy with a delay of its own."""
    outages: tuple[RadioOutage, ...] = ()
    """Groups that do not hear each other for a while: a partition."""


def channel_settings(
    faults: FaultsTable,
    agent_id: int,
    *,
    loss: float,
    delay_s: float,
    delay_jitter_s: float,
    began_s: float | None,
    more: Iterable[Outage] = (),
) -> ChannelSettings:
    """The faults of all links into one agent.

    ``began_s`` is the begin of its flight on the clock that the channel is given; before it, ``None``, there are no
    outages but those in ``more``.
    """
    outages = list(more)
    if began_s is not None:
        for outage in faults.outages:
            unheard = outage.unheard_by(agent_id)
            if unheard is not None:
                outages.append(Outage(began_s + outage.from_s, began_s + outage.to_s, unheard))
    return ChannelSettings(
        loss=loss,
        burst_start=faults.burst_start,
        burst_end=faults.burst_end,
        delay_s=delay_s,
        delay_exponential_s=delay_jitter_s,
        reorder=faults.reorder,
        duplicate=faults.duplicate,
        outages=tuple(outages),
    )
