"""Files of truth that are damaged: stamps, cells, lines, origin, gzip."""

from __future__ import annotations

import gzip
import math
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.sensing.frames import FleetFrame
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.logs.stamps import LOOK_AHEAD, rising
from sim_bridge.replay.side_files.truth_files import TruthFile

FRAME = FleetFrame(47.397742, 8.545594, 489.4, True, None)
UNIX_S = 1.8e9


def table(path: Path, lines: list[str], columns: str = "unix_s,n,e,d") -> TruthFile:
    path.write_text("\n".join([columns, *lines]) + "\n")
    return TruthFile(path, FRAME)


def lines_of(count: int, period_s: float = 0.02) -> list[str]:
    return [f"{UNIX_S + period_s * k:.3f},{k},0,-1" for k in range(count)]


# --- stamps --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("period_s", [0.02, 1.0])
@pytest.mark.parametrize("wild", ["9.8e9", "1800000500.0", "0", "-1e11"])
def test_one_wild_stamp_costs_one_line(tmp_path: Path, wild: str, period_s: float) -> None:
    # GIVEN a table of 3000 lines, one of which has a stamp of another time
    lines = lines_of(3000, period_s)
    lines[1000] = f"{wild},1000,0,-1"
    file = table(tmp_path / "t.csv", lines)
    # WHEN it is read THEN all other lines are there, and that one is counted
    places = [sample.position_m[0] for sample in file.samples("unix")]
    assert places == [float(k) for k in range(3000) if k != 1000]
    assert file.skipped.total() == 1


def test_a_clock_that_is_wrong_for_seconds_costs_those(tmp_path: Path) -> None:
    """GIVEN a recorder's clock an hour ahead from the first line on, until it is set THEN the rest is there."""
    right = lines_of(3000)
    wrong = [f"{UNIX_S + 3600.0 + 0.02 * k:.3f},0,0,0" for k in range(LOOK_AHEAD // 2)]
    file = table(tmp_path / "t.csv", wrong + right)
    assert len(list(file.samples("unix"))) == 3000
    assert file.skipped == {"time ahead of the lines behind it": len(wrong)}


def test_a_wild_boot_time_costs_one_line_on_either_clock(tmp_path: Path) -> None:
    lines = [f"{30 + 0.02 * k:.3f},{UNIX_S + 30 + 0.02 * k:.4f},{k},0,-1" for k in range(500)]
    lines[200] = f"77777.0,{UNIX_S + 34:.4f},200,0,-1"
    file = table(tmp_path / "t.csv", lines, "time_boot_s,unix_s,n,e,d")
    for clock, zero_s in (("boot", 30.0), ("unix", UNIX_S + 30.0)):
        times = [sample.t_s for sample in file.samples(clock)]
        assert len(times) == 499
        assert times[-1] == pytest.approx(zero_s + 0.02 * 499, abs=1e-3)


def test_pauses_and_repeated_stamps_are_no_damage() -> None:
    """GIVEN a pause, a clock set forward and lines that repeat a stamp THEN only the repeated ones are left out."""
    skipped: Counter[str] = Counter()
    times = [1.0, 1.02, 1.02, 1.02, 1.04, 600.0, 600.02, 7000.0, 7000.02, 7000.04]
    taken = [t_s for t_s, _ in rising([(t_s, None) for t_s in times], skipped)]
    assert taken == [1.0, 1.02, 1.04, 600.0, 600.02, 7000.0, 7000.02, 7000.04]
    assert skipped == {"time not rising": 2}


@given(st.lists(st.floats(-1e12, 1e12), max_size=60))
def test_whatever_the_stamps_what_is_taken_rises_and_the_rest_is_counted(times: list[float]) -> None:
    skipped: Counter[str] = Counter()
    taken = [t_s for t_s, _ in rising([(t_s, None) for t_s in times], skipped)]
    assert taken == sorted(set(taken))
    assert len(taken) + skipped.total() == len(times)
    assert bool(taken) == bool(times)


# --- cells and lines -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ('1,"2,3,4', "no numbers"),
        ("x" * 200_000, "line too long"),
        ('"' + "x" * 200_000, "line too long"),
        ("1,2,3", "no numbers"),
        ("1,nan,3,4", "not finite or too large"),
        ("1e300,2,3,4", "not finite or too large"),
    ],
)
def test_a_bad_line_is_counted_and_stops_nothing(tmp_path: Path, line: str, reason: str) -> None:
    lines = lines_of(50)
    file = table(tmp_path / "t.csv", [*lines[:20], line, *lines[20:]])
    assert len(list(file.samples("unix"))) == 50
    assert file.skipped == {reason: 1}


def test_a_byte_order_mark_and_blank_lines_are_no_header(tmp_path: Path) -> None:
    file = table(tmp_path / "t.csv", lines_of(5), "\ufeff\n\n# a comment\nunix_s,n,e,d")
    assert len(list(file.samples("unix"))) == 5
    assert not file.skipped


def test_a_damaged_packed_file_gives_what_is_before_the_damage(tmp_path: Path) -> None:
    table(tmp_path / "t.csv", lines_of(20_000))
    packed = gzip.compress((tmp_path / "t.csv").read_bytes())
    middle = len(packed) // 2
    path = tmp_path / "t.csv.gz"
    path.write_bytes(packed[:middle] + b"\xff" * 64 + packed[middle + 64 :])
    file = TruthFile(path, FRAME)
    assert 5000 < len(list(file.samples("unix"))) < 15_000
    assert file.skipped["gzip stream damaged from some byte on"] == 1


@given(st.binary(max_size=400))
def test_any_bytes_end_in_sound_states(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "t.csv"
    path.write_bytes(b"unix_s,n,e,d\n1,2,3,4\n" + content)
    for sample in TruthFile(path, FRAME).samples("unix"):
        assert all(map(math.isfinite, (sample.t_s, *sample.position_m)))


# --- origin --------------------------------------------------------------------------------------------------


def with_comment(path: Path, comment: str) -> TruthFile:
    path.write_text(f"{comment}\nunix_s,n,e,d\n1,2,3,4\n")
    return TruthFile(path, FRAME)


@pytest.mark.parametrize("origin", ["lat 47.1.2 lon 8 alt 4", "lat 147 lon 8 alt 4", "lat 47 lon 8e alt 4",
                                    "lat 47 lon 8 alt 1e400"])  # fmt: skip
def test_an_origin_that_is_none_is_refused_in_one_line(tmp_path: Path, origin: str) -> None:
    with pytest.raises(ReplayError, match=f"expected truth: lat LAT lon LON alt ALT .* found '{origin}'"):
        list(with_comment(tmp_path / "t.csv", f"# origin {origin}; NED").samples("unix"))


def test_an_origin_may_end_a_sentence_and_holds_from_its_line_on(tmp_path: Path) -> None:
    """GIVEN two files in one, the second about an origin a metre higher THEN each line is about its own."""
    path = tmp_path / "t.csv"
    path.write_text("unix_s,n,e,d\n1,2,3,4\n# lat 47.397742 lon 8.545594 alt 490.4.\n2,2,3,4\n")
    file = TruthFile(path, FRAME)
    for _ in range(2):  # whatever an earlier reading has seen
        first, second = file.samples("unix")
        assert first.position_m == (2.0, 3.0, 4.0)
        assert second.position_m == pytest.approx((2.0, 3.0, 3.0), abs=1e-6)


@pytest.mark.parametrize("comment", ["# lat lon alt of the antenna", "# lat in deg lon in deg alt in m", "#"])
def test_other_comments_are_left_out(tmp_path: Path, comment: str) -> None:
    (sample,) = with_comment(tmp_path / "t.csv", comment).samples("unix")
    assert sample.position_m == (2.0, 3.0, 4.0)
