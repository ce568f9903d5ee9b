"""What the check of own positions under attack passes, and what it finds."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from agent.config.reading import load_config, with_other_table
from agent.config.tables import FleetConfig
from fleetloc.run import run_files
from fleetloc.run.lockstep_run import fly_in_lockstep
from sim_bridge.world.sim_table import sim_table
from sim_bridge.world.truth import load_truth
from tests.support.fleet_process import LINE3
from tests.support.own_error import SMOOTH_PATHS, mean_bound, own_nees, own_position_complaints, worst_bound

DURATION_S, SETTLED_S = 12.0, 6.0
SHIFT_M = 0.12, 0.12, 0.14
"""Along north, east, down: of the height the covariance claims the largest error."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[FleetConfig, Path]:
    """An undisturbed line3 in virtual time."""
    config, folder = load_config(LINE3, SMOOTH_PATHS), tmp_path_factory.mktemp("flight")
    sim = msgspec.structs.replace(sim_table(config), duration_s=DURATION_S)
    config = with_other_table(config, "sim", sim)
    fly_in_lockstep(config, folder)
    return config, folder


def window(config: FleetConfig, folder: Path, agent_id: int) -> NDArray[np.float64]:
    """NEES of an agent's own position, from when the flight has settled on."""
    end_s = float(load_truth(folder / run_files.TRUTH).time_unix_s[-1])
    squared = own_nees(config, folder, agent_id, end_s - DURATION_S + SETTLED_S, end_s)
    assert len(squared) >= 10 * (DURATION_S - SETTLED_S) - 2
    return squared


@pytest.mark.parametrize("agent_id", [1, 2, 3])
def test_an_undisturbed_agent_is_where_its_covariance_says(flight: tuple[FleetConfig, Path], agent_id: int) -> None:
    squared = window(*flight, agent_id)
    assert own_position_complaints("it", squared) == []
    assert squared.mean() > 0.5


@pytest.mark.parametrize("agent_id", [1, 2, 3])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("moved_m", "for_s", "where"),
    [(0.2, 0.3, "at the worst tick"), (SHIFT_M, DURATION_S, "in the mean")],
    ids=["leap", "shift"],
)
def test_a_position_that_is_moved_is_found(
    flight: tuple[FleetConfig, Path],
    tmp_path: Path,
    agent_id: int,
    axis: int,
    moved_m: float | tuple[float, float, float],
    for_s: float,
    where: str,
) -> None:
    config, folder = flight
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    truth = load_truth(folder / run_files.TRUTH)
    since_s = truth.time_unix_s - truth.time_unix_s[0] - SETTLED_S - 2.0
    elsewhere_m = truth.position_m.copy()
    along_m = moved_m if isinstance(moved_m, float) else moved_m[axis]
    elsewhere_m[(since_s > 0.0) & (since_s < for_s), agent_id - 1, axis] += along_m
    replace(truth, position_m=elsewhere_m).save(tmp_path / run_files.TRUTH)
    assert where in " ".join(own_position_complaints("it", window(config, tmp_path, agent_id)))


def tail(squared: float) -> float:
    """How often chi-square with 3 degrees of freedom exceeds a value."""
    half = squared / 2.0
    return math.erfc(math.sqrt(half)) + 2.0 * math.sqrt(half / math.pi) * math.exp(-half)


@pytest.mark.parametrize("ticks", [1, 40, 600])
def test_no_more_than_one_undisturbed_window_in_a_million_exceeds_a_bound(ticks: int) -> None:
    assert ticks * tail(worst_bound(ticks)) == pytest.approx(1e-6)
    # the mean of a window shorter than the memory is no surer than one tick; that of a long one is near 3
    assert mean_bound(ticks) <= mean_bound(1) == pytest.approx(worst_bound(1))
    assert mean_bound(100_000) == pytest.approx(3.0, rel=0.1)
