"""MAVLink signing under attack, in virtual time: forged, unsigned, replayed, early and late frames."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.reading import load_config
from agent.errors import LogFileError
from agent.inputs import MavlinkIn
from agent.mavlink.codec import Decoder, Encoder, Message, mavlink
from agent.mavlink.session import LinkState
from agent.mavlink.signing import MAX_AHEAD_S, STAMP_EPOCH_UNIX_S, LinkSigning, Refusal
from agent.mavlink.signing_stamps import StampFile
from agent.onboard import OnboardAgent
from agent.outputs import Output, ToAutopilot
from estimators.factory import make_estimator
from tests.security.conftest import PROFILES
from transport.errors import KeyFileError
from transport.security.auth import Identity

KEY, OTHER_KEY = bytes(range(32)), bytes(32)
NOW_S = 1_800_000_000.0


class Sender:
    """An autopilot with a clock of its own."""

    def __init__(self, key: bytes | None = KEY, *, unix_s: float = NOW_S, component: int = 1) -> None:
        self.signing = None if key is None else LinkSigning(key, unix_s=unix_s)
        self._encoder = Encoder(1, component, self.signing)

    def frame(self, unix_s: float | None = None, *, boot_ms: int = 5) -> bytes:
        if self.signing is not None and unix_s is not None:
            self.signing.unix_s = unix_s
        return self._encoder.encode(heartbeat() if boot_ms == 5 else mavlink.MAVLink_system_time_message(0, boot_ms))

    def time_question(self, unix_s: float) -> bytes:
        if self.signing is not None:
            self.signing.unix_s = unix_s
        return self._encoder.encode(mavlink.MAVLink_timesync_message(0, 12345))


def heartbeat() -> Message:
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)


def receiver(stamps: object = None, *, unix_s: float = NOW_S) -> Decoder:
    return Decoder(datagrams=True, signing=LinkSigning(KEY, unix_s=unix_s, stamps=stamps))  # type: ignore[arg-type]


def refused(decoder: Decoder) -> dict[str, int]:
    assert decoder.signing is not None
    return {str(reason): count for reason, count in decoder.signing.refused.items()}


def with_stamp(frame: bytes, unix_s: float) -> bytes:
    """The frame with another stamp; whoever does that cannot sign it."""
    stamp = int((unix_s - STAMP_EPOCH_UNIX_S) * 1e5)
    return frame[:-12] + stamp.to_bytes(6, "little") + frame[-6:]


def test_frames_of_the_autopilot_are_taken_and_those_of_others_are_not() -> None:
    decoder = receiver()
    assert len(decoder.feed(Sender().frame())) == 1
    for stranger, reason in ((Sender(None), Refusal.UNSIGNED), (Sender(OTHER_KEY), Refusal.FORGED)):
        assert decoder.feed(stranger.frame()) == []
        assert refused(decoder)[reason] == 1
    assert decoder.received == 1
    assert decoder.bad["not authentic"] == 2
    assert len(decoder.frames) == 0


def test_a_frame_of_mavlink_1_is_unsigned() -> None:
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    decoder = receiver()
    assert decoder.feed(bytes(heartbeat().pack(packer, force_mavlink1=True))) == []
    assert refused(decoder) == {"unsigned": 1}


def test_a_replayed_frame_is_refused() -> None:
    decoder, frame = receiver(), Sender().frame()
    assert len(decoder.feed(frame)) == 1
    assert decoder.feed(frame) == []
    assert refused(decoder) == {"old stamp": 1}


def test_a_captured_frame_with_a_future_stamp_does_not_shut_the_sender_out() -> None:
    # GIVEN a captured frame of the real sender, its stamp moved an hour ahead: its signature is bad
    sender, decoder = Sender(), receiver()
    captured = sender.frame()
    assert decoder.feed(with_stamp(captured, NOW_S + 3600.0)) == []
    # and one that the sender truly signed, on a day when its clock was an hour ahead
    assert decoder.feed(Sender(unix_s=NOW_S + 3600.0).frame()) == []
    assert refused(decoder) == {"bad signature": 1, "future stamp": 1}
    # WHEN the real sender goes on THEN it is heard
    assert len(decoder.feed(captured + sender.frame())) == 2


def test_pymavlinks_own_check_has_the_fault_that_ours_closes() -> None:
    """Should this fail, pymavlink has mended it; ours stays for the wall clock and for restarts."""
    sender, plain = Sender(), mavlink.MAVLink(None)
    plain.robust_parsing = True
    plain.signing.secret_key = KEY
    captured = sender.frame()
    plain.parse_buffer(with_stamp(captured, NOW_S + 3600.0))
    (message,) = plain.parse_buffer(sender.frame())
    assert isinstance(message, mavlink.MAVLink_bad_data)


def test_streams_have_stamps_of_their_own() -> None:
    decoder, early, late = receiver(), Sender(component=1), Sender(component=2, unix_s=NOW_S + 10.0)
    assert len(decoder.feed(late.frame() + early.frame())) == 2


def test_links_have_stamps_of_their_own() -> None:
    # GIVEN one system and component on two links, of which the second is behind by less than a minute
    decoder = receiver()
    for link_id, unix_s in ((0, NOW_S), (1, NOW_S - 5.0)):
        encoder = Encoder(1, 1, LinkSigning(KEY, unix_s=unix_s, link_id=link_id))
        assert decoder.feed(encoder.encode(heartbeat()))
    assert refused(decoder) == {}
    # WHEN the first goes back by as much THEN it is a replay
    assert not decoder.feed(Encoder(1, 1, LinkSigning(KEY, unix_s=NOW_S - 4.0)).encode(heartbeat()))
    assert refused(decoder) == {"old stamp": 1}


def test_stamps_outlive_a_restart(tmp_path: Path) -> None:
    # GIVEN a link that was used, and its stamps in a file that nobody else can read
    sender, decoder, file = Sender(), receiver(), StampFile(tmp_path / "agent_001.stamps")
    captured = sender.frame()
    decoder.feed(captured)
    assert decoder.signing is not None
    own = Sender()
    own.frame()
    assert own.signing is not None
    file.save(decoder.signing.stamps)
    assert file.path.stat().st_mode & 0o777 == 0o600
    # WHEN the daemon starts anew, a second later
    again = receiver(file.load(), unix_s=NOW_S + 1.0)
    # THEN the captured frame is refused, and the sender is heard, however far its clock is behind
    assert again.feed(captured) == []
    assert refused(again) == {"old stamp": 1}
    later = receiver(file.load(), unix_s=NOW_S + 86_400.0)
    assert len(later.feed(sender.frame())) == 1


def test_a_stream_never_heard_before_may_be_a_minute_old_but_no_more() -> None:
    assert len(receiver(unix_s=NOW_S + 59.0).feed(Sender().frame())) == 1
    decoder = receiver(unix_s=NOW_S + 61.0)
    assert decoder.feed(Sender().frame()) == []
    assert refused(decoder) == {"old stamp": 1}


def test_a_clock_of_ours_that_was_wrong_does_no_harm_once_it_is_right() -> None:
    """GIVEN stamps noted a day ahead, WHEN both clocks are set right, THEN the sender is heard again."""
    ahead = receiver(unix_s=NOW_S + 86_400.0)
    assert len(ahead.feed(Sender(unix_s=NOW_S + 86_400.0).frame())) == 1
    assert ahead.signing is not None
    right = receiver(ahead.signing.stamps)
    assert len(right.feed(Sender().frame())) == 1


def test_our_stamps_only_rise_even_when_the_clock_goes_back() -> None:
    sender, decoder = Sender(), receiver()
    frames = [sender.frame(unix_s) for unix_s in (NOW_S, NOW_S, NOW_S - 5.0, NOW_S + 1.0)]
    assert len(decoder.feed(b"".join(frames))) == 4


def test_stamps_that_cannot_be_read_or_written_are_named(tmp_path: Path) -> None:
    file = StampFile(tmp_path / "agent_001.stamps")
    file.path.write_text("nonsense")
    file.path.chmod(0o600)
    with pytest.raises(KeyFileError, match="not the stamps of a MAVLink link"):
        file.load()
    file.path.chmod(0o644)
    with pytest.raises(KeyFileError, match="chmod 600"):
        file.load()
    with pytest.raises(LogFileError, match="cannot be written"):
        StampFile(tmp_path / "nowhere" / "x.stamps").save(LinkSigning(KEY, unix_s=NOW_S).stamps)


@given(position=st.integers(0, 33), flip=st.integers(1, 255), ahead_s=st.floats(-30.0, MAX_AHEAD_S - 1.0))
def test_no_changed_byte_passes(position: int, flip: int, ahead_s: float) -> None:
    frame = bytearray(Sender(unix_s=NOW_S + ahead_s).frame())
    assert len(receiver().feed(bytes(frame))) == 1
    frame[position % len(frame)] ^= flip
    assert receiver().feed(bytes(frame)) == []


class Notes:
    """A journal that keeps what the autopilot's link brought."""

    def __init__(self) -> None:
        self.data = b""

    def note(self, event: object, unix_s: float) -> None:
        if isinstance(event, MavlinkIn):
            self.data += event.data

    def note_sent(self, frames: list[bytes], unix_s: float) -> None:
        """Not of interest."""


def frames_of(outputs: list[Output]) -> list[bytes]:
    """What goes to the autopilot."""
    return [frame for output in outputs if isinstance(output, ToAutopilot) for frame in output.frames]


@pytest.mark.parametrize("signed", [True, False])
def test_our_own_frames_sent_back_to_us_are_nobodys_word(signed: bool) -> None:
    """They bear our own good signature, and no stamp of ours is kept among those that came in."""
    # GIVEN an agent whose autopilot asks for the time
    config = load_config(PROFILES / "field.toml")
    signing = LinkSigning(KEY, unix_s=NOW_S) if signed else None
    onboard = OnboardAgent(config, 1, make_estimator, Identity(), unix_s=NOW_S, host_s=50.0, link_signing=signing)
    autopilot = Sender(KEY if signed else None)
    assert onboard.on_mavlink(autopilot.frame(), 50.0)
    assert onboard.on_mavlink(autopilot.time_question(NOW_S + 0.1), 50.1)
    # WHEN somebody sends back what the agent sends: heartbeat, answer, questions
    sent = frames_of(onboard.advance(50.2))
    assert len(sent) == 4
    heard = onboard.autopilot.heard
    drew_answers = [onboard.on_mavlink(frame, 50.3) for frame in sent]
    # THEN each is refused and counted, none draws our frames to the sender, and the autopilot is still answered
    assert drew_answers == [False] * 4
    assert onboard.autopilot.heard == heard
    assert onboard.autopilot.ignored == {"own frame": 4}
    onboard.on_mavlink(autopilot.time_question(NOW_S + 0.4), 50.4)
    (answer,) = Decoder(datagrams=True).feed(frames_of(onboard.advance(50.5))[0])
    assert (answer.get_type(), answer.ts1) == ("TIMESYNC", 12345)


def test_an_agent_connects_to_its_signing_autopilot_only_and_notes_nothing_forged() -> None:
    # GIVEN an agent on a signed link
    config = load_config(PROFILES / "field.toml")
    signing, notes = LinkSigning(KEY, unix_s=NOW_S), Notes()
    onboard = OnboardAgent(
        config, 1, make_estimator, Identity(), unix_s=NOW_S, host_s=50.0, link_signing=signing, journal=notes
    )
    # WHEN forged and unsigned heartbeats come in
    for stranger in (Sender(None), Sender(OTHER_KEY)):
        assert not onboard.on_mavlink(stranger.frame(), 50.0)  # and none of them draws our answers
    assert onboard.autopilot.state is LinkState.SEARCHING
    # and then the autopilot's own, in one read with a forged one
    good = Sender().frame()
    assert onboard.on_mavlink(Sender(OTHER_KEY).frame() + good, 50.1)
    # THEN it is connected, and a replay, which has no key, sees what was authentic and nothing else
    assert onboard.autopilot.state is LinkState.CONNECTED
    assert notes.data == good
    # and what it sends is signed by the wall clock
    autopilot = receiver(unix_s=NOW_S + 1.0)
    sent = frames_of(onboard.advance(51.0))
    assert len(autopilot.feed(b"".join(sent))) == len(sent) > 0
