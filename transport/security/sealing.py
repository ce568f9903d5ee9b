"""Turns messages into signed packets."""

from __future__ import annotations

from dataclasses import dataclass

from transport.errors import EncodeError
from transport.link.streams import Stream, check_agent_id, key_expression
from transport.messages.agreement_body import Agreement, encode_agreement
from transport.messages.clock_body import ClockAnswer, encode_clock_answer
from transport.messages.estimate_body import FleetEstimate, encode_estimate
from transport.messages.far_body import FarReports, encode_far_reports
from transport.messages.header import (
    FLAG_FLOAT64,
    MAX_BODY_BYTES,
    STREAM_OF_KIND,
    Header,
    PacketKind,
    fleet_hash,
    pack_header,
)
from transport.messages.information_body import Information, encode_information, float32_suffices
from transport.messages.measurement_body import Measurements, encode_measurements
from transport.messages.proofs import Prover
from transport.messages.report_body import Diagnostics, encode_diagnostics
from transport.messages.window_body import WindowStates, encode_window
from transport.security.auth import Signing, Unsigned, sign

Message = (
    Measurements | Information | WindowStates | FleetEstimate | FarReports | Agreement | Diagnostics | ClockAnswer
)
"""Everything that travels in a packet."""


@dataclass(frozen=True, slots=True)
class Packet:
    """Bytes to be put on one of the sender's own streams."""

    stream: Stream
    data: bytes


@dataclass(frozen=True, slots=True)
class _Body:
    kind: PacketKind
    data: bytes
    tick: int = 0
    round: int = 0
    n: int = 0
    flags: int = 0


class Sealer:
    """Seals the messages of one agent; sans-I/O, one sequence of numbers per kind.

    ``boot`` must be greater than at every earlier start (`transport.keys.next_boot`), ``agreement`` is the hash of
    what the fleet shares. ``left_out`` counts measurement records that did not fit their packet, ``sent`` the packets
    sealed.
    """

    def __init__(self, fleet: str, agent_id: int, *, boot: int, signing: Signing, agreement: int = 0) -> None:
        self._agent_id = check_agent_id(agent_id)
        self._keys = {kind: key_expression(fleet, agent_id, STREAM_OF_KIND[kind]) for kind in PacketKind}
        self._fleet = fleet_hash(fleet)
        self._agreement = agreement
        self._boot = boot
        self._signing = signing
        self._prover = None
        if not isinstance(signing, Unsigned):
            self._prover = Prover(agent_id, self._fleet, agreement, signing)
        self._seq = dict.fromkeys(PacketKind, 0)
        self.left_out = 0
        self.sent = 0

    def seal(self, message: Message, *, t_ns: int, double: bool | None = None) -> list[Packet]:
        """The packets that carry a message: one, or several for a large information pair.

        ``t_ns`` is the UTC clock. ``double`` forces float64 (or float32) for an information pair or an
        estimate; by default a pair gets float64 where its conditioning demands it. Raises `EncodeError`.
        """
        return [self._packet(body, t_ns) for body in self._bodies(message, double)]

    def _bodies(self, message: Message, double: bool | None) -> list[_Body]:
        match message:
            case Measurements():
                encoded = encode_measurements(message, prover=self._prover)
                self.left_out += encoded.left_out
                return [_Body(PacketKind.MEAS, encoded.body, message.tick, message.exchange, encoded.count)]
            case Information():
                if double is None:
                    double = not float32_suffices(message.information)
                flags, n = (FLAG_FLOAT64 if double else 0), len(message.agents)
                parts = encode_information(message, double=double)
                return [_Body(PacketKind.INFO, part, message.tick, message.round, n, flags) for part in parts]
            case WindowStates():
                data, n = encode_window(message), len(message.agents)
                return [_Body(PacketKind.WINDOW, data, message.tick, message.round, n)]
            case FleetEstimate():
                data = encode_estimate(message, double=bool(double))
                flags = FLAG_FLOAT64 if double else 0
                return [_Body(PacketKind.EST, data, message.tick, n=len(message.agents), flags=flags)]
            case FarReports():
                return [_Body(PacketKind.FAR, encode_far_reports(message), message.tick, n=len(message.reports))]
            case Agreement():
                return [_Body(PacketKind.AGREE, encode_agreement(message))]
            case Diagnostics():
                return [_Body(PacketKind.DIAG, encode_diagnostics(message))]
            case ClockAnswer():
                return [_Body(PacketKind.CLOCK, encode_clock_answer(message))]

    def _packet(self, body: _Body, t_ns: int) -> Packet:
        kind, size = body.kind, len(body.data)
        if size > MAX_BODY_BYTES[kind]:
            raise EncodeError(f"{kind.name} body of {size} bytes, at most {MAX_BODY_BYTES[kind]}")
        self._seq[kind] += 1
        header = pack_header(
            Header(
                kind, self._agent_id, self._boot, self._seq[kind], body.tick, body.round, body.n, t_ns,
                size, self._fleet, body.flags, self._agreement,
            )
        )  # fmt: skip
        signature = b""
        if not isinstance(self._signing, Unsigned):
            signature = sign(self._signing, self._keys[kind], header, body.data)
        self.sent += 1
        return Packet(STREAM_OF_KIND[kind], header + body.data + signature)
