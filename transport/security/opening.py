"""Turns received packets into messages, or refuses them: cheap checks first, numbers last."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from transport.errors import Reason, Rejected, SettingsError
from transport.link.peers import PeerTable
from transport.link.streams import check_agent_id, check_fleet_name, parse_key
from transport.messages.agreement_body import decode_agreement
from transport.messages.clock_body import decode_clock_answer
from transport.messages.estimate_body import decode_estimate
from transport.messages.far_body import decode_far_reports
from transport.messages.header import (
    FLAG_FLOAT64,
    HEADER_BYTES,
    RECORDED_VERSIONS,
    STREAM_OF_KIND,
    VERSION,
    VERSION_AT,
    Header,
    PacketKind,
    fleet_hash,
    unpack_header,
)
from transport.messages.information_body import decode_part
from transport.messages.measurement_body import Measurements, decode_measurements
from transport.messages.proofs import genuine
from transport.messages.reassembly import Reassembler
from transport.messages.report_body import decode_diagnostics
from transport.messages.window_body import decode_window
from transport.security.auth import Trust, Unsigned, verify
from transport.security.repeat_guard import RepeatGuard
from transport.security.replay_guard import ReplayGuard
from transport.security.sealing import Message


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """A message whose sender is who it says, and whose numbers are sound.

    ``sent_ns`` is the sender's UTC clock, ``received_s`` the ``now`` it was opened at.
    """

    sender: int
    kind: PacketKind
    seq: int
    sent_ns: int
    received_s: float
    message: Message


class Opener:
    """Opens the packets of one fleet; sans-I/O.

    Parameters
    ----------
    fleet : str
    roster : iterable of int
        Ids of the whole fleet: who may send, and whom messages may speak of.
    trust
        Public keys of everyone in the roster, or `transport.security.auth.UNSIGNED`.
    bodies : iterable of int, optional
        Ids that messages may speak of besides those of the roster.
    own_id : int, optional
        Packets that claim to be ours are refused.
    freshness_s : float, optional
        Largest difference between the sender's clock and ours; for fleets whose clocks are disciplined. It
        also stops replays to a receiver that has just started and remembers nothing.
    agreement : int, optional
        Hash of what the fleet shares; packets of those who share something else are refused but for the one that
        says what. ``None``: not looked at, as by those who only listen.
    recorded : bool
        Whether packets come from a log: then those of earlier versions are opened too.
    replay : ReplayGuard, optional
        With what was seen before a restart.
    on_rejected : callable, optional
        Called with the key and the `Rejected` of every packet that is refused, for the log.
    """

    def __init__(
        self,
        fleet: str,
        roster: Iterable[int],
        trust: Trust,
        *,
        own_id: int | None = None,
        bodies: Iterable[int] = (),
        freshness_s: float | None = None,
        agreement: int | None = None,
        recorded: bool = False,
        replay: ReplayGuard | None = None,
        on_rejected: Callable[[str, Rejected], None] | None = None,
    ) -> None:
        self._fleet_name = check_fleet_name(fleet)
        self._fleet = fleet_hash(fleet)
        self._roster = frozenset(check_agent_id(agent_id) for agent_id in roster)
        self._bodies = self._roster | frozenset(check_agent_id(body) for body in bodies)
        self._trust = trust
        self._own_id = own_id
        self._freshness_ns = None if freshness_s is None else round(freshness_s * 1e9)
        self._agreement = agreement
        self._versions = RECORDED_VERSIONS if recorded else (VERSION,)
        self.replay = replay or ReplayGuard()
        self._on_rejected = on_rejected
        self._repeats = RepeatGuard()
        self.peers = PeerTable(self._roster - {own_id})
        self._reassembler = Reassembler(self._bodies, self._count_expired)
        if not isinstance(trust, Unsigned):
            missing = sorted(self._roster - {own_id} - trust.keys())
            if missing:
                raise SettingsError(f"no public key for agents {missing}")

    def open(self, key: str, packet: bytes, *, now: float, unix_ns: int) -> Received | None:
        """The message in a packet that came under a key expression.

        ``None`` for a packet that is refused (then counted, by reason and by the agent its key names) and
        for a part of a message of which more is to come. Never raises for anything in ``packet``.
        """
        try:
            return self._open(key, packet, now, unix_ns)
        except Rejected as rejected:
            parsed = parse_key(key)
            self.peers.rejected(parsed[1] if parsed else None, rejected.reason)
            if parsed is not None and rejected.reason is Reason.BAD_VERSION:
                self.peers.speaks_version(parsed[1], packet[VERSION_AT], now)
            if self._on_rejected is not None:
                self._on_rejected(key, rejected)
            return None

    def expire(self, now: float) -> None:
        """Give up messages whose missing parts have not come in time; call it once in a while."""
        self._reassembler.expire(now)

    def _open(self, key: str, packet: bytes, now: float, unix_ns: int) -> Received | None:
        signed = not isinstance(self._trust, Unsigned)
        header = unpack_header(packet, fleet=self._fleet, signed=signed, versions=self._versions)
        self._check_sender(key, header)
        if self._freshness_ns is not None and abs(unix_ns - header.t_ns) > self._freshness_ns:
            raise Rejected(Reason.STALE, f"clock {(unix_ns - header.t_ns) * 1e-9:.3f} s behind ours")
        if self.replay.is_of_earlier_start(header):
            if not isinstance(self._trust, Unsigned):
                verify(self._trust[header.sender], key, packet)
            self.peers.of_earlier_start(header, now)
        self.replay.check(header)
        body = packet[HEADER_BYTES : HEADER_BYTES + header.body_bytes]
        if not isinstance(self._trust, Unsigned):
            verify(self._trust[header.sender], key, packet)
        self.replay.commit(header)
        if self._agreement is not None and header.agreement != self._agreement:
            self.peers.disagrees(header.sender, now)
            if header.kind is not PacketKind.AGREE:
                raise Rejected(Reason.DISAGREES, f"{header.agreement:08x}, ours {self._agreement:08x}")
        if header.kind is PacketKind.INFO:
            self._repeats.check_information(header, body)
        message = self._decode(header, body, now)
        if isinstance(message, Measurements):
            self._repeats.check_measurements(header, body, message)
        self.peers.accepted(header, now)
        if message is None:
            return None
        return Received(header.sender, header.kind, header.seq, header.t_ns, now, message)

    def _check_sender(self, key: str, header: Header) -> None:
        if parse_key(key) != (self._fleet_name, header.sender, STREAM_OF_KIND[header.kind]):
            raise Rejected(Reason.WRONG_KEY, f"{header.kind.name} of agent {header.sender} under {key!r}")
        if header.sender == self._own_id:
            raise Rejected(Reason.OWN_ID, f"id {header.sender} is ours")
        if header.sender not in self._roster:
            raise Rejected(Reason.UNKNOWN_SENDER, f"id {header.sender}")

    def _decode(self, header: Header, body: bytes, now: float) -> Message | None:
        h, double = header, bool(header.flags & FLAG_FLOAT64)
        match header.kind:
            case PacketKind.MEAS:
                proven = h.version > 1 and not isinstance(self._trust, Unsigned)
                message = decode_measurements(
                    body, tick=h.tick, count=h.n, roster=self._bodies, exchange=h.round, proven=proven
                )
                return self._with_genuine_proofs(message, h) if proven else message
            case PacketKind.INFO:
                part = decode_part(body, tick=h.tick, agents=h.n, double=double, fleet_size=len(self._bodies))
                return self._reassembler.add(h.sender, h.tick, h.round, part, now)
            case PacketKind.WINDOW:
                return decode_window(body, tick=h.tick, round_=h.round, agents=h.n, roster=self._bodies)
            case PacketKind.EST:
                return decode_estimate(body, tick=h.tick, agents=h.n, double=double, roster=self._bodies)
            case PacketKind.FAR:
                return decode_far_reports(body, tick=h.tick, count=h.n, roster=self._roster)
            case PacketKind.CLOCK:
                return decode_clock_answer(body)
            case PacketKind.AGREE:
                return decode_agreement(body)
            case PacketKind.DIAG:
                report = decode_diagnostics(body)
                if report.agent_id != h.sender:
                    raise Rejected(Reason.OUT_OF_RANGE, f"{h.kind.name} of agent {report.agent_id}")
                return report

    def _with_genuine_proofs(self, message: Measurements, header: Header) -> Measurements:
        """A message with the proofs that hold; the others are counted, and their records come without."""
        assert not isinstance(self._trust, Unsigned)
        others = (proof for proof in message.proofs or () if proof.owner != self._own_id)
        good, bad = genuine(others, self._trust, fleet=header.fleet, agreement=header.agreement)
        self.peers.rejected(header.sender, Reason.BAD_PROOF, bad)
        return replace(message, proofs=good)

    def _count_expired(self, sender: int, parts: int) -> None:
        self.peers.rejected(sender, Reason.PART_EXPIRED, parts)
