"""The ticks at which an agent had its data in time: how good it then is, the machine has no part in."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.log.estimate_log import read_entries
from fleetloc.run import run_files
from sim_bridge.world.truth import load_truth

SETTLED_S = 10.0


class Settled(NamedTuple):
    """K ticks of one agent: when, in s since the start of the world, ages ``(K, n)`` of its data in ticks, and how
    far ``(K,)`` its own position is off, in m."""

    time_s: NDArray[np.float64]
    age_ticks: NDArray[np.uint16]
    error_m: NDArray[np.float64]


def settled(config: FleetConfig, directory: Path, agent_id: int) -> Settled:
    """From `SETTLED_S` on."""
    header, entries = read_entries(run_files.record_path(directory, agent_id))
    truth, slot = load_truth(directory / run_files.TRUTH), config.ids.index(agent_id)
    unix_s = entries["t_s"] + header.epoch_unix_s
    inside = (unix_s >= truth.time_unix_s[0] + SETTLED_S) & (unix_s < truth.time_unix_s[-1])
    place_m = entries["mean"][inside].reshape(-1, len(config.ids), 6)[:, slot, :3]
    error_m = np.linalg.norm(place_m - truth.at(unix_s[inside])[:, slot, :3], axis=1)
    return Settled(unix_s[inside] - truth.time_unix_s[0], entries["age_ticks"][inside], error_m)


def informed(ages: NDArray[np.uint16], usual: NDArray[np.uint16], window: int) -> NDArray[np.bool_]:
    """Whether, at a tick and all before it in the window, no age was above the usual ``(n,)``; ``(K,)``."""
    in_time = (ages <= usual).all(axis=1)
    filled = np.convolve(in_time, np.ones(window), "full")[: len(in_time)]
    return np.asarray(filled == window)
