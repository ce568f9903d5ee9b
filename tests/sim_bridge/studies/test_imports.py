"""Study inputs of version 2: rows beside the arrays, made of CSV and of factor graphs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimators.model.measurements import Kind
from estimators.settings import default_settings
from sim_bridge.studies.flown import config_of
from sim_bridge.studies.imports.csv_rows import study_of_csv
from sim_bridge.studies.imports.pyfg import odometry_path, read_pyfg, study_of_graph
from sim_bridge.studies.lockstep import own_rows
from sim_bridge.studies.planar_batch import solve_batch
from sim_bridge.studies.study_input import StudyInput, StudyInputError, load_study_input, study_input_from_arrays
from sim_bridge.studies.study_rows import RowKind
from tests.support.planar_robots import ANCHOR_M, as_pyfg, drive

HEADER = "time_s,kind,body,other,value,sigma\n"
ROWS = (
    HEADER
    + "0,truth_n,rover,,0,\n0,truth_e,rover,,1,\n0,truth_d,rover,,-2,\n"
    + "0,truth_n,mast,,10,\n0,truth_e,mast,,1,\n0,truth_d,mast,,-2,\n"
    + "0,anchor_n,pole,,3,\n0,anchor_e,pole,,4,\n0,anchor_d,pole,,0,\n"
    + "0.00,position_e,rover,,1.01,0.1\n"
    + "0.12,range,rover,mast,10.02,0.05\n"
    + "0.31,anchor_range,mast,pole,7.9,0.05\n"
    + "0.40,speed,mast,,0.2,0.1\n"
)


def graph_file(folder: Path, text: str | None = None) -> Path:
    path = folder / "drive.pyfg"
    path.write_text(as_pyfg(drive(3, 6.0), np.random.default_rng(1)) if text is None else text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def planar(tmp_path_factory: pytest.TempPathFactory) -> StudyInput:
    return study_of_graph(read_pyfg(graph_file(tmp_path_factory.mktemp("graph"))))


def test_rows_come_back_from_a_file(planar: StudyInput, tmp_path: Path) -> None:
    planar.save(tmp_path / "run.npz")
    read = load_study_input(tmp_path / "run.npz")
    assert planar.rows is not None
    assert read.rows is not None
    for field in fields(planar.rows):
        np.testing.assert_array_equal(getattr(read.rows, field.name), getattr(planar.rows, field.name), field.name)
    for slot in range(3):
        np.testing.assert_array_equal(own_rows(read, 7, slot), own_rows(planar, 7, slot))


def test_agents_do_not_fly_what_they_have_no_sensors_for(planar: StudyInput) -> None:
    with pytest.raises(ValueError, match="version 1"):
        config_of(planar, default_settings())


def test_lines_of_a_csv_become_rows(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(ROWS, encoding="utf-8")
    made = study_of_csv(path)
    assert (made.ticks, made.agents.tolist()) == (4, [1, 2])  # mast, rover: by name
    assert made.truth is None
    np.testing.assert_array_equal(made.x0[0].reshape(2, 6)[:, :3], [[10, 1, -2], [0, 1, -2]])
    (fix,) = own_rows(made, 0, 1)
    assert (fix["kind"], fix["value"], fix["y"], fix["x"]) == (Kind.POSITION, 1.01, 1.0, 0.0)
    (ranged,) = own_rows(made, 1, 1)
    assert (ranged["kind"], ranged["other"], ranged["variance"]) == (Kind.RANGE, 0, pytest.approx(0.0025))
    assert ranged["offset_s"] == pytest.approx(0.02)
    (to_pole,) = own_rows(made, 3, 0)
    assert [to_pole[axis] for axis in "xyz"] == [3.0, 4.0, 0.0]
    assert own_rows(made, 4, 0)["kind"] == [Kind.SPEED]


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("0,heading,rover,,1,1", ":.*kind: expected one of"),
        ("0,range,rover,rover,1,1", "other: expected the name of the other end"),
        ("0,range,rover,nobody,1,1", "range: expected a body or an anchor"),
        ("0,speed,rover,,fast,1", "value: expected a number, found 'fast'"),
        ("0,speed,rover,,nan,1", "value: expected a finite number"),
        ("0,speed,rover,,1,0", "sigma: expected above 0"),
        ("0,speed,,,1,1", "body: expected a name"),
        ("0,speed,drone,,1,1", "body drone: expected truth_n, truth_e and truth_d"),
    ],
)
def test_a_line_that_is_none_is_named(line: str, fault: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(ROWS + line + "\n", encoding="utf-8")
    with pytest.raises(StudyInputError, match=fault):
        study_of_csv(path)


def test_a_factor_graph_becomes_odometry_ranges_and_anchors(planar: StudyInput) -> None:
    rows, truth = planar.rows, planar.truth
    assert rows is not None
    assert truth is not None
    assert planar.ticks == 60
    np.testing.assert_array_equal(rows.anchors_m, [[ANCHOR_M[0], -ANCHOR_M[1], 0.0]])
    # THEN ranges and velocities are those of the truth, up to the noise that was put on them
    table, state = rows.table(), truth.reshape(61, 3, 6)
    for kind, sigma in ((RowKind.RANGE, 0.04), (RowKind.ANCHOR_RANGE, 0.04)):
        errors = []
        for row in table[rows.kind == kind]:
            place = state[row["tick"], :, :3]
            far = place[row["other"]] if kind is RowKind.RANGE else np.array([row[axis] for axis in "xyz"])
            errors.append(row["value"] - np.linalg.norm(place[row["agent"]] - far))
        assert len(errors) > 100
        assert 0.8 < np.std(errors) / sigma < 1.2
    odometry = table[rows.kind == RowKind.VELOCITY_N]
    apart = [
        row["value"] - (state[row["tick"], row["agent"], 0] - state[row["tick"] - 1, row["agent"], 0]) / 0.1
        for row in odometry
        if row["offset_s"] < 0
    ]
    assert len(apart) > 30
    assert 0.7 < np.std(apart) / np.sqrt(odometry["variance"][0]) < 1.4


def test_odometry_is_integrated_with_the_true_heading(tmp_path: Path) -> None:
    graph = read_pyfg(graph_file(tmp_path))
    times_s, path_m, variance_m2 = odometry_path("B", graph)
    truth_s, place_m = graph.truth()["B"]
    np.testing.assert_allclose(times_s, truth_s)
    off = np.linalg.norm(path_m - (place_m - place_m[0])[:, :2], axis=1)
    assert off[-1] < 4.0 * np.sqrt(2.0 * variance_m2[-1])
    assert variance_m2[-1] == pytest.approx(120 * 0.004**2)


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lambda text: text.replace("VERTEX_XY L0", "VERTEX_SE3 L0"), "kind: expected one of"),
        (lambda text: text.replace("VERTEX_XY L0 0.5", "VERTEX_XY L0 nan"), "finite numbers"),
        (lambda text: text.replace("VERTEX_XY L0 0.5 -1.0\n", ""), "a vertex or landmark of the file, found L0"),
        (lambda text: text.replace("VERTEX_XY L0 0.5", "VERTEX_XY L0"), "4 words, found 3"),
        (lambda text: text.replace("A0 A1", "A0 B1"), "odometry of one robot"),
        (lambda text: "", "a file without them"),
    ],
)
def test_a_factor_graph_that_is_none_is_named(spoil: Callable[[str], str], fault: str, tmp_path: Path) -> None:
    text = spoil(as_pyfg(drive(2, 0.2), np.random.default_rng(1)))
    with pytest.raises(StudyInputError, match=fault):
        read_pyfg(graph_file(tmp_path, text))


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("version", 3, "1 or 2"),
        ("row_kind", 9, "whole numbers from 0 to 8"),
        ("row_body", 3, "whole numbers from 0 to 2"),
        ("row_tick", 61, "whole numbers from 0 to 60"),
        ("row_variance", 0.0, "positive values"),
        ("row_value", np.inf, "finite values"),
    ],
)
def test_rows_that_cannot_be_are_refused(planar: StudyInput, key: str, value: Any, fault: str) -> None:
    arrays = arrays_of(planar)
    arrays[key] = (
        np.array(value) if key == "version" else np.where(np.arange(len(arrays[key])) == 5, value, arrays[key])
    )
    with pytest.raises(StudyInputError, match=f"{key}: expected {fault}"):
        study_input_from_arrays(arrays, "run.npz")


def test_a_range_to_nobody_is_refused(planar: StudyInput) -> None:
    arrays = arrays_of(planar)
    arrays["row_other"] = np.where(arrays["row_kind"] == RowKind.ANCHOR_RANGE, 1, arrays["row_other"])
    with pytest.raises(StudyInputError, match="row_other"):
        study_input_from_arrays(arrays, "run.npz")


def arrays_of(recording: StudyInput) -> dict[str, Any]:
    assert recording.rows is not None
    arrays = {field.name: getattr(recording, field.name) for field in fields(recording) if field.name != "rows"}
    rows = {f"row_{field.name}": getattr(recording.rows, field.name) for field in fields(recording.rows)}
    return {**arrays, **rows, "anchors_m": rows.pop("row_anchors_m"), "version": np.array(2)}


def test_a_batch_finds_the_path_and_the_biases(tmp_path: Path) -> None:
    # GIVEN a drive whose ranges are too long by what each pair has
    bias_m = {(0, 1): 0.3, (0, 2): -0.1, (1, 2): 0.5}
    text = as_pyfg(drive(3, 20.0), np.random.default_rng(2), bias_m)
    recording = study_of_graph(read_pyfg(graph_file(tmp_path, text)))
    solved, blind = solve_batch(recording, biases=True), solve_batch(recording, biases=False)
    assert recording.truth is not None
    off, off_blind = (
        float(np.sqrt(((each.position_m - recording.truth[:, :, :2]) ** 2).sum(-1).mean()))
        for each in (solved, blind)
    )
    assert off < 0.05
    assert off_blind > 2.0 * off
    assert solved.bias_m == {pair: pytest.approx(true_m, abs=0.03) for pair, true_m in bias_m.items()}
