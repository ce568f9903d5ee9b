"""Recordings: what was saved comes back; what cannot be used is refused with file, key, expected and found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_bridge.studies.study_input import REQUIRED, StudyInputError, load_study_input, study_input_from_arrays
from sim_bridge.studies.study_scenario import StudyScenario
from tests.support.builders import recording_arrays

Arrays = dict[str, Any]


def test_round_trip(tmp_path: Path) -> None:
    # GIVEN a study input with everything in it
    made = StudyScenario(graph="ring4", samples=6, blind=1).record(3, 0)
    made.received[2, 0, 1] = False
    made.delay_ticks[3, 1, 2] = 2
    path = tmp_path / "flight.npz"
    # WHEN it is saved and read, THEN nothing has changed
    made.save(path)
    read = load_study_input(path)
    for field in fields(made):
        np.testing.assert_array_equal(getattr(read, field.name), getattr(made, field.name), err_msg=field.name)
    assert read.ticks == 6


def test_optional_keys_have_defaults() -> None:
    arrays = recording_arrays()
    for key in ("received", "delay_ticks", "truth"):
        del arrays[key]
    read = study_input_from_arrays(arrays, "flight.npz")
    assert read.received.all()
    assert not read.delay_ticks.any()
    assert read.truth is None
    assert read.received.shape == read.delay_ticks.shape == (5, 3, 3)


def test_no_edges_is_a_fleet_of_loners() -> None:
    arrays = recording_arrays()
    arrays["edges"] = np.zeros((0, 2), np.int64)
    assert study_input_from_arrays(arrays, "x").edges.shape == (0, 2)


def put(key: str, value: Any) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.__setitem__(key, value)


def at(key: str, index: tuple[int, ...], value: Any) -> Callable[[Arrays], None]:
    def spoil(arrays: Arrays) -> None:
        arrays[key] = np.array(arrays[key])
        arrays[key][index] = value

    return spoil


BAD: dict[str, tuple[Callable[[Arrays], None], str]] = {
    "accel of another fleet": (
        put("accel", np.zeros((4, 2, 3))),
        r"accel: expected shape \(T, 3, 3\), found shape \(4, 2, 3\)",
    ),
    "accel without ticks": (
        put("accel", np.zeros((0, 3, 3))),
        "accel: expected at least one tick, found none",
    ),
    "accel NaN": (
        at("accel", (2, 1, 0), np.nan),
        r"accel: expected finite values, found nan at index \(2, 1, 0\)",
    ),
    "gps short": (
        put("gps", np.zeros((4, 3, 4))),
        r"gps: expected shape \(5, 3, 4\), found shape \(4, 3, 4\)",
    ),
    "gps infinite": (
        at("gps", (1, 2, 3), np.inf),
        r"gps: expected finite values or NaN .*, found inf at index \(1, 2, 3\)",
    ),
    "ranges not square": (put("ranges", np.zeros((5, 3, 2))), r"ranges: expected shape \(5, 3, 3\)"),
    "period zero": (put("period_s", 0.0), "period_s: expected a positive number, found 0"),
    "period a list": (put("period_s", [0.1]), r"period_s: expected shape \(\), found shape \(1,\)"),
    "period NaN": (put("period_s", np.nan), "period_s: expected finite values, found nan"),
    "period a word": (put("period_s", "0.1"), "period_s: expected numbers, found type <U3"),
    "agents floats": (put("agents", [1.0, 2.0, 3.0]), r"agents: expected integer ids 1..999"),
    "agents zero": (put("agents", [0, 1, 2]), r"agents: expected integer ids 1..999, found \[0, 1, 2\]"),
    "agents too large": (put("agents", [1, 2, 1000]), r"agents: expected integer ids 1..999"),
    "agents twice": (put("agents", [1, 2, 2]), r"agents: expected distinct ids, found \[1, 2, 2\]"),
    "agents none": (put("agents", np.zeros(0, int)), r"agents: expected shape \(n,\) with n at least 1"),
    "edge to an unknown agent": (
        put("edges", [[0, 1], [1, 3]]),
        r"edges: expected places of agents 0..2, found unknown agent in edge 1: \(1, 3\)",
    ),
    "edge to a negative place": (put("edges", [[0, -1]]), r"edges: expected places of agents 0..2"),
    "edge to itself": (
        put("edges", [[1, 1]]),
        r"edges: expected two different agents, found edge 0: \(1, 1\)",
    ),
    "edges of three": (put("edges", [[0, 1, 2]]), r"edges: expected shape \(m, 2\), found shape \(1, 3\)"),
    "half width zero": (
        put("range_half_width", 0.0),
        "range_half_width: expected a positive number, found 0",
    ),
    "half width negative": (
        put("accel_half_width", -0.1),
        "accel_half_width: expected a positive number, found -0.1",
    ),
    "gps half width zero": (
        put("gps_half_width", [0.1, 0.1, 0.0, 0.1]),
        "gps_half_width: expected positive values, found 0",
    ),
    "gps half width short": (
        put("gps_half_width", [0.1, 0.1]),
        r"gps_half_width: expected shape \(4,\), found shape \(2,\)",
    ),
    "x0 short": (put("x0", np.zeros((3, 6))), r"x0: expected shape \(3, 18\), found shape \(3, 6\)"),
    "x0 NaN": (at("x0", (0, 0), np.nan), "x0: expected finite values, found nan"),
    "P0 short": (put("P0", np.eye(6)), r"P0: expected shape \(18, 18\), found shape \(6, 6\)"),
    "P0 asymmetric": (at("P0", (0, 1), 0.5), "P0: expected a symmetric matrix, found an asymmetric one"),
    "P0 indefinite": (put("P0", -np.eye(18)), "P0: expected a positive definite matrix, found eigenvalue -1"),
    "received short": (put("received", np.ones((4, 3, 3), bool)), r"received: expected shape \(5, 3, 3\)"),
    "delay negative": (at("delay_ticks", (1, 0, 1), -1), "delay_ticks: expected no negative delay, found -1"),
    "truth short": (
        put("truth", np.zeros((5, 3, 5))),
        r"truth: expected shape \(5, 3, 6\), found shape \(5, 3, 5\)",
    ),
    "truth NaN": (
        at("truth", (4, 2, 5), np.nan),
        r"truth: expected finite values, found nan at index \(4, 2, 5\)",
    ),
}  # fmt: skip


BAD_FRACTIONS: dict[str, tuple[Callable[[Arrays], None], str]] = {
    "edge between": (put("edges", [[0.5, 1.0]]), r"edges: expected integer"),
    "delay a fraction": (put("delay_ticks", np.full((5, 3, 3), 0.5)), "delay_ticks: expected integer"),
}


@pytest.mark.parametrize("what", [*BAD, *BAD_FRACTIONS])
def test_bad_array_is_refused(what: str, tmp_path: Path) -> None:
    # GIVEN a study input with one fault
    arrays = recording_arrays()
    spoil, says = {**BAD, **BAD_FRACTIONS}[what]
    spoil(arrays)
    path = tmp_path / "flight.npz"
    np.savez(path, **arrays)
    # WHEN it is read, THEN the error names the file, the key, what was expected and what was found, in one line
    with pytest.raises(StudyInputError, match=says) as caught:
        load_study_input(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", REQUIRED)
def test_missing_key(key: str) -> None:
    arrays = recording_arrays()
    del arrays[key]
    with pytest.raises(StudyInputError, match=f"flight.npz: {key}: expected this key .*, found only "):
        study_input_from_arrays(arrays, "flight.npz")


# numpy leaves the file of a torn archive to the garbage collector
@pytest.mark.filterwarnings("ignore:Exception ignored:pytest.PytestUnraisableExceptionWarning")
def test_files_that_are_no_recording(tmp_path: Path) -> None:
    missing, text, folder = tmp_path / "no.npz", tmp_path / "text.npz", tmp_path / "folder.npz"
    text.write_text("hello")
    folder.mkdir()
    torn = tmp_path / "torn.npz"
    np.savez(torn, **recording_arrays())
    torn.write_bytes(torn.read_bytes()[:2000])
    empty = tmp_path / "empty.npz"
    empty.write_bytes(b"")
    with pytest.raises(StudyInputError, match=r"no\.npz: file: expected a study input .*, found no such file"):
        load_study_input(missing)
    for path in (text, folder, torn, empty):
        with pytest.raises(StudyInputError, match=r"file: expected a study input \(\.npz") as caught:
            load_study_input(path)
        assert "\n" not in str(caught.value)


def test_single_array_is_no_recording(tmp_path: Path) -> None:
    array = tmp_path / "array.npy"
    np.save(array, np.zeros(3))
    with pytest.raises(StudyInputError, match=r"file: expected a study input \(\.npz"):
        load_study_input(array)


def test_pickled_arrays_are_not_loaded(tmp_path: Path) -> None:
    # GIVEN an archive that would run code when it is unpickled
    class Trap:
        def __reduce__(self) -> Any:
            return (pytest.fail, ("unpickled",))

    path = tmp_path / "trap.npz"
    arrays = recording_arrays()
    arrays["truth"] = np.array([Trap()], dtype=object)
    np.savez(path, **arrays)
    # THEN it is refused
    with pytest.raises(StudyInputError, match="without pickles"):
        load_study_input(path)
