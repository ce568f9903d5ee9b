"""Whether an agent's own position is further from the truth than its own covariance admits.

A few seconds of one flight hold a handful of independent errors, as what the estimator keeps of a measurement fades
within some ticks. Over windows of 4 s of undisturbed flights, the root mean square error of one agent of line3 is 2.3
to 7.3 cm, and more where a busy machine makes packets late: the ratio of two of them says nothing. The normalised
error (NEES) of a tick knows what was late, as the covariance has grown by it. It is chi-square with 3 degrees of
freedom if the covariance is right, which takes paths whose accelerations do not leap.

Two bounds are put on it. The worst of many ticks, however correlated they are, exceeds a value no more often than the
sum of what each tick does: this finds a short leap. The mean is that of as many independent errors as the window has
spans of `MEMORY_TICKS`: this finds a small shift that lasts.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from agent.config.tables import FleetConfig
from agent.log.estimate_log import covariance_of, read_entries
from estimators.estimator import Status
from estimators.integrity.consistency import nees
from estimators.model.layout import Layout, position
from fleetloc.run import run_files
from sim_bridge.world.truth import load_truth

FALSE_ALARMS = 1e-6
"""Of one bound in one window of one agent, if its covariances are right."""
MEMORY_TICKS = 15
"""From here on, the NEES of two ticks of line3 are uncorrelated; their correlations sum up to 13."""
SMOOTH_PATHS = ('sim.paths.3={agent=3, kind="circle", center_m=[-7.0, -3.0, -7.0], radius_m=4.0, lap_s=26.0}',)
"""Overrides for line3: at its waypoints agent 3's acceleration leaps, and its NEES is twice what it should be."""


def own_nees(
    config: FleetConfig, directory: Path, agent_id: int, begin_s: float, end_s: float
) -> NDArray[np.float64]:
    """NEES of the own position, by tick with an estimate between two UTC seconds; its mean should be 3."""
    _, entries = read_entries(run_files.record_path(directory, agent_id))
    unix_s = config.fleet.epoch_unix_s + entries["t_s"]
    inside = (unix_s >= begin_s) & (unix_s < end_s) & (entries["status"] != Status.NO_DATA)
    slot = Layout(config.ids).slot(agent_id)
    own = position(slot)
    true_m = load_truth(directory / run_files.TRUTH).at(unix_s[inside])[:, slot, :3]
    error_m = entries["mean"][inside][:, own] - true_m
    covariances = (covariance_of(entry, len(config.ids))[own, own] for entry in entries[inside])
    return np.array([nees(*pair) for pair in zip(error_m, covariances, strict=True)])


def worst_bound(ticks: int) -> float:
    """What the worst NEES of so many ticks exceeds by chance in one of a million windows at most."""
    return float(chdtri(3.0, FALSE_ALARMS / ticks))


def mean_bound(ticks: int) -> float:
    """What the mean NEES of so many ticks in a row exceeds by chance in one of a million windows at most."""
    independent = max(ticks / MEMORY_TICKS, 1.0)
    return float(chdtri(3.0 * independent, FALSE_ALARMS)) / independent


def own_position_complaints(who: str, squared: NDArray[np.float64]) -> list[str]:
    """What of a window's NEES, at least one tick, no undisturbed agent would show."""
    values = {"in the mean": (squared.mean(), mean_bound(len(squared))),
              "at the worst tick": (squared.max(), worst_bound(len(squared)))}  # fmt: skip
    return [
        f"{who}: NEES of the own position {where} {found:.1f}, at most {bound:.1f} expected"
        for where, (found, bound) in values.items()
        if found > bound
    ]
