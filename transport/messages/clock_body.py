"""The clock stream: a query with the asker's time, answered with the two times of the answerer.

The question is 8 bytes (``t1`` ns); the answer is a sealed packet whose body is ``t1 t2 t3`` (i64 ns). The
echoed ``t1`` ties the answer to the question (`check_echo`), the seal to its sender.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from transport.errors import Reason, Rejected
from transport.messages.header import HEADER_BYTES

_QUESTION = struct.Struct("<q")
_ANSWER = struct.Struct("<qqq")


@dataclass(frozen=True, slots=True)
class ClockAnswer:
    """``asked_ns`` on the asker's clock (echoed), ``received_ns`` and ``answered_ns`` on the answerer's."""

    asked_ns: int
    received_ns: int
    answered_ns: int


def encode_clock_question(asked_ns: int) -> bytes:
    """The question's payload."""
    return _QUESTION.pack(asked_ns)


def decode_clock_question(payload: bytes) -> int:
    """``t1`` of a question; raises `Rejected`."""
    if len(payload) != _QUESTION.size:
        raise Rejected(Reason.BAD_LENGTH, f"clock question of {len(payload)} bytes")
    return int(_QUESTION.unpack(payload)[0])


def encode_clock_answer(answer: ClockAnswer) -> bytes:
    """The answer's body."""
    return _ANSWER.pack(answer.asked_ns, answer.received_ns, answer.answered_ns)


def decode_clock_answer(body: bytes) -> ClockAnswer:
    """The answer in a body; raises `Rejected`."""
    if len(body) != _ANSWER.size:
        raise Rejected(Reason.BAD_LENGTH, f"clock answer of {len(body)} bytes")
    asked_ns, received_ns, answered_ns = _ANSWER.unpack(body)
    if answered_ns < received_ns:
        raise Rejected(Reason.OUT_OF_RANGE, "clock answer sent before it was asked")
    return ClockAnswer(asked_ns, received_ns, answered_ns)


def check_echo(packet: bytes, asked_ns: int) -> None:
    """Raises `Rejected` if a sealed packet with an answer is one to another question than that of ``asked_ns``.

    Nothing else is looked at: `transport.security.opening` does that next, and refuses an echo that somebody changed.
    """
    echo = packet[HEADER_BYTES : HEADER_BYTES + _QUESTION.size]
    if echo != _QUESTION.pack(asked_ns):
        raise Rejected(Reason.WRONG_ANSWER, f"clock answer of {len(packet)} bytes to a question that we did not ask")
