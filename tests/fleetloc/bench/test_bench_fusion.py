"""``fleetloc bench fusion``: a few runs of every method beside the expected figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fleetloc import cli
from fleetloc.bench.lossy_fusion import METHODS, SETTINGS, fly


def test_a_few_runs_are_near_the_expected_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = tmp_path / "fusion.json"
    assert cli.main(["bench", "fusion", "--runs", "4", "--seed", "1", "--json", str(figures)]) == 0
    assert "central_conditional" in capsys.readouterr().out
    settings = json.loads(figures.read_text())["settings"]
    assert set(settings) == {setting.name for setting in SETTINGS}
    for setting in settings.values():
        assert set(setting["methods"]) == set(METHODS)
        # four runs have a coarse standard error: five of them, and only of what does not diverge
        for method in ("no_loss", "stamped", "central", "leader_only", "age_trace"):
            assert abs(setting["methods"][method]["standard_errors_apart"]) < 5.0, method


def test_what_is_delivered_is_what_the_outcome_says() -> None:
    import numpy as np

    flight = fly(SETTINGS[0], np.random.default_rng(5))
    for k in range(1, len(flight.truth)):
        for agent in range(2):
            expected = {
                0: flight.received[k - 1, agent],
                1: flight.measured[k, agent],
                2: flight.measured[k - 1, agent],
            }[int(flight.outcome[k, agent])]
            np.testing.assert_array_equal(flight.received[k, agent], expected)
    assert set(flight.outcome[:, 0]) == {1}
    assert set(flight.outcome[:, 1]) == {0, 1, 2}
