"""MAVLink bytes: good frames come out, bad ones are counted, nothing is raised and nothing grows."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st

from agent.mavlink.codec import Decoder, Encoder, mavlink


def attitude(time_boot_ms: int) -> mavlink.MAVLink_attitude_quaternion_message:
    return mavlink.MAVLink_attitude_quaternion_message(time_boot_ms, 1, 0, 0, 0, 0.1, 0.2, 0.3)


def frames(count: int, system_id: int = 1) -> list[bytes]:
    encoder = Encoder(system_id, 1)
    return [encoder.encode(attitude(i)) for i in range(count)]


@given(st.lists(st.integers(1, 60), max_size=20))
def test_a_stream_may_be_cut_anywhere(cuts: list[int]) -> None:
    stream = b"".join(frames(8))
    decoder, received = Decoder(datagrams=False), []
    for cut in cuts:
        received += decoder.feed(stream[:cut])
        stream = stream[cut:]
    received += decoder.feed(stream)
    assert [message.time_boot_ms for message in received] == list(range(8))
    assert (decoder.received, decoder.lost, decoder.bad.total()) == (8, 0, 0)


def test_bad_bytes_are_counted_by_reason_and_good_frames_survive() -> None:
    good = frames(3)
    flipped = bytearray(good[1])
    flipped[15] ^= 0xFF
    decoder = Decoder(datagrams=True)
    assert len(decoder.feed(b"\x00garbage" + good[0])) == 1
    assert decoder.feed(bytes(flipped)) == []
    assert decoder.feed(good[2][:20]) == []
    assert len(decoder.feed(good[2])) == 1  # the cut datagram before does not swallow it
    assert dict(decoder.bad) == {"bad prefix": 1, "bad CRC": 1, "truncated": 1}


def test_unknown_messages_never_come_out_since_their_checksum_cannot_be_verified() -> None:
    frame = bytearray(frames(1)[0])
    frame[7:10] = (60000).to_bytes(3, "little")
    decoder = Decoder(datagrams=True)
    assert decoder.feed(bytes(frame)) == []
    assert decoder.bad["unknown message"] == 1


def test_losses_follow_from_each_senders_sequence() -> None:
    one, two = frames(300, system_id=1), frames(3, system_id=2)
    decoder = Decoder(datagrams=True)
    for index, frame in enumerate(one):
        if index % 10 != 5:
            decoder.feed(frame)
    for frame in two:
        decoder.feed(frame)
    assert decoder.lost == 30


def test_messages_of_unknown_ids_are_not_lost() -> None:
    sent = [bytearray(frame) for frame in frames(300)]
    for number in range(0, 300, 3):
        sent[number][7:10] = (60000).to_bytes(3, "little")
    perfect, lossy, garbled = (Decoder(datagrams=True) for _ in range(3))
    for number, frame in enumerate(sent):
        perfect.feed(bytes(frame))
        if number % 50 != 10:
            lossy.feed(bytes(frame))
    assert (perfect.lost, perfect.bad["unknown message"], perfect.received) == (0, 100, 200)
    assert lossy.lost == 6
    # a number far from the last one is nobody's word
    sent[0][4] = 200
    for frame in (sent[1], sent[0], sent[2]):
        garbled.feed(bytes(frame))
    assert garbled.lost == 0


def test_mavlink_1_and_truncated_zeros_are_understood() -> None:
    packer = mavlink.MAVLink(None, 1, 1)
    frame = bytes(attitude(0).pack(packer, force_mavlink1=True))
    decoder = Decoder(datagrams=True)
    assert decoder.feed(frame)[0].q1 == 1.0


@settings(max_examples=300)
@given(st.binary(max_size=300))
def test_no_bytes_raise_anything(data: bytes) -> None:
    for datagrams in (True, False):
        Decoder(datagrams=datagrams).feed(data)


def test_memory_stays_flat_however_the_stream_is_cut() -> None:
    rng = random.Random(1)
    decoder = Decoder(datagrams=False)
    stream = b"".join(frames(256))
    received = 0
    for _ in range(20):
        # Always a piece that ends within a frame: pymavlink alone would never free its buffer.
        received += len(decoder.feed(stream[:-1]))
        received += len(decoder.feed(stream[-1:] + rng.randbytes(5)))
    assert received >= 20 * 250
    assert len(decoder._parser.buf) < 20_000
    assert len(decoder.bad) < 10
