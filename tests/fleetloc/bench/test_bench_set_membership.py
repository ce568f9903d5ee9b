"""``fleetloc bench setmembership``: the sets hold the truth, the Kalman filter's three sigma do not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fleetloc import cli

RUNS = 12


def test_the_half_circle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "setmembership", "--runs", str(RUNS), "--json", str(tmp_path / "sets.json")]) == 0
    assert "half axes" in capsys.readouterr().out
    document = json.loads((tmp_path / "sets.json").read_text())
    rows = document["rows"]
    sets = [row for name, row in rows.items() if "| set" in name]
    assert len(sets) == 6
    assert all(row["runs_outside"] == row["epochs_empty"] == 0 for row in sets)
    assert 0.22 < rows["code within 2 m, biased | Kalman, 3 sigma, code and ranges"]["half_axis_1_m"] < 0.36
    assert rows["code within 3 m, biased | Kalman, 3 sigma, code"]["runs_outside"] >= RUNS - 2
    assert 5.5 < rows["code within 3 m, biased | set, code"]["half_axis_1_m"] < 7.5
    assert 0.65 < rows["code within 2 m, biased | set, code and ranges"]["trace_ratio"] < 0.75
    assert document["step_us"] > 0.0
