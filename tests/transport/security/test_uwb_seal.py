"""The seal of UWB frames: as it is documented for drivers in other languages, and what does not pass it."""

from __future__ import annotations

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from nacl.signing import SigningKey

from transport.errors import Reason, Rejected
from transport.security.uwb_seal import OVERHEAD_BYTES, UwbSeal, uwb_key

SECRET = SigningKey(bytes(range(32)))
KEY = "cl/v1/f/agent/001/uwb"


def test_key_and_tag_are_as_documented() -> None:
    # worked out with hashlib from docs/uwb.md alone
    assert uwb_key(SECRET).hex() == "01e328e4bd09f16b69d8910eaeb34247a4b76ddaf4a7c346f4c545f0d43da42f"
    tag = hashlib.blake2b(b"CLuwb1\0start\0" + KEY.encode() + b"\0{}", key=uwb_key(SECRET), digest_size=16).digest()
    assert UwbSeal(SECRET, b"start").close(KEY, b"{}") == b"UWBs" + tag + b"{}"


@given(st.binary(max_size=200))
def test_a_frame_comes_back(frame: bytes) -> None:
    sealed = UwbSeal(SECRET).close(KEY, frame)
    assert len(sealed) == len(frame) + OVERHEAD_BYTES
    assert UwbSeal(SECRET).open(KEY, sealed) == frame


@given(st.binary(max_size=60), st.integers(0, 8 * 60))
def test_no_flipped_bit_passes(frame: bytes, bit: int) -> None:
    sealed = bytearray(UwbSeal(SECRET).close(KEY, frame))
    bit %= 8 * len(sealed)
    sealed[bit // 8] ^= 1 << bit % 8
    with pytest.raises(Rejected):
        UwbSeal(SECRET).open(KEY, bytes(sealed))


@pytest.mark.parametrize(
    ("key", "data", "reason"),
    [
        (KEY, b"", Reason.UNSIGNED),
        (KEY, b'{"v":1}', Reason.UNSIGNED),
        (KEY, b"UWBs", Reason.BAD_SIGNATURE),
        (KEY, UwbSeal(SigningKey(bytes(32))).close(KEY, b"frame"), Reason.BAD_SIGNATURE),
        ("cl/v1/f/agent/002/uwb", UwbSeal(SECRET).close(KEY, b"frame"), Reason.BAD_SIGNATURE),
        (KEY, UwbSeal(SECRET, b"an earlier start").close(KEY, b"frame"), Reason.BAD_SIGNATURE),
    ],
    ids=["nothing", "no seal", "cut short", "another key", "another drone", "earlier start"],
)
def test_what_our_driver_did_not_seal_is_refused(key: str, data: bytes, reason: Reason) -> None:
    with pytest.raises(Rejected) as refused:
        UwbSeal(SECRET).open(key, data)
    assert refused.value.reason is reason


def test_the_key_is_not_shown() -> None:
    assert uwb_key(SECRET).hex() not in repr(UwbSeal(SECRET))
