"""Telemetry logs: what we write, MAVLink's own tools read."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil

from agent.log.tlog import STAMP, TlogWriter, frame_bytes, read_frames
from agent.mavlink.codec import Encoder, mavlink

UNIX_S = 1_780_000_000.123456


def frames(count: int) -> list[bytes]:
    encoder = Encoder(7, 1)
    return [encoder.encode(mavlink.MAVLink_system_time_message(0, 1000 + k)) for k in range(count)]


def test_pymavlink_reads_frames_and_stamps(tmp_path: Path) -> None:
    # GIVEN a log of 20 frames, 10 ms apart
    path = tmp_path / "a.tlog"
    writer = TlogWriter(path.open("wb"))
    for k, frame in enumerate(frames(20)):
        writer.write(frame, UNIX_S + 0.01 * k)
    writer.close()
    assert writer.size_bytes == path.stat().st_size
    # WHEN the tool of ground stations reads it
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    read = []
    while (message := log.recv_match(type="SYSTEM_TIME")) is not None:
        read.append((message.time_boot_ms, message.get_srcSystem(), message._timestamp))
    log.close()
    # THEN every frame is there at its time
    assert [entry[:2] for entry in read] == [(1000 + k, 7) for k in range(20)]
    assert [entry[2] for entry in read] == pytest.approx([UNIX_S + 0.01 * k for k in range(20)], abs=1e-6)


@given(cut=st.integers(0, 400), first=st.integers(0, 4))
def test_reading_from_any_frame_of_a_log_cut_anywhere(cut: int, first: int) -> None:
    stream = io.BytesIO()
    writer, offsets, written = TlogWriter(stream), [], frames(10)
    for frame in written:
        offsets.append(writer.size_bytes)
        writer.write(frame, UNIX_S)
    content = stream.getvalue()[: len(stream.getvalue()) - min(cut, len(stream.getvalue()))]
    whole = sum(offset + STAMP.size + len(f) <= len(content) for offset, f in zip(offsets, written, strict=True))
    assert list(read_frames(io.BytesIO(content), offsets[first])) == written[first:whole]


def test_lengths_of_all_sorts_of_frames() -> None:
    assert frame_bytes(bytes((0xFE, 9, 0))) == 17
    assert frame_bytes(bytes((0xFD, 9, 0))) == 21
    assert frame_bytes(bytes((0xFD, 9, 1))) == 34  # signed
    assert frame_bytes(b"\x00\x09\x00") == 0
    assert frame_bytes(b"\xfd\x09") == 0
