"""``fleetloc replay`` and ``fleetloc ranges``, from the command line to their files, on cuts of recorded flights."""

from __future__ import annotations

import csv
import gzip
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from agent.config.reading import load_config
from fleetloc.cli import main
from fleetloc.errors import InputError
from fleetloc.report import replay_exports
from fleetloc.report.range_study import pair_figures
from fleetloc.run.replay_setup import split_truth
from sim_bridge import side_process
from sim_bridge.replay.side_files.range_files import RangeCounts
from sim_bridge.replay.side_files.recorded_ranges import ranges_of_record
from tests.support.logs import LOGS
from tests.support.recorded_fleet import RecordedFleet

CONFIGS = Path(__file__).parents[3] / "configs"
COPTER, PX4 = LOGS / "copter.tlog.gz", LOGS / "px4.ulg.gz"


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def pair_config(folder: Path) -> Path:
    """A fleet of two whose origin is left to the logs."""
    path = folder / "pair.toml"
    path.write_text(
        '[fleet]\nname = "pair"\n[initial]\nfixes = 3\n[security]\nmode = "unsigned"\n'
        '[[agents]]\nid = 1\nmavlink = "udpin:127.0.0.1:14551"\n'
        '[[agents]]\nid = 2\nmavlink = "udpin:127.0.0.1:14552"\n'
    )
    return path


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The same recorded flight as two drones, with ranges made of its truth; drone 2 loses GPS at the end."""
    folder = tmp_path_factory.mktemp("replay")
    arguments = ["replay", pair_config(folder), COPTER, COPTER, "--ranges", "synthetic:sigma_m=0.2", "--seed", 5,
                 "--drop-gps", "2:-2,", "--out", folder / "out", "--json", folder / "figures.json"]  # fmt: skip
    assert main([str(argument) for argument in arguments]) == 0
    figures = json.loads((folder / "figures.json").read_text())
    return folder / "out", figures


def test_the_figures_are_there_for_every_drone(replayed: tuple[Path, dict[str, Any]]) -> None:
    _, figures = replayed
    assert figures["mode"] == "replay"
    assert figures["seed"] == 5
    assert figures["synthetic_ranges"] is True
    assert "white noise of 0.2 m" in figures["ranges"]
    assert [agent["id"] for agent in figures["agents"]] == [1, 2]
    for agent in figures["agents"]:
        assert agent["ticks_expected"] > 20
        assert agent["position_rmse_m"] < 1.0
        assert agent["sensors"]["imu"]["used"] > 100
        assert agent["sensors"]["gps"]["latency_s"] == pytest.approx(0.1, abs=0.05)
        assert agent["sensors"]["gps"]["latency_sigma_s"] > 0.0
    dropped = [agent["counters"].get("skipped gps: dropped on request", 0) for agent in figures["agents"]]
    assert dropped[0] == 0
    assert dropped[1] > 5
    assert any(name.startswith("gps of 2 dropped") for name in figures["agents"][0]["phases"])
    assert figures["logs"][0]["used"]["1"]["gps"] > 10


def test_the_page_says_on_its_face_what_is_synthetic_and_needs_no_network(
    replayed: tuple[Path, dict[str, Any]],
) -> None:
    page = (replayed[0] / "report.html").read_text()
    body = page[page.index("<body>") :]
    assert body.index("SYNTHETIC RANGES") < body.index("<table>")
    assert "GPS of drone 2 was dropped on request" in page
    assert page.count("<svg") >= 6
    assert "src=" not in page


def test_estimates_are_written_as_csv_and_mcap(replayed: tuple[Path, dict[str, Any]]) -> None:
    folder, figures = replayed
    with (folder / "agent_002.csv").open() as file:
        rows = list(csv.DictReader(file))
    known = figures["agents"][1]["ticks_expected"] - figures["agents"][1]["ticks_without_estimate"]
    assert len(rows) == known
    assert {"time_s", "time_unix_s", "n_m_2", "sigma_d_m_1", "age_ticks_1"} <= set(rows[0])
    assert all(float(row["sigma_n_m_2"]) > 0.0 for row in rows)
    with (folder / "estimates.mcap").open("rb") as stream:
        topics: dict[str, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert schema.encoding == "jsonschema"
            content = json.loads(message.data)
            topics[channel.topic] = topics.get(channel.topic, 0) + 1
            if channel.topic == "/agent_002/estimate":
                assert set(content["agents"]) == {"agent_001", "agent_002"}
    assert topics["/agent_002/estimate"] == known


def test_times_count_from_the_start_of_the_logs_whatever_part_is_replayed(tmp_path: Path) -> None:
    # GIVEN two logs of one name, a range every 0.1 s from their start, and a drop of GPS
    logs = [tmp_path / name / "00000001.tlog.gz" for name in ("a", "b")]
    for log in logs:
        log.parent.mkdir()
        log.write_bytes(COPTER.read_bytes())
    ranges = tmp_path / "ranges.csv"
    ranges.write_text("time,observer,target,range_m\n" + "".join(f"{k / 10},1,2,3.0\n" for k in range(1, 51)))
    # WHEN only seconds 2 to 4 are replayed
    arguments = ["replay", pair_config(tmp_path), *logs, "--ranges", ranges, "--drop-gps", "2:3,9", "--from", 2,
                 "--to", 4, "--out", tmp_path / "out"]  # fmt: skip
    assert main([str(argument) for argument in arguments]) == 0
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    # THEN all times are those of the logs
    assert (figures["from_s"], figures["to_s"]) == (2.0, pytest.approx(4.0, abs=0.1))
    assert figures["gps_dropped"] == [{"agent": 2, "from_s": 3.0, "to_s": pytest.approx(5.5, abs=1.6)}]
    assert figures["fleet"]["ranges"]["delivered"] == 21
    with (tmp_path / "out" / "agent_001.csv").open() as file:
        times_s = [float(row["time_s"]) for row in csv.DictReader(file)]
    assert 2.0 <= times_s[0] < times_s[-1] <= 4.1
    # and what was used and dropped is that of each log in this part
    assert [log["file"] for log in figures["logs"]] == ["a/00000001.tlog.gz", "b/00000001.tlog.gz"]
    assert [agent["log"] for agent in figures["agents"]] == ["a/00000001.tlog.gz", "b/00000001.tlog.gz"]
    fixes = [agent["counters"]["gps: samples"] for agent in figures["agents"]]
    dropped = figures["agents"][1]["counters"]["skipped gps: dropped on request"]
    assert fixes[0] == fixes[1] + dropped > fixes[1] > 0 < dropped
    assert all(log["used"]["1"]["imu"] > 100 for log in figures["logs"])


def without_first(log: bytes, seconds: float) -> bytes:
    """A telemetry log less its first seconds."""
    at, begin_us = 0, int.from_bytes(log[:8], "big")
    while int.from_bytes(log[at : at + 8], "big") < begin_us + seconds * 1e6:
        frame = log[at + 8 :]
        at += 8 + {0xFD: 12, 0xFE: 8}[frame[0]] + frame[1] + (13 if frame[0] == 0xFD and frame[2] & 1 else 0)
    return log[at:]


def late_pair(folder: Path) -> tuple[Path, Path]:
    """The same flight of two drones, of the second without its first 1.5 s."""
    later = folder / "later.tlog"
    later.write_bytes(without_first(gzip.decompress(COPTER.read_bytes()), 1.5))
    return COPTER, later


def test_times_count_from_where_all_logs_are_there(tmp_path: Path) -> None:
    arguments = ["replay", pair_config(tmp_path), *late_pair(tmp_path), "--out", tmp_path / "out"]
    part = ["--from", 1, "--to", 3, "--drop-gps", "1:2,9"]
    assert main([str(argument) for argument in [*arguments, *part]]) == 0
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (figures["from_s"], figures["to_s"]) == (1.0, pytest.approx(3.0, abs=0.1))
    assert figures["gps_dropped"][0]["from_s"] == 2.0
    assert all(19 <= agent["ticks_expected"] <= 22 for agent in figures["agents"])
    # AND of the whole flight, what comes before has negative times
    assert main([str(argument) for argument in arguments]) == 0
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert figures["from_s"] == pytest.approx(-1.5, abs=0.1)
    assert 0.0 < figures["all_there_s"] < 10.0


def test_a_part_of_which_nothing_is_left_is_refused_with_what_there_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = late_pair(tmp_path)
    code, _, err = run(capsys, "replay", pair_config(tmp_path), *logs, "--from", 40, "--out", tmp_path / "out")
    assert code == 2
    assert re.search(r"--from/--to: expected a part of -1\.\d to \d\.\d s \(0 to \d\.\d s are in all logs\)", err)


def test_a_replay_ends_with_its_verdict(replayed: tuple[Path, dict[str, Any]]) -> None:
    _, figures = replayed
    assert figures["verdict"]["failed"] is False
    assert figures["verdict"]["line"].startswith("passed: ")
    assert figures["fleet"]["availability"] == pytest.approx(
        1.0
        - sum(agent["ticks_without_estimate"] for agent in figures["agents"])
        / sum(agent["ticks_expected"] for agent in figures["agents"])
    )
    said = figures["agents"][1]["said"]
    assert said["other"]["no_fix"]["ticks"] > 5  # its GPS is dropped at the end
    assert said["alarm"]["ticks"] == figures["agents"][1]["ticks_alarm"]


def test_a_limit_that_a_replay_does_not_keep_is_exit_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    single = CONFIGS / "single.toml"
    code, out, _ = run(capsys, "replay", single, COPTER, "--out", tmp_path / "out", "--require", "rmse=0.001")
    assert code == 1
    assert "at most 0.001 required" in out.splitlines()[-2]
    assert "fleet ANEES: " in out
    assert "own ANEES: of its own alone" in (tmp_path / "out" / "report.html").read_text()
    code, _, err = run(capsys, "replay", single, COPTER, "--out", tmp_path / "out", "--require", "speed=1")
    assert code == 2
    assert "--require: speed: expected one of" in err


def test_a_fault_is_injected_told_and_judged_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # GIVEN a recorded flight, and its last seconds with a receiver that is 50 m off
    jump = 'kind="gps_wrong", agents=[1], from_s=3, offset_m=[50, 0, 0]'
    arguments = ["replay", pair_config(tmp_path), COPTER, COPTER, "--fault", jump, "--out", tmp_path / "out"]
    code, out, _ = run(capsys, *arguments)
    # THEN the report says that this is not what was flown, and gives the errors of that part apart
    assert code == 0
    assert "faults were injected (gps_wrong)" in out
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    (fault,) = figures["faults"]
    assert (fault["kind"], fault["agents"], fault["offset_m"]) == ("gps_wrong", [1], [50.0, 0.0, 0.0])
    received = [
        next(phase for name, phase in agent["phases"].items() if name.startswith("gps_wrong 3.."))
        for agent in figures["agents"]
    ]
    errors_m = [phase["gps_as_received_horizontal_rmse_m"] for phase in received]
    assert errors_m[0] == pytest.approx(50.0, abs=3.0)
    assert errors_m[1] < 3.0
    assert "faults were injected (gps_wrong)" in (tmp_path / "out" / "report.html").read_text()


def _killed(*_arguments: object) -> None:
    os._exit(9)


def test_an_export_that_is_killed_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_exports, "export", _killed)
    monkeypatch.setattr(side_process, "may_fork", lambda: True)
    with (
        pytest.raises(InputError, match="expected the estimates to be written as CSV and MCAP, found the writing"),
        replay_exports.exporting(tmp_path, load_config(CONFIGS / "line3.toml"), (1,), 0.0, None),
    ):
        pass


def test_a_log_of_another_format_is_compared_with_its_autopilot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyulog")
    code, out, err = run(capsys, "replay", CONFIGS / "single.toml", PX4, "--from", 29, "--out", tmp_path)
    assert code == 0, err
    figures = json.loads((tmp_path / "report.json").read_text())
    assert figures["origin"] == "log px4.ulg.gz"
    assert figures["agents"][0]["to_autopilot_horizontal_rms_m"] is not None
    assert "px4" in out


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("cut.tlog", lambda raw: raw[: len(raw) // 3 + 7]),
        ("flipped.tlog", lambda raw: _flipped(raw, 0.01)),
    ],
)
def test_a_damaged_log_gives_a_summary(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, damage: Any
) -> None:
    path = tmp_path / name
    path.write_bytes(damage(gzip.decompress(COPTER.read_bytes())))
    code, out, err = run(capsys, "replay", CONFIGS / "single.toml", path, "--out", tmp_path / "out")
    assert code == 0, err
    assert name in out
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert sum(figures["logs"][0]["skipped"].values()) + sum(figures["logs"][0]["notes"].values()) > 0


def _flipped(raw: bytes, share: float) -> bytes:
    data = np.frombuffer(raw, np.uint8).copy()
    rng = np.random.default_rng(1)
    places = rng.random(len(data)) < share
    data[places] ^= rng.integers(1, 256, int(places.sum()), dtype=np.uint8)
    return data.tobytes()


@pytest.mark.parametrize(
    ("content", "options", "expected"),
    [
        (b"", (), "an empty file"),
        (b"hello world, this is no log\n" * 40, (), "expected a flight log"),
        (None, ("--drop-gps", "7"), "--drop-gps: expected a drone with a log (1)"),
        (None, ("--drop-gps", "1:x"), "--drop-gps: expected ID"),
        (None, ("--fault", 'kind="gps_off", agents=[7]'), "--fault: agents: expected ids of agents"),
        (None, ("--from", "1e6"), "--from/--to"),
        (None, ("--ranges", "synthetic:sigma=1"), "--ranges synthetic: expected"),
        (None, ("--arrival", "never"), "--arrival: expected logged or stamped"),
        (None, ("--estimator", "magic"), "--estimator: expected one of"),
        (None, ("--truth", "a.csv", "b.csv"), "--truth: expected auto, or a file for each of 1"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | None, options: tuple[str, ...], expected: str
) -> None:
    log = COPTER
    if content is not None:
        log = tmp_path / "x.tlog"
        log.write_bytes(content)
    code, _, err = run(capsys, "replay", CONFIGS / "single.toml", log, *options, "--out", tmp_path / "out")
    assert code == 2
    assert expected in err
    assert len(err.strip().splitlines()) == 1


def test_errors_of_a_part_of_the_estimates_are_called_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # GIVEN a truth that ends in the middle of the flight
    truth = tmp_path / "truth.csv"
    lines = gzip.decompress((LOGS / "copter_truth.csv.gz").read_bytes()).decode().splitlines()
    truth.write_text("\n".join(lines[: len(lines) // 2]) + "\n")
    single = CONFIGS / "single.toml"
    code, out, err = run(capsys, "replay", single, COPTER, "--truth", truth, "--out", tmp_path / "out")
    assert code == 0, err
    # THEN the terminal and the page say of how many estimates the errors are
    assert "note: errors of drone 1 are of " in out
    assert "there is no truth for the others" in (tmp_path / "out" / "report.html").read_text()
    # and of the whole flight there is no such note
    code, out, _ = run(capsys, "replay", single, COPTER, "--out", tmp_path / "out")
    assert code == 0
    assert "note:" not in out


def test_a_replay_does_not_remove_what_it_is_to_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # GIVEN a log that is called as our own records are, in the folder of the results
    log = tmp_path / "agent_001.tlog"
    log.write_bytes(gzip.decompress(COPTER.read_bytes()))
    code, _, err = run(capsys, "replay", CONFIGS / "single.toml", log, "--out", tmp_path)
    assert code == 2
    assert "agent_001.tlog" in err
    assert log.exists()


def test_files_of_truth_may_follow_the_option_one_after_the_other() -> None:
    logs = [Path("a.tlog"), Path("t2.csv.gz"), Path("b.tlog")]
    assert split_truth(logs, ["t1.csv"]) == ([Path("a.tlog"), Path("b.tlog")], ["t1.csv", "t2.csv.gz"])
    assert split_truth([Path("a.tlog")], []) == ([Path("a.tlog")], ["auto"])


def test_the_shipped_configurations_are_right() -> None:
    for name, flavour in (("sitl3.toml", "ardupilot"), ("sitl3_px4.toml", "px4")):
        config = load_config(CONFIGS / name)
        assert config.ids == (1, 2, 3)
        assert {agent.autopilot for agent in config.agents} == {flavour}
        assert config.estimator.kind == "dmhe_shared"


# --- ranges --------------------------------------------------------------------------------------------------


def test_bias_noise_and_outliers_of_ranges_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # GIVEN two pairs with known biases and noise, one with 5 % of ranges 2 m too long
    rng = np.random.default_rng(2)
    lines = ["timestamp,node1,node2,uwb_range,mocap_range"]
    for k in range(2000):
        true_m = 5.0 + (k % 100) / 50.0
        lines.append(f"{1.6e9 + k},1,2,{true_m + 0.4 + 0.05 * rng.standard_normal():.4f},{true_m}")
        late_m = 2.0 if k % 20 == 0 else 0.0
        lines.append(f"{1.6e9 + k + 0.5},3,2,{true_m + 0.2 + 0.1 * rng.standard_normal() + late_m:.4f},{true_m}")
    path = tmp_path / "ranges.csv"
    path.write_text("\n".join([*lines, "1,1,2,oops,3"]))
    code, out, _ = run(capsys, "ranges", path, "--json", tmp_path / "figures.json")
    # THEN the figures are those
    assert code == 0
    assert "1 - 2" in out
    figures = json.loads((tmp_path / "figures.json").read_text())
    first, second = figures["pairs"]
    assert first["pair"] == [1, 2]
    assert first["bias_m"] == pytest.approx(0.4, abs=0.005)
    assert first["robust_sigma_m"] == pytest.approx(0.05, rel=0.1)
    assert first["outlier_fraction"] == 0.0
    assert second["median_m"] == pytest.approx(0.2, abs=0.02)
    assert second["robust_sigma_m"] == pytest.approx(0.1, rel=0.12)
    assert second["outlier_fraction"] == pytest.approx(0.05)
    assert figures["lines_skipped"] == {"range_m no number": 1}


def test_ranges_without_true_distances_cannot_be_studied(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "ranges.csv"
    path.write_text("time,observer,target,range_m\n1,1,2,3\n")
    code, _, err = run(capsys, "ranges", path)
    assert code == 2
    assert "true_m: expected a column of true distances" in err


def test_one_range_has_no_spread() -> None:
    figures = pair_figures((1, 2), np.array([0.3]), 0.5)
    assert (figures.bias_m, figures.sigma_m, figures.outliers) == (0.3, 0.0, 0.0)


# --- flight logs ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The records of three daemons after two seconds."""
    folder = tmp_path_factory.mktemp("flown")
    RecordedFleet(load_config(CONFIGS / "line3.toml"), folder).fly(2.0)
    return folder


def test_a_flight_record_is_repeated_exactly(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    records = sorted(flown.glob("agent_*.mcap"))
    code, out, err = run(capsys, "replay", "recorded", *records, "--out", tmp_path)
    assert code == 0, err
    assert "agent_001.mcap" in out
    rows = json.loads((tmp_path / "report.json").read_text())["records"]
    assert [(row["agent"], row["equal"], row["different_in_a_bit"]) for row in rows] == [
        (1, True, 0),
        (2, True, 0),
        (3, True, 0),
    ]
    assert all(row["compared"] > 10 for row in rows)
    assert (tmp_path / "agent_001.again.mcap").stat().st_size > 1000


def test_a_flight_record_answers_what_another_estimator_would_have_said(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = flown / "agent_002.mcap"
    code, _, err = run(capsys, "replay", "recorded", record, "--set", "sensors.uwb_sigma_floor_m=2.0",
                       "--set", "sensors.uwb_bound_m=5.0", "--out", tmp_path)  # fmt: skip
    assert code == 0, err
    (row,) = json.loads((tmp_path / "report.json").read_text())["records"]
    assert not row["equal"]
    assert row["compared"] > 10


@pytest.mark.parametrize(
    "option",
    [
        ("--drop-gps", "1"),
        ("--fault", 'kind="gps_off", agents=[1]'),
        ("--loss", "0.9"),
        ("--from", "1"),
        ("--ranges", "x.csv"),
        ("--arrival", "stamped"),
    ],
)
def test_what_cannot_be_asked_of_a_flight_record_is_refused(
    flown: Path, capsys: pytest.CaptureFixture[str], option: tuple[str, str]
) -> None:
    code, _, err = run(capsys, "replay", "recorded", flown / "agent_001.mcap", *option)
    assert code == 2
    assert f"{option[0]}: expected no such option" in err


def test_flight_records_and_logs_are_not_mixed(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "replay", "recorded", flown / "agent_001.mcap", COPTER)
    assert code == 2
    assert "flight logs (.mcap) or logs, not both" in err


def test_the_ranges_of_a_flight_record_are_read(flown: Path) -> None:
    # GIVEN the record of drone 2, which ranges drones 1 and 3 at 10 Hz
    counts = RangeCounts()
    lines = list(ranges_of_record(flown / "agent_002.mcap", counts))
    # THEN they are there, in order, within the two seconds of the flight
    assert {(line.observer, line.target) for line in lines} == {(2, 1), (2, 3)}
    assert len(lines) == pytest.approx(40, abs=4)
    times = [line.time_s for line in lines]
    assert times == sorted(times)
    assert times[-1] - times[0] == pytest.approx(2.0, abs=0.25)
    assert counts.skipped == {}
