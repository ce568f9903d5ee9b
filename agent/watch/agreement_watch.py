"""Who of the fleet was given something else of what all have to share, or talks another version of the packets.

Every packet has a hash of what its sender shares; packets with another one are refused. Whoever meets one tells once
a second what he shares himself, so that both sides can name the settings in which they differ.

Two daemons of one id have no link to each other. Those who hear both say so in the same message, so that both know.
"""

from __future__ import annotations

from dataclasses import replace

from estimators.integrity.finding import Finding, Gravity, What
from transport.link.peers import Peer, PeerTable
from transport.messages.agreement_body import Agreement
from transport.messages.header import VERSION

REMEMBERED_S = 3.0
"""A disagreement that nobody has shown for longer is over."""
UNHEARD_S = 1.0
"""What comes unsigned in a drone's name is believed of its version only if nothing of it was accepted for so long."""
MAX_TWICE = 8
MAX_TOLD = 100
"""Characters about the settings of one drone: a reason has to fit into a packet."""


class AgreementWatch:
    """Compares; ``own`` is what agent ``own_id`` shares, times are those of the opener that feeds ``peers``."""

    def __init__(self, own: Agreement, peers: PeerTable, own_id: int) -> None:
        self.own = own
        self._peers = peers
        self._own_id = own_id
        self._told: dict[int, Agreement] = {}
        self._doubled_s: dict[int, float] = {}
        """By whom we were told, when, that somebody else has our id."""

    def on_told(self, agent_id: int, agreement: Agreement, now: float) -> None:
        """An agent says what it shares, and of whom it hears two."""
        self._told[agent_id] = agreement
        if self._own_id in agreement.twice:
            self._doubled_s[agent_id] = now

    def to_tell(self, now: float) -> Agreement | None:
        """What to say now: something if somebody shares something else, or is heard twice."""
        twice = tuple(agent_id for agent_id, peer in self._peers.items() if _is_recent(peer.twin_s, now))
        contradicted = any(_is_recent(peer.disagreed_s, now) for _, peer in self._peers.items())
        return replace(self.own, twice=twice[:MAX_TWICE]) if twice or contradicted else None

    def observe(self, now: float) -> tuple[Finding, ...]:
        """A finding for each drone that cannot be understood, or is there twice."""
        found = []
        tellers = [agent_id for agent_id, at_s in self._doubled_s.items() if _is_recent(at_s, now)]
        if tellers:
            found.append(Finding(What.DOUBLED, Gravity.DEGRADED, detail=f"{tellers[0]}"))
        for agent_id, peer in self._peers.items():
            if _is_recent(peer.twin_s, now):
                found.append(Finding(What.HEARD_TWICE, Gravity.DEGRADED, agent_id))
            if _is_recent(peer.disagreed_s, now):
                detail = self._differing(agent_id)
                found.append(Finding(What.DISAGREES, Gravity.DEGRADED, agent_id, detail=detail))
            version = _other_version(peer, now)
            if version is not None:
                found.append(Finding(What.OTHER_VERSION, Gravity.DEGRADED, agent_id, float(version), float(VERSION)))
        return tuple(found)

    def _differing(self, agent_id: int) -> str:
        """The settings that differ, with both values; of one that has not told them yet only that they do."""
        told = self._told.get(agent_id)
        names = () if told is None else self.own.differences(told)
        if told is None or not names:
            return "what all have to share"
        ours, theirs = self.own.settings, told.settings
        texts = [f"{name} (here {ours.get(name, 'none')}, there {theirs.get(name, 'none')})" for name in names]
        whole = ", ".join(texts)
        return whole if len(whole) <= MAX_TOLD else ", ".join(names)[:MAX_TOLD]


def _is_recent(when_s: float | None, now: float) -> bool:
    return when_s is not None and now - when_s <= REMEMBERED_S


def _other_version(peer: Peer, now: float) -> int | None:
    """The version of packets that cannot be read, while none that can be are there."""
    if peer.version is None or not _is_recent(peer.version[1], now):
        return None
    age_s = peer.age_s(now)
    return peer.version[0] if age_s is None or age_s > UNHEARD_S else None
