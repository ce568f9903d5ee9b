"""Files for other tools: what a viewer finds in them, in which units, and what is not there."""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.log.estimate_log import EstimateLogWriter, header_of
from agent.log.flight_reader import FlightReader
from agent.outputs import EstimateReady
from agent.sensing.frames import FleetFrame
from estimators.estimator import Estimate, SolverReport, Status
from fleetloc import cli
from fleetloc.export.flown import export_run
from fleetloc.export.map_files import MapTrack, write_geojson, write_kml
from fleetloc.export.plot_files import EVERY_S, PlotFiles
from fleetloc.run import run_files
from transport.messages.estimate_body import MAX_AGE_TICKS

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
RECORDS = Path(__file__).parents[2] / "data" / "records"
KML_NS = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
COVARIANCE = np.array([[4.0, 0.1, 0.2], [0.1, 9.0, 0.3], [0.2, 0.3, 16.0]])


@pytest.fixture
def config() -> FleetConfig:
    return load_config(LINE3)


def ready(tick: int, *, absent: tuple[int, ...] = ()) -> EstimateReady:
    """Drone i (from 0) at (10 i + tick, 20 i, -30 i); the covariance of each position is `COVARIANCE`."""
    mean, covariance, ages = np.zeros(18), np.eye(18), np.zeros(3, int)
    for drone in range(3):
        at = 6 * drone
        mean[at : at + 3] = 10 * drone + tick, 20 * drone, -30 * drone
        covariance[at : at + 3, at : at + 3] = COVARIANCE
        if drone in absent:
            mean[at : at + 6], ages[drone] = 0.0, MAX_AGE_TICKS
    estimate = Estimate(tick, mean, covariance, Status.OK, ages, SolverReport())
    return EstimateReady(estimate, 100.0 + 0.1 * tick, 100.1 + 0.1 * tick, True)


def messages(path: Path) -> dict[str, list[dict[str, Any]]]:
    """By topic; each is as its schema says."""
    found: dict[str, list[dict[str, Any]]] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            content = json.loads(message.data)
            assert content.keys() <= json.loads(schema.data)["properties"].keys()
            found.setdefault(channel.topic, []).append(content | {"_schema": schema.name})
    return found


def written(folder: Path, config: FleetConfig) -> dict[str, list[dict[str, Any]]]:
    """Two drones' estimates of 20 ticks, in which drone 3 is unknown at first, with fixes and ranges."""
    files = PlotFiles(folder, config, (1, 2), start_s=100.0)
    for tick in range(20):
        for agent_id in (1, 2):
            files.estimate(agent_id, ready(tick, absent=(2,) if tick < 10 else ()), 100.1 + 0.1 * tick)
        files.fix(1, 100.0 + 0.1 * tick, (tick + 0.5, 0.0, 0.0), 100.05 + 0.1 * tick)
        files.range(1, 2, 100.0 + 0.1 * tick, 37.4, 0.05)
        files.range(2, 3, 100.0 + 0.1 * tick, 37.4, None)
    files.truth(1, [(100.0 + 0.1 * tick, (tick, 0.0, 0.0)) for tick in range(20)])
    files.close()
    return messages(folder / run_files.MCAP)


def test_places_have_names_covariances_and_latitudes(tmp_path: Path, config: FleetConfig) -> None:
    found = written(tmp_path, config)
    pose = found["/agent_001/sees/agent_002"][7]
    assert pose["_schema"] == "foxglove.PoseInFrame"
    assert pose["pose"]["position"] == {"x": 20.0, "y": 17.0, "z": 30.0}
    assert pose["position_covariance"] == [9.0, 0.1, -0.3, 0.1, 4.0, -0.2, -0.3, -0.2, 16.0]
    location = found["/agent_002/location"][7]
    assert location["_schema"] == "foxglove.LocationFix"
    assert location["position_covariance"] == pose["position_covariance"]
    assert location["position_covariance_type"] == 3
    place = FleetFrame.of(config).ned(location["latitude"], location["longitude"], location["altitude"])
    assert place == pytest.approx((17.0, 20.0, -30.0), abs=1e-3)


def test_fixes_and_ranges_are_numbers(tmp_path: Path, config: FleetConfig) -> None:
    found = written(tmp_path, config)
    assert found["/agent_001/range/agent_002"][3] == {
        "t_s": pytest.approx(100.3), "range_m": 37.4, "sigma_m": 0.05, "_schema": "fleetloc.Range"
    }  # fmt: skip
    assert "sigma_m" not in found["/agent_002/range/agent_003"][0]
    assert found["/agent_001/gps_ned"][4]["n_m"] == 4.5
    fix = found["/agent_001/gps"][4]
    assert (fix["_schema"], fix["position_covariance_type"]) == ("foxglove.LocationFix", 0)
    assert FleetFrame.of(config).ned(fix["latitude"], fix["longitude"], fix["altitude"])[0] == pytest.approx(
        4.5, abs=1e-3
    )


def test_who_is_no_part_of_an_estimate_is_nowhere(tmp_path: Path, config: FleetConfig) -> None:
    found = written(tmp_path, config)
    assert len(found["/agent_001/sees/agent_003"]) == 10
    assert [len(each["poses"]) for each in found["/agent_001/poses"]] == [2] * 10 + [3] * 10
    assert [set(each["agents"]) for each in found["/agent_001/estimate"]][9:11] == [
        {"agent_001", "agent_002"},
        {"agent_001", "agent_002", "agent_003"},
    ]
    assert "n_m_3" not in found["/agent_001/table"][9]
    places = [
        tuple(pose["position"].values())
        for topic, content in found.items()
        if topic.endswith("/poses")
        for each in content[1:]
        for pose in each["poses"]
    ]
    assert (0.0, 0.0, 0.0) not in places


def test_the_table_has_names_and_units_of_the_csv(tmp_path: Path, config: FleetConfig) -> None:
    from fleetloc.report.replay_exports import CsvWriter

    found = written(tmp_path, config)
    table = CsvWriter(tmp_path / "agent_001.csv", config.bodies, None, 100.0)
    table.write(ready(15))
    table.close()
    names, line = (tmp_path / "agent_001.csv").read_text().splitlines()
    told = {name: value for name, value in zip(names.split(","), line.split(","), strict=True) if value}
    message = {name: value for name, value in found["/agent_001/table"][15].items() if name != "_schema"}
    assert {name: float(value) for name, value in told.items()} == pytest.approx(message, abs=1e-3)


def test_maps_show_the_tracks(tmp_path: Path, config: FleetConfig) -> None:
    written(tmp_path, config)
    root = ElementTree.parse(tmp_path / run_files.KML).getroot()
    marks = {mark.findtext("k:name", "", KML_NS): mark for mark in root.iterfind(".//k:Placemark", KML_NS)}
    assert list(marks) == ["drone 1, estimate", "drone 1, gps", "drone 1, truth", "drone 2, estimate"]
    track = marks["drone 1, estimate"].find("gx:Track", KML_NS)
    assert track is not None
    whens, places = track.findall("k:when", KML_NS), track.findall("gx:coord", KML_NS)
    assert len(whens) == len(places) == round(2.0 / EVERY_S)
    origin = config.fleet.origin
    lon_deg, lat_deg, alt_m = map(float, (places[0].text or "").split())
    assert (lon_deg, lat_deg, alt_m) == pytest.approx((origin.lon_deg, origin.lat_deg, origin.alt_m), abs=1e-6)
    collection = json.loads((tmp_path / run_files.GEOJSON).read_text())
    assert [each["properties"]["name"] for each in collection["features"]] == list(marks)
    line = collection["features"][0]
    assert line["geometry"]["coordinates"][0][:2] == pytest.approx([lon_deg, lat_deg], abs=1e-7)
    assert len(line["properties"]["times"]) == len(line["geometry"]["coordinates"])
    assert line["properties"]["times"][0].endswith("Z")


@pytest.mark.parametrize(
    ("msl", "separation_m", "kml", "geojson"),
    [(True, None, "490.000", None), (True, 47.0, "490.000", 537.0), (False, 47.0, "443.000", 490.0),
     (False, None, "clampToGround", 490.0)],
)  # fmt: skip
def test_heights_are_those_that_the_format_wants_or_none(
    tmp_path: Path, msl: bool, separation_m: float | None, kml: str, geojson: float | None
) -> None:
    frame = FleetFrame(47.0, 8.0, 490.0, msl, separation_m)
    tracks = [MapTrack(1, "estimate", [(0.0, (0.0, 0.0, 0.0)), (1.0, (1.0, 0.0, 0.0))])]
    write_kml(tmp_path / "a.kml", "a & b", tracks, frame)
    write_geojson(tmp_path / "a.geojson", tracks, frame)
    text = (tmp_path / "a.kml").read_text()
    assert kml in text
    assert "a &amp; b" in text
    height = json.loads((tmp_path / "a.geojson").read_text())["features"][0]["geometry"]["coordinates"][0][2:]
    assert height == ([] if geojson is None else [pytest.approx(geojson, abs=1e-3)])


def test_the_layout_names_topics_and_fields_that_are_there(tmp_path: Path, config: FleetConfig) -> None:
    found = written(tmp_path, config)
    layout = json.loads((tmp_path / run_files.LAYOUT).read_text())
    panels = layout["configById"]

    def leaves(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == set(panels)
    shown = [each["value"] for panel in panels.values() for each in panel.get("paths", ())]
    assert len(shown) == 16
    for path in shown:
        topic, _, name = path.partition(".")
        assert any(name in message for message in found[topic]), path
    assert set(panels["3D!fleet"]["topics"]) <= found.keys()
    assert "/agent_001/location" in panels["map!fleet"]["topicColors"]


def test_the_command_reads_the_folder_of_a_run(
    tmp_path: Path, config: FleetConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    for agent_id in (1, 2):
        log = EstimateLogWriter(run_files.record_path(tmp_path, agent_id), header_of(config, agent_id), 10**9)
        for tick in range(20):
            log.write(ready(tick, absent=(0, 1, 2) if tick < 5 else ()), 100.1 + 0.1 * tick, 0.001)
        log.close()
    run_files.record_path(tmp_path, 3).write_bytes(b"{")
    assert cli.main(["export", str(LINE3), str(tmp_path), "--out", str(tmp_path / "made")]) == 0
    out = capsys.readouterr().out
    assert "note: record" in out
    assert "expected a first line of fleetloc-estimates/1" in out
    assert sorted(path.name for path in (tmp_path / "made").iterdir()) == sorted(run_files.EXPORTED)
    found = messages(tmp_path / "made" / run_files.MCAP)
    assert len(found["/agent_001/sees/agent_002"]) == 15
    assert cli.main(["export", str(LINE3), str(tmp_path / "made")]) == 2
    assert "agent_001.estimates, as a run leaves it" in capsys.readouterr().err


def test_fixes_and_ranges_of_a_run_come_from_its_flight_log(tmp_path: Path) -> None:
    for suffix in (".mcap", ".tlog"):
        shutil.copy((RECORDS / "two_places_002").with_suffix(suffix), (tmp_path / "agent_002").with_suffix(suffix))
    (tmp_path / run_files.CONFIG).write_text(FlightReader(tmp_path / "agent_002.mcap").start.config)
    config = load_config(tmp_path / run_files.CONFIG)
    EstimateLogWriter(run_files.record_path(tmp_path, 2), header_of(config, 2), 10**9).close()
    assert export_run(config, tmp_path, tmp_path) == []
    found = messages(tmp_path / run_files.MCAP)
    ranges = {topic: content for topic, content in found.items() if "/range/" in topic}
    assert set(ranges) == {"/agent_002/range/agent_001", "/agent_002/range/agent_003"}
    assert sum(map(len, ranges.values())) == 80
    firsts = [content[0]["range_m"] for _, content in sorted(ranges.items())]
    assert firsts == pytest.approx([28.316, 24.771], abs=1e-3)
    fixes = found["/agent_002/gps_ned"]
    assert len(fixes) == len(found["/agent_002/gps"]) == 40
    assert [fixes[0][name] for name in ("n_m", "e_m", "d_m")] == pytest.approx([-11.930, 9.180, -5.190], abs=1e-3)
    assert '"drone 2, gps"' in (tmp_path / run_files.GEOJSON).read_text()
