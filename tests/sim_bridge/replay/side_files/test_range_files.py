"""Files of ranges, good and bad."""

from __future__ import annotations

import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.side_files.range_files import RangeCounts, RangeLine, in_order, read_ranges
from transport.messages.uwb_body import UwbFrame, UwbRange, encode_uwb_json

HEADER = "time,observer,target,range_m,sigma_m\n"


def read(path: Path) -> tuple[list[RangeLine], RangeCounts]:
    counts = RangeCounts()
    return list(read_ranges(path, counts)), counts


@pytest.mark.parametrize("packed", [False, True])
def test_a_csv_file_is_read_plain_and_packed(tmp_path: Path, packed: bool) -> None:
    # GIVEN two ranges, one without a sigma
    path = tmp_path / "ranges.csv"
    content = (HEADER + "10.5,1,2,4.25,0.1\n10.75,2,1,4.5,\n").encode()
    path.write_bytes(gzip.compress(content) if packed else content)
    # WHEN the file is read THEN both are there
    lines, counts = read(path)
    assert lines == [RangeLine(10.5, 1, 2, 4.25, 0.1), RangeLine(10.75, 2, 1, 4.5, None)]
    assert counts.read == 2
    assert not counts.skipped


def test_public_data_is_read_under_its_own_names(tmp_path: Path) -> None:
    path = tmp_path / "tiers.csv"
    path.write_text("timestamp,node1,node2,uwb_range,mocap_range\n1671462954.01,1.0,3.0,4.44,4.15\n")
    assert read(path)[0] == [RangeLine(1671462954.01, 1, 3, 4.44, None, 4.15)]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("x,1,2,3,0.1", "time no number"),
        ("1,1,2", "range_m missing"),
        ("1,1,1,3,0.1", "observer is target"),
        ("1,1.5,2,3,0.1", "observer no id"),
        ("1,1,2,nan,0.1", "range_m not finite"),
        ("1,1,2,-3,0.1", "range_m out of range"),
        ("1,1,2,1e9,0.1", "range_m out of range"),
        ("1,1,2,3,0", "sigma_m not positive"),
    ],
)
def test_a_bad_line_is_counted_with_its_number_and_stops_nothing(tmp_path: Path, line: str, reason: str) -> None:
    path = tmp_path / "ranges.csv"
    path.write_text(f"{HEADER}1,1,2,3,0.1\n{line}\n2,1,2,3,0.1\n")
    lines, counts = read(path)
    assert [one.time_s for one in lines] == [1.0, 2.0]
    assert counts.skipped == {reason: 1}
    assert counts.lines == {reason: [3]}


def test_json_lines_hold_ranges_or_whole_frames(tmp_path: Path) -> None:
    # GIVEN a range, garbage, and a frame of a UWB driver
    frame = UwbFrame(7, "unix", 1_800_000_000_500_000_000, (UwbRange(3, 8.0, 0.05, offset_s=0.25),), 1)
    path = tmp_path / "ranges.jsonl"
    first = json.dumps({"time": 1_800_000_000.0, "observer": 1, "target": 2, "range_m": 5.0, "sigma_m": 0.2})
    path.write_bytes(f"{first}\n{{oops\n[1]\n".encode() + encode_uwb_json(frame) + b"\n")
    # WHEN read THEN the frame's measurement has its own instant
    lines, counts = read(path)
    assert lines == [RangeLine(1.8e9, 1, 2, 5.0, 0.2), RangeLine(1_800_000_000.75, 1, 3, 8.0, 0.05)]
    assert counts.skipped == {"no JSON": 1, "no object": 1}


def test_a_file_that_holds_no_ranges_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "other.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ReplayError, match=r"other\.csv: expected ranges: a header line .* found 'a, b'"):
        read(path)


def test_a_truncated_packed_file_gives_what_is_there(tmp_path: Path) -> None:
    path = tmp_path / "ranges.csv.gz"
    rng = np.random.default_rng(1)
    body = "".join(f"{k},1,2,{rng.uniform(1, 9):.6f},0.1\n" for k in range(5000))
    path.write_bytes(gzip.compress((HEADER + body).encode())[:20_000])
    lines, counts = read(path)
    assert len(lines) > 100
    assert counts.skipped["the file ends early"] == 1


def test_a_damaged_packed_file_gives_what_is_before_the_damage(tmp_path: Path) -> None:
    # GIVEN a stream that cannot be unpacked from its middle on
    rng = np.random.default_rng(1)
    body = "".join(f"{k},1,2,{rng.uniform(1, 9):.6f},0.1\n" for k in range(20_000))
    packed = gzip.compress((HEADER + body).encode())
    middle = len(packed) // 2
    path = tmp_path / "ranges.csv.gz"
    path.write_bytes(packed[:middle] + b"\xff" * 64 + packed[middle + 64 :])
    lines, counts = read(path)
    assert 5000 < len(lines) < 15_000
    assert counts.skipped["gzip stream damaged from some byte on"] == 1


@pytest.mark.parametrize("beginning", [b"\n \r\n", b"\xef\xbb\xbf", b"\xef\xbb\xbf\n"])
@pytest.mark.parametrize("table", [HEADER + "5,1,2,4.0,0.1\n", '{"time":5,"observer":1,"target":2,"range_m":4.0}'])
def test_a_byte_order_mark_and_blank_lines_begin_a_table_too(tmp_path: Path, beginning: bytes, table: str) -> None:
    path = tmp_path / "ranges"
    path.write_bytes(beginning + table.encode())
    lines, counts = read(path)
    assert [(line.time_s, line.range_m) for line in lines] == [(5.0, 4.0)]
    assert not counts.skipped


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ('{"time": 1, "observer": 1, "target": 2, "range_m": 1' + "0" * 400 + "}", "range_m no number"),
        ('{"time": 1, "observer": 1, "target": 2, "range_m": ' + "9" * 5000 + "}", "no JSON"),
        ('{"time": [1], "observer": 1, "target": 2, "range_m": 3}', "time no number"),
        ("[" * 5000, "no JSON"),
        ("x" * 200_000, "line too long"),
    ],
)
def test_a_monstrous_line_of_json_is_counted_and_stops_nothing(tmp_path: Path, line: str, reason: str) -> None:
    good = '{"time": 1, "observer": 1, "target": 2, "range_m": 3.0}'
    path = tmp_path / "ranges.jsonl"
    path.write_text(f"{good}\n{line}\n{good}\n")
    lines, counts = read(path)
    assert len(lines) == 2
    assert counts.lines == {reason: [2]}


def test_a_stray_quote_costs_its_line_only(tmp_path: Path) -> None:
    path = tmp_path / "ranges.csv"
    path.write_text(HEADER + '1,1,2,3,0.1\n2,1,2,"3,0.1\n3,1,2,3,0.1\n')
    lines, counts = read(path)
    assert [line.time_s for line in lines] == [1.0, 3.0]
    assert counts.lines == {"range_m no number": [3]}


@pytest.mark.parametrize("content", [b"", b"\n\n", gzip.compress(b"", mtime=0), b"\x1f\x8b\x08broken", b"\x1f\x8b"])
def test_a_file_without_a_line_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "none"
    path.write_bytes(content)
    with pytest.raises(ReplayError, match="or JSON lines, found no line that can be read"):
        read(path)


@pytest.mark.parametrize("beginning", [HEADER.encode(), b'{"time":5,"observer":1,"target":2,"range_m":4.0}\n'])
@given(content=st.binary(max_size=400))
def test_any_bytes_end_in_sound_ranges(
    tmp_path_factory: pytest.TempPathFactory, beginning: bytes, content: bytes
) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "x.csv"
    path.write_bytes(beginning + content)
    for line in read(path)[0]:
        assert math.isfinite(line.time_s)
        assert line.range_m > 0.0


@given(st.lists(st.floats(0, 100), max_size=60))
def test_lines_come_in_the_order_of_their_times(times: list[float]) -> None:
    lines = [(k, RangeLine(time_s, 1, 2, 1.0, None)) for k, time_s in enumerate(times)]
    ordered = [line.time_s for line in in_order(lines, RangeCounts())]
    assert ordered == sorted(times)
