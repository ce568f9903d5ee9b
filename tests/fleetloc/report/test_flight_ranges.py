"""Calibration of ranges: from a flight's logs, and the lines that a configuration gets."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.uwb.adapter import UwbAdapter
from fleetloc.cli import main
from fleetloc.errors import InputError
from fleetloc.report.flight_ranges import study_flight_logs
from fleetloc.report.pair_calibration import CalibratedPair, lines
from fleetloc.report.range_study import pair_figures
from tests.support.recorded_fleet import RecordedFleet
from transport.messages.uwb_body import UwbFrame, UwbRange, encode_uwb_json

RECORDS = Path(__file__).resolve().parents[2] / "data/records"
FOUND = [CalibratedPair((1, 2), 500, 0.31, 0.02, 0.08), CalibratedPair((1, 3), 0, -0.05, 0.03)]


def three(**tables: Any) -> FleetConfig:
    circles = [
        {
            "kind": "circle",
            "agent": i,
            "center_m": [6.0 * i, 4.0 * (i % 2), -5.0 - i],
            "radius_m": 4.0 + i,
            "lap_s": 14.0 + 3 * i,
        }
        for i in (1, 2, 3)
    ]
    return config_from(
        {
            "fleet": {"name": "cal", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 500.0}},
            "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{14550 + i}"} for i in (1, 2, 3)],
            "sim": {"profile": "realistic", "seed": 3, "paths": circles},
            "security": {"mode": "unsigned"},
            **tables,
        },
        "test",
    )


@pytest.mark.slow
def test_flight_logs_tell_the_biases_that_the_modules_had(tmp_path: Path) -> None:
    # GIVEN a flight whose pairs have biases of their own, and the logs of two of three drones
    fleet = RecordedFleet(three(), tmp_path)
    truth = fleet.lockstep.run(16.0).truth
    for record in fleet.records.values():
        record.close()
    true_m = dict(zip(map(tuple, truth.pairs.tolist()), truth.pair_bias_m.tolist(), strict=True))
    assert max(abs(bias_m) for bias_m in true_m.values()) > 0.02
    # WHEN the drones' logs are looked at
    found = study_flight_logs(sorted(tmp_path.glob("*.mcap"))[:2], None, tmp_path / "lines.toml")
    # THEN each pair's bias is within what its sigma says, which is less than the prior's; and the lines are accepted
    assert {each.pair for each in found} == true_m.keys()
    for each in found:
        assert each.bias_sigma_m < 0.25
        assert abs(each.bias_m - true_m[each.pair]) < 3.0 * each.bias_sigma_m
        assert each.sigma_m is not None
        assert 0.03 < each.sigma_m < 0.3
        assert each.count > 100
    document = tomllib.loads((tmp_path / "lines.toml").read_text())
    pairs = three(**document).sensors.uwb_pairs
    assert [each.bias_m for each in pairs] == pytest.approx([each.bias_m for each in found], abs=6e-4)


def test_a_flight_that_estimates_no_biases_says_so() -> None:
    with pytest.raises(InputError, match="systematic_errors"):
        study_flight_logs([RECORDS / "first_state_002.mcap"], None, None)


def test_what_calibration_found_is_taken_off() -> None:
    config = three(**tomllib.loads(lines(FOUND)))
    adapter = UwbAdapter(1, config.ids, config.sensors)
    ranges = (UwbRange(2, 10.31), UwbRange(3, 5.0, 0.2), UwbRange(2, 0.3))
    payload = encode_uwb_json(UwbFrame(1, "mono", 10**9, ranges, 1))
    two, three_ = adapter.receive(payload, now_s=1.0, host_s=1.0, unix_s=0.0)
    assert (two.range_m, two.sigma_m) == (pytest.approx(10.0), 0.08)
    assert (three_.range_m, three_.sigma_m) == (pytest.approx(5.05), 0.2)
    assert dict(adapter.skipped) == {"shorter than its bias": 1}
    # AND a pair of others does not matter
    assert UwbAdapter(2, config.ids, config.sensors).receive(
        encode_uwb_json(UwbFrame(1, "mono", 10**9, (UwbRange(3, 7.0),), 2)), now_s=1.0, host_s=1.0, unix_s=0.0
    )[0].range_m == pytest.approx(7.0)  # fmt: skip


@pytest.mark.parametrize(
    ("pairs", "fault"),
    [
        ([[1, 1]], "two different agents"),
        ([[1, 2], [2, 1]], "each pair once"),
        ([[1, 9]], "ids of agents"),
    ],
)
def test_a_pair_that_is_none_is_named(pairs: list[list[int]], fault: str) -> None:
    with pytest.raises(Exception, match=fault):
        three(sensors={"uwb_pairs": [{"pair": pair, "bias_m": 0.1} for pair in pairs]})


def test_antennas_of_a_pair_may_each_have_their_own(tmp_path: Path) -> None:
    # GIVEN a pair of which one drone has two tags, as a file of ranges with true distances shows
    csv = tmp_path / "ranges.csv"
    rows = [
        f"{0.1 * k},{one},{other},{10.0 + bias_m + 0.01 * (k % 3 - 1)},10.0,{tag},{other_tag}"
        for k in range(30)
        for one, other, tag, other_tag, bias_m in ((1, 2, 0, 0, 0.3), (2, 1, 1, 0, 0.1), (1, 3, 0, 0, -0.2))
    ]
    csv.write_text("\n".join(["time,observer,target,range_m,true_m,tag,other_tag", *rows]))
    assert main(["ranges", str(csv), "--write", str(tmp_path / "lines.toml")]) == 0
    # WHEN the lines go into the configuration THEN each range is less what its antennas have
    document = tomllib.loads((tmp_path / "lines.toml").read_text())
    config = three(**document)
    assert [(each.pair, each.tags, each.bias_m) for each in config.sensors.uwb_pairs] == [
        ((1, 2), (0, 0), pytest.approx(0.3)),
        ((1, 2), (0, 1), pytest.approx(0.1)),
        ((1, 3), None, pytest.approx(-0.2)),
    ]
    for observer, entry, expected_m in (
        (1, UwbRange(2, 10.3), 10.0),
        (1, UwbRange(2, 10.1, other_tag=1), 10.0),
        (2, UwbRange(1, 10.1, tag=1), 10.0),
        (2, UwbRange(1, 10.1, tag=1, other_tag=1), 10.1),  # of which nothing is known
        (1, UwbRange(3, 9.8, tag=4), 10.0),
    ):
        payload = encode_uwb_json(UwbFrame(1, "mono", 10**9, (entry,), observer))
        adapter = UwbAdapter(observer, config.ids, config.sensors)
        (sample,) = adapter.receive(payload, now_s=1.0, host_s=1.0, unix_s=0.0)
        assert sample.range_m == pytest.approx(expected_m)
    ends = ([1, 2], [0, 1]), ([2, 1], [1, 0])
    twice = [{"pair": pair, "tags": tags, "bias_m": 0.1} for pair, tags in ends]
    with pytest.raises(Exception, match="once for each two tags"):
        three(sensors={"uwb_pairs": twice})


@pytest.mark.slow
def test_a_flight_tells_the_biases_of_each_antenna(tmp_path: Path) -> None:
    # GIVEN a flight of drones of which one has two tags, 0.4 m apart
    tags = [[0.0, 0.2, 0.0], [0.0, -0.2, 0.0]]
    agents = [
        {"id": i, "mavlink": f"udpin:127.0.0.1:{14550 + i}", **({"uwb_tags_m": tags} if i == 3 else {})}
        for i in (1, 2, 3)
    ]
    fleet = RecordedFleet(three(agents=agents), tmp_path)
    fleet.lockstep.run(14.0)
    for record in fleet.records.values():
        record.close()
    # WHEN one log is looked at THEN there is a line for each antenna, and they agree, as the simulator's tags do
    found = study_flight_logs([tmp_path / "agent_001.mcap"], None, None)
    assert [(each.pair, each.tags) for each in found] == [
        ((1, 2), None), ((1, 3), (0, 0)), ((1, 3), (0, 1)), ((2, 3), None),
    ]  # fmt: skip
    first, second = found[1], found[2]
    assert abs(first.bias_m - second.bias_m) < 0.1
    assert first.count > 30
    assert first.sigma_m is not None
    assert 0.03 < first.sigma_m < 0.4


def test_the_medians_own_sigma_counts_what_follows_each_other_as_fewer() -> None:
    # GIVEN white errors, and such that keep 0.9 of themselves from one to the next; many sets of each
    rng, count = np.random.default_rng(1), 400
    for keep in (0.0, 0.9):
        medians, told = [], []
        for _ in range(200):
            errors = np.empty(count)
            errors[0] = rng.normal()
            for k in range(1, count):
                errors[k] = keep * errors[k - 1] + np.sqrt(1.0 - keep**2) * rng.normal()
            figures = pair_figures((1, 2), 0.3 + 0.1 * errors, 0.5)
            medians.append(figures.median_m)
            told.append(figures.median_sigma_m)
        assert 0.7 < np.mean(told) / np.std(medians) < 1.4


def test_the_command_writes_the_lines(tmp_path: Path) -> None:
    csv = tmp_path / "ranges.csv"
    rows = [f"{0.1 * k},1,2,{10.3 + 0.01 * (k % 3 - 1)},10.0" for k in range(30)]
    csv.write_text("\n".join(["time,observer,target,range_m,true_m", *rows]))
    assert main(["ranges", str(csv), "--write", str(tmp_path / "lines.toml")]) == 0
    (pair,) = tomllib.loads((tmp_path / "lines.toml").read_text())["sensors"]["uwb_pairs"]
    assert pair == {"pair": [1, 2], "bias_m": 0.3, "sigma_m": 0.015}
    assert main(["ranges", str(csv), str(csv)]) == 2
