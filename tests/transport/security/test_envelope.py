"""Encrypted payloads: what opens them, what does not, and that nonces never repeat."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import Stream, key_expression
from transport.messages.header import MAX_PACKET_BYTES
from transport.security.envelope import OVERHEAD_BYTES, Envelopes

KEYS = (bytes([1]) * 32, bytes([2]) * 32)
KEY = key_expression("f1", 7, Stream.MEAS)


def envelopes(keys: tuple[bytes, ...] = KEYS[:1], *, boot: int = 3, salt: bytes = b"saltsalt") -> Envelopes:
    return Envelopes(keys, 7, boot=boot, salt=salt)


def reason(opener: Envelopes, data: bytes, key: str = KEY) -> Reason:
    with pytest.raises(Rejected) as caught:
        opener.open(key, data)
    return caught.value.reason


@given(packet=st.binary(max_size=2000))
def test_what_is_closed_opens_again(packet: bytes) -> None:
    closed = envelopes().close(KEY, packet)
    assert len(closed) == len(packet) + OVERHEAD_BYTES
    assert Envelopes(KEYS[:1], None).open(KEY, closed) == packet


@given(data=st.data(), packet=st.binary(max_size=100))
def test_no_changed_byte_opens(data: st.DataObject, packet: bytes) -> None:
    closed = bytearray(envelopes().close(KEY, packet))
    closed[data.draw(st.integers(0, len(closed) - 1))] ^= data.draw(st.integers(1, 255))
    assert reason(envelopes(), bytes(closed)) in (Reason.WRONG_GROUP_KEY, Reason.UNENCRYPTED, Reason.BAD_ENVELOPE)


@given(junk=st.binary(max_size=300), ours=st.booleans())
def test_junk_is_refused_and_nothing_else_is_raised(junk: bytes, ours: bool) -> None:
    assert isinstance(reason(envelopes(), b"CE\x01" + junk if ours else junk), Reason)


def test_the_key_expression_is_part_of_it() -> None:
    closed = envelopes().close(KEY, b"packet")
    for other in (key_expression("f1", 8, Stream.MEAS), key_expression("f1", 7, Stream.INFO)):
        assert reason(envelopes(), closed, other) is Reason.WRONG_GROUP_KEY
    assert reason(envelopes(), closed, "cl/v1/nonsense") is Reason.WRONG_KEY


def test_after_a_rotation_the_old_key_opens_until_it_is_retired() -> None:
    old, new = envelopes((KEYS[0],)).close(KEY, b"x"), envelopes((KEYS[1], KEYS[0])).close(KEY, b"x")
    both, only_new = envelopes((KEYS[1], KEYS[0])), envelopes((KEYS[1],))
    assert [both.open(KEY, old), both.open(KEY, new), only_new.open(KEY, new)] == [b"x"] * 3
    assert reason(only_new, old) is Reason.WRONG_GROUP_KEY


def test_sizes_are_checked_first() -> None:
    assert reason(envelopes(), b"CE\x01") is Reason.BAD_ENVELOPE
    assert reason(envelopes(), b"CE" + bytes(MAX_PACKET_BYTES + OVERHEAD_BYTES)) is Reason.BAD_ENVELOPE
    assert reason(envelopes(), b"CL" + bytes(100)) is Reason.UNENCRYPTED


def test_no_two_envelopes_share_a_nonce() -> None:
    """Boot, number and salt are in the clear in front; with the sender they are the nonce."""
    senders = [envelopes(boot=boot, salt=salt) for boot in (1, 2) for salt in (b"saltsalt", b"saltsaly")]
    heads = [sender.close(KEY, b"same")[4:20] for sender in senders for _ in range(50)]
    assert len(set(heads)) == len(heads)


def test_numbers_that_run_out_send_nothing_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("transport.security.envelope.MAX_NUMBER", 2)
    sender = envelopes()
    for _ in range(2):
        sender.close(KEY, b"x")
    with pytest.raises(EncodeError, match="restart the agent"):
        sender.close(KEY, b"x")


def test_who_only_listens_closes_nothing() -> None:
    with pytest.raises(EncodeError):
        Envelopes(KEYS, None).close(KEY, b"x")
    with pytest.raises(ValueError, match="expected 8"):
        Envelopes(KEYS, 1, boot=1, salt=b"short")
