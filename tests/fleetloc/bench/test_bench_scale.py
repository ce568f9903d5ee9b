"""``fleetloc bench scale``: graphs, figures that repeat, and the command from end to end."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from fleetloc import cli
from fleetloc.bench.scale_flights import ScaleFlight, fly, places_and_edges

SHORT = ScaleFlight(size=7, seed=2, joint_bodies=4, duration_s=4.0, settle_s=2.5, degree=3.0, timed=1)


@pytest.mark.parametrize(("size", "degree"), [(10, 6.0), (40, 6.0), (5, 9.0)])
def test_a_graph_links_the_nearest_and_is_connected(size: int, degree: float) -> None:
    places, edges = places_and_edges(size, degree, 1)
    again, same = places_and_edges(size, degree, 1)
    np.testing.assert_array_equal(places, again)
    assert edges == same
    assert len(edges) == min(round(degree * size / 2), size * (size - 1) // 2)
    apart = {(a, b): np.linalg.norm(places[a - 1] - places[b - 1]) for a in range(1, size + 1) for b in range(1, a)}
    linked = [apart[max(edge), min(edge)] for edge in edges]
    others = [far for (a, b), far in apart.items() if (b, a) not in edges]
    assert not others or max(linked) <= min(others)
    reached = {1}
    for _ in range(size):
        reached |= {agent for edge in edges if reached & set(edge) for agent in edge}
    assert reached == set(range(1, size + 1))


def test_a_graph_that_cannot_be_is_said_to_be_none() -> None:
    with pytest.raises(ValueError, match="no connected graph"):
        places_and_edges(60, 1.0, 1)


def test_a_flight_repeats_but_for_its_times() -> None:
    first, second = fly(SHORT), fly(SHORT)
    for name in ("bytes_per_s", "largest_packet", "own_rmse_m", "own_anees", "far_rmse_m", "far_age_s", "joint"):
        assert getattr(first, name) == getattr(second, name)
    assert len(first.cpu_s) == 1
    assert (first.cpu_s > first.step_s).all()
    assert (first.step_s > 0).all()
    assert first.far_rmse_m > first.own_rmse_m
    assert 1.0 < first.joint <= 4.0
    assert first.shown == 1.0


def test_the_command_compares_sizes_and_the_whole_state(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = tmp_path / "scale.json"
    line = "bench scale --sizes 4,7 --whole 7 --joint-bodies 4 --degree 3 --duration 6 --settle 4 --timed 1"
    assert cli.main([*line.split(), "--json", str(found)]) == 0
    results = json.loads(found.read_text())
    rows = {(row["drones"], row["joint_bodies"]): row for row in results["rows"]}
    assert set(rows) == {(4, 4), (7, 4), (7, 7)}
    assert rows[7, 4]["near_bytes_per_s"] < rows[7, 7]["near_bytes_per_s"]
    assert rows[7, 4]["far_bytes_per_s"] > 0.0
    assert rows[4, 4]["far_bytes_per_s"] == rows[7, 7]["far_bytes_per_s"] == 0.0
    between, against = results["ratios"]
    assert (between["from_drones"], between["to_drones"]) == (4, 7)
    ratio = against["own_rmse_m_neighbourhood_to_whole"]
    assert ratio == pytest.approx(rows[7, 4]["own_rmse_m"] / rows[7, 7]["own_rmse_m"])
    assert math.isfinite(ratio)
    assert "of the whole state's" in capsys.readouterr().out


def test_a_flight_that_is_all_settling_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "scale", "--duration", "10", "--settle", "12"]) != 0
    assert "--settle" in capsys.readouterr().err
    # nor one that leaves no time for a far report, nor graphs that cannot be connected
    assert cli.main(["bench", "scale", "--duration", "6", "--settle", "5"]) != 0
    assert "--settle" in capsys.readouterr().err
    assert cli.main(["bench", "scale", "--sizes", "60", "--whole", "5", "--degree", "2"]) != 0
    assert "--degree" in capsys.readouterr().err
