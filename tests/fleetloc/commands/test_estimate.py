"""``fleetloc estimate``: frozen cases through the real command, and one clear line for whatever cannot be run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetloc import cli
from fleetloc.errors import BAD_INPUT
from sim_bridge.studies.study_scenario import StudyScenario
from tests.support import frozen_cases
from tests.support.builders import recording_arrays

KEPT = Path(__file__).parents[2] / "data" / "dmhe"
SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "cases" / "dmhe"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A short flight."""
    path = tmp_path / "flight.npz"
    StudyScenario(samples=5).record(1, 0).save(path)
    return path


@pytest.mark.parametrize(
    "case",
    [
        KEPT / "c09_pre_loss30_drop.npz",
        KEPT / "c12_ring4_dt02_N3_L2.npz",
        SHARED / "c03_dmhe1_N2_L1.npz",
        SHARED / "c05_dekf_ci_L1.npz",
    ],
    ids=lambda path: path.stem,
)
def test_frozen_case(case: Path, tmp_path: Path) -> None:
    # GIVEN a case converted by the script that users of the cases run
    if not case.exists():
        pytest.skip("shared/cases/dmhe is not beside the repository")
    cases, converted = tmp_path / "cases", tmp_path / "converted"
    cases.mkdir()
    (cases / case.name).write_bytes(case.read_bytes())
    frozen_cases.main(cases, converted)
    # WHEN the command runs on recording and settings
    recording, config, out = converted / case.name, converted / f"{case.stem}.toml", tmp_path / "out.npz"
    assert cli.main(["estimate", str(recording), "--config", str(config), "--out", str(out)]) == 0
    # THEN its estimates are the case's, within the case's tolerance
    arrays, _ = frozen_cases.load_case(case)
    tolerance = arrays["tol_t"]
    compared = np.isfinite(tolerance)
    with np.load(out, allow_pickle=False) as written:
        mean, cov_diag, status = written["mean"], written["cov_diag"], written["status"]
    assert mean.shape == cov_diag.shape == arrays["x_hat"].shape
    assert status.dtype == np.int8
    assert status.shape == mean.shape[:2]
    difference = np.abs(mean - arrays["x_hat"]).max(axis=(1, 2))
    assert (difference[compared] <= tolerance[compared]).all()


def test_figures(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # WHEN figures are asked for
    out, figures = tmp_path / "out.npz", tmp_path / "figures.json"
    options = ["--set", "estimator.kind=dekf_ci", "--out", str(out), "--json", str(figures)]
    assert cli.main(["estimate", str(recording), *options]) == 0
    # THEN they are those of the estimates that were written
    written = json.loads(figures.read_text())
    assert written["estimator"] == "dekf_ci"
    assert written["study_input"] == "flight.npz"
    assert written["ticks"] == 6
    assert written["late_records_dropped"] == 0
    assert [agent["id"] for agent in written["agents"]] == [1, 2, 3]
    truth = StudyScenario(samples=5).record(1, 0).truth
    assert truth is not None
    with np.load(out) as estimates:
        error = estimates["mean"] - truth.reshape(6, 1, 18)
    for slot, agent in enumerate(written["agents"]):
        own = error[1:, slot, 6 * slot : 6 * slot + 3]
        assert agent["position_rmse_m"] == pytest.approx(float(np.sqrt(np.mean(np.sum(own**2, axis=1)))))
        assert agent["norm_full_final"] == pytest.approx(float(np.linalg.norm(error[-1, slot])))
        assert agent["status"]["ok"] == 6
    # and people get a table
    assert "position RMSE m" in capsys.readouterr().out


def test_without_truth_there_are_no_errors_to_print(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays = recording_arrays()
    del arrays["truth"]
    path, figures = tmp_path / "flight.npz", tmp_path / "figures.json"
    np.savez(path, **arrays)
    assert cli.main(["estimate", str(path), "--set", "estimator.kind=dekf_ci", "--json", str(figures)]) == 0
    assert "position RMSE" not in capsys.readouterr().out
    assert all("position_rmse_m" not in agent for agent in json.loads(figures.read_text())["agents"])


def drop(key: str) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.pop(key)


def put(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.__setitem__(key, value)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (drop("accel"), "accel: expected this key"),
        (put("gps", np.zeros((2, 3, 4))), "gps: expected shape (5, 3, 4), found shape (2, 3, 4)"),
        (put("accel", np.full((4, 3, 3), np.nan)), "accel: expected finite values, found nan at index (0, 0, 0)"),
        (
            put("edges", [[0, 1], [1, 7]]),
            "edges: expected places of agents 0..2, found unknown agent in edge 1: (1, 7)",
        ),
    ],
    ids=["missing key", "wrong shape", "NaN", "unknown agent"],
)
def test_bad_recording_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[dict[str, Any]], None], says: str
) -> None:
    # GIVEN a study input with one fault, WHEN the command runs, THEN one line names file, key, expected and found
    arrays = recording_arrays()
    spoil(arrays)
    path = tmp_path / "flight.npz"
    np.savez(path, **arrays)
    out = tmp_path / "out.npz"
    assert cli.main(["estimate", str(path), "--out", str(out)]) == BAD_INPUT
    printed, err = capsys.readouterr()
    assert printed == ""
    assert err.startswith(f"fleetloc: error: {path}: {says}")
    assert err.count("\n") == 1
    assert not out.exists()


def test_file_that_is_no_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = tmp_path / "notes.npz"
    text.write_text("not an archive")
    trap = tmp_path / "trap.npz"
    np.savez(trap, **{**recording_arrays(), "truth": np.array([object()], dtype=object)})
    missing = tmp_path / "no.npz"
    for path, says in ((text, "expected a study input"), (trap, "without pickles"), (missing, "no such file")):
        assert cli.main(["estimate", str(path)]) == BAD_INPUT
        err = capsys.readouterr().err
        assert str(path) in err
        assert says in err
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("setting", "names"),
    [
        ("estimator.window=0", ("estimator.window", ">= 1")),
        ("estimator.window=-3", ("estimator.window", ">= 1")),
        ("estimator.rounds=-1", ("estimator.rounds", ">= 0")),
        ("estimator.kind=magic", ("estimator.kind", "dmhe_pre_ekf", "magic")),
        ("estimator.windows=2", ("windows",)),
        ("estimator.tolerance=0", ("estimator.tolerance", "> 0")),
    ],
)
def test_bad_setting_is_one_line(
    recording: Path, capsys: pytest.CaptureFixture[str], setting: str, names: tuple[str, ...]
) -> None:
    assert cli.main(["estimate", str(recording), "--set", setting]) == BAD_INPUT
    printed, err = capsys.readouterr()
    assert printed == ""
    assert err.count("\n") == 1
    for name in names:
        assert name in err


def test_bad_configuration_names_the_file(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "fleet.toml"
    config.write_text("[estimator]\nwindow = 0\n")
    assert cli.main(["estimate", str(recording), "--config", str(config)]) == BAD_INPUT
    err = capsys.readouterr().err
    assert str(config) in err
    assert "estimator.window" in err
    # the command line beats the file
    assert cli.main(["estimate", str(recording), "--config", str(config), "--set", "estimator.window=1"]) == 0
