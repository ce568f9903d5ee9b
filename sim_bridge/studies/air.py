"""The radio of a study: what happens to the packets of a flown fleet, as the settings of its channels."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sim_bridge.virtual.virtual_fleet import Parcel
from transport.link.channel import Channel, ChannelSettings, LinkFaults, Outage

LINK_STREAM = 7
"""Keeps the links' random draws apart from the flight's."""
FU_ON_TIME, FU_LATE = 0.4, 0.3
"""Channel of Fu, Bi and Gao: on time, one tick late, else lost."""


@dataclass(frozen=True, slots=True)
class Air:
    """What every link does, each packet drawn for itself; delays in ticks, outages in ticks of the flight.

    Attributes
    ----------
    faults : LinkFaults
        Loss, bursts and duplicates; delays come from the fields below.
    delay_ticks, spread_ticks : float
        Every packet comes ``delay_ticks`` late, or uniformly up to ``spread_ticks`` later still.
    late_share : float
        Share of packets that come one tick late.
    deaf : tuple of (receiver, sender)
        Slots: nothing that the sender sends reaches the receiver.
    cut : (slots of an island, first tick, first tick after it), optional
        No packet crosses between the island and the others.
    """

    faults: LinkFaults = field(default_factory=LinkFaults)
    delay_ticks: float = 0.0
    spread_ticks: float = 0.0
    late_share: float = 0.0
    deaf: tuple[tuple[int, int], ...] = ()
    cut: tuple[tuple[int, ...], int, int] | None = None

    def channel(
        self, receiver: int, agents: tuple[int, ...], period_s: float, start_s: float, seed: int
    ) -> Channel[Parcel]:
        """All links into the agent at slot ``receiver``; the flight's first tick begins at ``start_s``."""
        others = [slot for slot in range(len(agents)) if slot != receiver]
        faults = {agents[slot]: self._faults(receiver, slot, period_s, start_s) for slot in others}
        settings = ChannelSettings(per_neighbour={str(agent): each for agent, each in faults.items()})
        return Channel.seeded(settings, seed=seed, receiver=agents[receiver], neighbours=faults)

    def _faults(self, receiver: int, sender: int, period_s: float, start_s: float) -> LinkFaults:
        given = {name: getattr(self.faults, name) for name in LinkFaults.__struct_fields__}
        given["delay_s"] = self.delay_ticks * period_s
        given["delay_uniform_s"] = self.spread_ticks * period_s
        given["reorder"], given["reorder_delay_s"] = self.late_share, period_s
        if (receiver, sender) in self.deaf:
            given["loss"] = given["burst_loss"] = 1.0
        if self.cut is not None:
            island, first, after = self.cut
            if (receiver in island) != (sender in island):
                # a packet of tick k goes out when the tick has ended
                span = start_s + (first + 1) * period_s, start_s + (after + 1) * period_s
                given["outages"] = (Outage(*span),)
        return LinkFaults(**given)


def lossy(probability: float) -> Air:
    """Every packet of every directed link is lost independently with ``probability`` (Bernoulli)."""
    return Air(LinkFaults(loss=probability))


def bursty(loss: float, mean_burst_packets: float) -> Air:
    """Gilbert-Elliott: links alternate between good and bad; all packets in a bad spell are lost.

    ``loss`` is the long-run share of lost packets, below 1, ``mean_burst_packets`` (at least 1) their mean run.
    """
    leave_bad = 1.0 / mean_burst_packets
    enter_bad = min(1.0, leave_bad * loss / (1.0 - loss))
    return Air(LinkFaults(burst_start=enter_bad, burst_end=leave_bad, burst_loss=1.0))


def fu_channel() -> Air:
    """On time with 0.4, one tick late with 0.3, lost with 0.3 (Fu, Bi, Gao: the channel of their examples)."""
    heard = FU_ON_TIME + FU_LATE
    return Air(LinkFaults(loss=1.0 - heard), late_share=FU_LATE / heard)


def channel_seed(seed: int, run: int) -> int:
    """The seed of a run's channels, a function of these two alone."""
    return int(np.random.SeedSequence([seed, run, LINK_STREAM]).generate_state(1)[0])
