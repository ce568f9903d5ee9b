"""``fleetloc bench real`` and ``fleetloc import``, on robots that are made up in the form of the real files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fleetloc.bench.real import GRAPH, RAW, run_real
from fleetloc.cli import main
from fleetloc.errors import InputError
from sim_bridge.studies.study_input import load_study_input
from tests.support.planar_robots import as_pyfg, drive

NODES = {"13": 0.35, "14": 0.3, "15": 0.2, "34": 0.4, "35": 0.5, "45": 0.45}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / GRAPH).write_text(as_pyfg(drive(4, 12.0), np.random.default_rng(3)), encoding="utf-8")
    lines = ["timestamp,node1,node2,uwb_range,mocap_range"]
    for pair, bias_m in NODES.items():
        lines += [f"0,{pair[0]}.0,{pair[1]}.0,{4.0 + bias_m + 0.01 * k},4.0" for k in (-1, 0, 1, 0)]
    (tmp_path / RAW).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tmp_path


@pytest.mark.slow
def test_the_table_has_every_method_on_both_kinds_of_ranges(folder: Path) -> None:
    figures = run_real(folder, 0.005, 1.0, folder / "real.json")
    assert json.loads((folder / "real.json").read_text()) == figures
    assert figures["added_biases_m"]["AB"] == pytest.approx(0.35)
    assert figures["added_biases_m"]["CD"] == pytest.approx(0.45)
    clean, raw = ({one["method"]: one for one in figures[name]} for name in ("calibrated", "raw biases"))
    assert clean["shared MHE"]["rmse_m"] < 0.06
    assert 0.4 < clean["shared MHE"]["anees"] < 1.6
    # THEN the biases hurt who does not estimate them, and are found by who does
    assert raw["shared MHE"]["rmse_m"] > 2.0 * raw["shared MHE, biases"]["rmse_m"]
    assert raw["shared MHE, biases"]["worst_bias_error_m"] < 0.15
    assert raw["batch, biases"]["worst_bias_error_m"] < 0.1


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=GRAPH):
        run_real(tmp_path, 0.005, 2.0, None)


def test_import_makes_what_estimate_reads(folder: Path) -> None:
    assert main(["import", "pyfg", str(folder / GRAPH), "--out", str(folder / "run.npz")]) == 0
    assert load_study_input(folder / "run.npz").ticks == 120
    assert main(["import", "pyfg", str(folder / GRAPH), "--out", str(folder / "run")]) == 2
    assert main(["import", "csv", str(folder / RAW), "--out", str(folder / "other.npz")]) == 2
