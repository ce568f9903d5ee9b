"""Parsers of UWB modules, against public sample bytes, simulated modules and rubbish."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.uwb.modules.driver import ModuleDriver, TakenRanges
from agent.uwb.modules.dwm1001 import Dwm1001Parser
from agent.uwb.modules.dwm3001 import Dwm3001Parser
from agent.uwb.modules.kinds import KINDS
from agent.uwb.modules.linktrack import LinkTrackParser
from agent.uwb.modules.reading import ModuleParser, ModuleRange, Reading
from agent.uwb.modules.uci import UciParser
from sim_bridge.uwb_modules.speech import SPEECHES, LinkTrackSpeech, Speech
from sim_bridge.world.sensors import SensedRange, SensedRanges

NLINK_OF_OTHER_FRAMES = (
    # example of the vendor's library, NodeFrame0 and 1
    "55 02 42 00 01 00 d1 2c c3 88 02 02 00 09 00 11 22 33 44 55 66 77 88 99 02 02 25 00 11 12 23 22 32 44 34 54 55"
    "65 67 76 67 87 77 99 aa a2 13 45 57 65 56 56 56 56 57 78 43 33 34 44 44 44 44 46 76 0d",
    "55 03 44 00 03 00 e8 80 00 00 00 86 00 00 01 51 01 e8 01 f2 02 02 92 09 48 13 02 02 00 5f 0b 00 86 09 00 9b ff"
    "ff c9 37 8a 34 06 ee 37 3f aa 02 02 93 09 00 45 09 00 c4 fc ff 8d 09 00 66 09 00 c4 fc ff 8e",
)
UCI_OF_A_DWM3001CDK = bytes.fromhex(
    # answers to the start of a session, then two rounds in which nobody answered
    "42 00 00 01 00 60 01 00 01 02 61 02 00 06 01 00 00 00 02 00 62 00 00 38 00 00 00 00 01 00 00 00 00 c8 00 00 00"
    "01 00 00 00 00 00 00 00 00 00 00 01 01 00 21 ff ff ff 00 00 00 00 00 00 00 00 00 00 00 00 02 00 00 00 00 00 00"
    "00 00 00 00 00 00 62 00 00 38 01 00 00 00 01 00 00 00 00 c8 00 00 00 01 00 00 00 00 00 00 00 00 00 00 01 01 00"
    "21 ff ff ff 00 00 00 00 00 00 00 00 00 00 00 00 02 00 00 00 00 00 00 00 00 00 00 00 00"
)
LEC = (
    b"DIST,4,AN0,022E,7.94,8.03,0.00,3.44,AN1,9280,7.95,0.00,0.00,5.68,AN2,DCAE,0.00,8.03,0.00,7.76,"
    b"AN3,5431,0.00,0.00,0.00,8.73,POS,6.95,5.37,-1.97,52\r\n"
)
LES = (
    b"022E[7.94,8.03,0.00]=3.38 9280[7.95,0.00,0.00]=5.49 DCAE[0.00,8.03,0.00]=7.73 5431[0.00,0.00,0.00]=9.01 "
    b"le_us=3082 est[6.97,5.17,-1.77,53]\r\n"
)
PRINTED_INTO_EACH_OTHER = (
    b"DIST,4,AN0,0090,0.00,0.00,0.00,3.25,AN1,D91E,0.00,0.00,0.00,3.33,AN2,0487,0.00,0.00,0.00,0.18,"
    b"AN3,15BA,0.00,0,AN3,15BA,0.00,0.00,0.00,0.00\r\n"
)
CLI = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=0, block_index=0, n_measurements=1\r\n"
    b'\r [mac_address=0x0001, status="SUCCESS", distance[cm]=210, RSSI[dBm]=-78.0]}\r\n'
)
CLI_OF_SEVERAL = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=1, block_index=1, n_measurements=3\n"
    b' [mac_address=0x0001, status="SUCCESS", distance[cm]=245];\n'
    b' [mac_address=0x0002, status="RX_TIMEOUT"];\n'
    b' [mac_address=0x0003, status="SUCCESS", distance[cm]=-75]}\n'
)


def measured(time_s: float, *others: int, observer: int = 1) -> SensedRanges:
    ranges = (SensedRange(other, 10.0 * other + 0.25, 0.1, -80.0, -82.0, 0.0) for other in others)
    return SensedRanges(observer, time_s, tuple(ranges))


def voices(kind: str) -> Iterator[Speech]:
    """A module of a kind that speaks; a LinkTrack in either frame."""
    speech = SPEECHES[kind](1)
    if kind == "dwm1001":
        speech.hear(b"\r\r")
        speech.hear(b"lec\r")
    yield speech
    if kind == "linktrack":
        yield LinkTrackSpeech(1, node_frame=2)


def whole(parser: ModuleParser) -> int:
    """Bytes that are accounted for."""
    return parser.counts.used + parser.counts.refused.total()


# --- public sample bytes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("sample", NLINK_OF_OTHER_FRAMES)
def test_the_vendors_sample_frames_are_known_by_their_checksum_and_hold_no_ranges(sample: str) -> None:
    frame = bytes.fromhex(sample)
    parser = LinkTrackParser()
    assert parser.feed(frame) == []
    assert parser.counts.used == len(frame)
    # WHEN one bit is wrong THEN the checksum says so
    damaged = LinkTrackParser()
    damaged.feed(frame[:20] + bytes((frame[20] ^ 1,)) + frame[21:])
    damaged.pause()
    assert damaged.counts.used == 0
    assert damaged.counts.refused["wrong checksum"] > 0


def test_uci_of_a_real_board_whose_peer_does_not_answer() -> None:
    parser = UciParser()
    readings = parser.feed(UCI_OF_A_DWM3001CDK)
    assert [reading.ranges for reading in readings] == [(), ()]
    assert parser.counts.used == len(UCI_OF_A_DWM3001CDK)
    assert dict(parser.counts.left_out) == {"failed": 2}


def test_uci_of_a_real_board_whose_peer_does() -> None:
    # GIVEN the same bytes with a good status, 1234 cm and no obstacle
    data = UCI_OF_A_DWM3001CDK.replace(bytes.fromhex("01 00 21 ff ff ff"), bytes.fromhex("01 00 00 00 d2 04"))
    assert [reading.ranges for reading in UciParser().feed(data)] == [(ModuleRange(1, 12.34, nlos=0.0),)] * 2


@pytest.mark.parametrize(
    ("line", "distances_m"),
    [
        (LEC, (3.44, 5.68, 7.76, 8.73)),
        (LES, (3.38, 5.49, 7.73, 9.01)),
        (b"dwm> " + LEC, (3.44, 5.68, 7.76, 8.73)),
    ],
)
def test_lines_of_a_real_tag(line: bytes, distances_m: tuple[float, ...]) -> None:
    (reading,) = Dwm1001Parser().feed(line)
    assert [each.module for each in reading.ranges] == [0x022E, 0x9280, 0xDCAE, 0x5431]
    assert tuple(each.range_m for each in reading.ranges) == distances_m


def test_lines_that_a_tag_has_printed_into_each_other_are_refused() -> None:
    parser = Dwm1001Parser()
    assert parser.feed(PRINTED_INTO_EACH_OTHER) == []
    assert parser.counts.refused["malformed"] > 0


def test_notifications_of_a_real_dwm3001cdk() -> None:
    parser = Dwm3001Parser()
    first, second = parser.feed(CLI + CLI_OF_SEVERAL)
    assert first.ranges == (ModuleRange(1, 2.1, rx_dbm=-78.0),)
    assert second.ranges == (ModuleRange(1, 2.45),)
    assert dict(parser.counts.left_out) == {"failed": 1, "no distance": 1}


# --- whole, split, damaged ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 2**32), rubbish=st.lists(st.binary(max_size=30), max_size=6))
@settings(max_examples=60, deadline=None)
def test_messages_are_found_however_they_are_split_and_whatever_lies_between(
    kind: str, seed: int, rubbish: list[bytes]
) -> None:
    for speech in voices(kind):
        rng = random.Random(seed)
        said = [speech.say(10.0 + 0.1 * k, measured(10.0 + 0.1 * k, 2, 3)) for k in range(8)]
        expected = KINDS[kind].parser()
        clean = [reading for data in said for reading in expected.feed(data)]
        assert len(clean) == len(said)
        # GIVEN the same in pieces, with rubbish before the messages
        parser, found = KINDS[kind].parser(), list[Reading]()
        for index, data in enumerate(said):
            pieces = [*cut(rng, rubbish[index]), b"\n"] if index < len(rubbish) else []
            for piece in [*pieces, *cut(rng, data)]:
                found += parser.feed(piece)
            found += parser.pause()  # silence until the next round
        # THEN nothing false is found, and the last one is, whatever came before
        assert all(reading in clean for reading in found)
        assert found[-1] == clean[-1]
        assert whole(parser) == parser.counts.fed
        assert len(found) == parser.counts.readings


def cut(rng: random.Random, data: bytes) -> list[bytes]:
    """Data in pieces."""
    marks = sorted(rng.randrange(len(data) + 1) for _ in range(rng.randrange(4)))
    return [data[a:b] for a, b in zip([0, *marks], [*marks, len(data)], strict=True)]


def without_a_byte(data: bytes, at: int) -> bytes:
    return data[:at] + data[at + 1 :]


def with_a_byte_more(data: bytes, at: int) -> bytes:
    return data[:at] + b"\x00" + data[at:]


def with_another_byte(data: bytes, at: int) -> bytes:
    return data[:at] + bytes((data[at] ^ 0xFF,)) + data[at + 1 :]


def cut_off(data: bytes, at: int) -> bytes:
    return data[:at]


@pytest.mark.parametrize("damage", [without_a_byte, with_a_byte_more, with_another_byte, cut_off])
def test_a_linktrack_frame_that_is_damaged_at_one_place_brings_nothing_false(
    damage: Callable[[bytes, int], bytes],
) -> None:
    for speech in voices("linktrack"):
        frame, after = (speech.say(t, measured(t, 2, 3)) for t in (10.0, 10.1))
        (true,) = LinkTrackParser().feed(after)
        for at in range(len(frame)):
            parser = LinkTrackParser()
            found = parser.feed(damage(frame, at)) + parser.feed(after) + parser.pause()
            assert [reading.ranges for reading in found if reading.ranges not in ((), true.ranges)] == [], at
            assert whole(parser) == parser.counts.fed


@pytest.mark.parametrize("damage", [without_a_byte, with_a_byte_more, cut_off])
def test_a_uci_packet_that_has_lost_or_gained_a_byte_brings_nothing_false(
    damage: Callable[[bytes, int], bytes],
) -> None:
    speech = SPEECHES["uci"](1)
    packet, after = (speech.say(t, measured(t, 2, 3)) for t in (10.0, 10.1))
    (true,) = UciParser().feed(after)
    for at in range(len(packet)):
        parser = UciParser()
        found = parser.feed(damage(packet, at)) + parser.feed(after) + parser.pause()
        assert [reading.ranges for reading in found if reading.ranges not in ((), true.ranges)] == [], at
        assert whole(parser) == parser.counts.fed


def test_a_uci_notification_of_many_measurements_comes_in_packets() -> None:
    speech = SPEECHES["uci"](1)
    data = speech.say(10.0, measured(10.0, *range(2, 12)))
    assert data[0] == 0x72  # more follows
    (reading,) = UciParser().feed(data)
    assert [each.module for each in reading.ranges] == list(range(2, 12))


def test_the_same_notification_again_is_no_new_range() -> None:
    for kind in ("uci", "dwm3001-cli"):
        parser = KINDS[kind].parser()
        data = SPEECHES[kind](1).say(10.0, measured(10.0, 2, 3))
        assert len(parser.feed(data + data)) == 1
        assert parser.counts.left_out["repeated"] == 2


# --- a million bytes of rubbish -----------------------------------------------------------------------------

BEGINS = {
    "linktrack": (b"\x55\x04", b"\x55\x05", b"\x55\x05\x24\x00", b"\x55\x04\x92\x00\x00\x01"),
    "uci": (b"\x62\x00\x00\x57", b"\x62\x00\x00\x38", b"\x72\x00\x00\xff", b"\x60\x01\x00\x01"),
    "dwm1001": (b"DIST,1,AN0,0002,", b"0.00,", b"0002[0.00,0.00,0.00]=", b"\r\n", b"dwm> ", b"POS,"),
    "dwm3001-cli": (
        b"SESSION_INFO_NTF: {session_handle=1, sequence_number=0, block_index=0, n_measurements=1\n",
        b' [mac_address=0x0002, status="SUCCESS"', b", distance[cm]=", b"]}\r\n", b"\n",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_million_bytes_of_rubbish_hold_no_range(kind: str) -> None:
    """Half of it begins as messages do; text is letters and signs as well as any bytes."""
    rng, driver = random.Random(12), ModuleDriver(KINDS[kind], 1, {k: k for k in range(1, 256)})
    driver.plugged(0.0)
    time_s, fed, found = 0.0, 0, list[TakenRanges]()
    while fed < 1_000_000:
        piece = rng.randbytes(rng.randrange(1, 120))
        if rng.random() < 0.5:
            piece = rng.choice(BEGINS[kind]) + piece
        time_s += rng.choice((0.001, 0.02, 0.3))
        found += driver.feed(piece, time_s)
        fed += len(piece)
    assert found == []
    assert driver.counts.fed == fed
    assert driver.counts.refused.total() > 0
    # THEN a module that is plugged in afterwards is understood
    for speech in voices(kind):
        driver.plugged(time_s)
        for k in range(8):
            found += driver.feed(speech.say(time_s + 0.1 * k, measured(time_s, 2, 3)), time_s + 0.1 * k)
    assert {(each.other, each.range_m) for taken in found for each in taken.ranges} == {(2, 20.25), (3, 30.25)}
