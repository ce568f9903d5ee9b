"""The fleet of simulators as one world: their truths put together, the ranges between their vehicles, the record.

The vehicles are moved by simulators that are not ours, so this world is not stepped but put where they say it is. A
range is taken at its own instant: every vehicle's last truth is carried on to it with its velocity, which over the
20 to 40 ms that truths are apart costs a few millimetres. Sans-I/O.
"""

from __future__ import annotations

import dataclasses
import math
from array import array

import numpy as np

from agent.config.tables import FleetConfig
from agent.fleet.lever_arms import has_arms
from sim_bridge.sitl.session import TimedTruth
from sim_bridge.sitl.sitl_table import sitl_table
from sim_bridge.sitl.truth import TRUTH_HZ
from sim_bridge.world.guidance import default_path
from sim_bridge.world.quaternions import Array
from sim_bridge.world.scenario import Scenario, ScenarioError
from sim_bridge.world.scenario_config import scenario_from_config
from sim_bridge.world.sensors import FleetSensors, SensedRanges
from sim_bridge.world.simulation import aligned_start
from sim_bridge.world.truth import Truth, TruthError
from sim_bridge.world.world import STEP_RATE_HZ, FleetWorld

FRESH_S = 0.1
"""A truth older than this is not carried on: at 5 m/s2 it would be 25 mm off."""
SMOOTHED_S = 0.5
STATE = 7
"""Numbers kept per truth: time, position, velocity."""


class VehicleTrack:
    """All truths of one vehicle, in order of time."""

    def __init__(self) -> None:
        self._kept = array("d")
        self.last: TimedTruth | None = None
        self.max_gap_s = 0.0

    def put(self, truth: TimedTruth) -> None:
        """Keep a truth later than the last."""
        if self.last is not None:
            self.max_gap_s = max(self.max_gap_s, truth.host_s - self.last.host_s)
        self.last = truth
        self._kept.extend((truth.host_s, *truth.position_m, *truth.velocity_mps))

    def begin(self) -> None:
        """Forget all but the last: the run begins now."""
        del self._kept[:-STATE]
        self.max_gap_s = 0.0

    def position_at(self, host_s: float) -> Array | None:
        """Position ``(3,)`` carried on from the last truth; ``None`` if that is too old."""
        if self.last is None or not -FRESH_S <= host_s - self.last.host_s <= FRESH_S:
            return None
        ahead_s = host_s - self.last.host_s
        return np.array(self.last.position_m) + ahead_s * np.array(self.last.velocity_mps)

    def samples(self) -> Array:
        """``(K, 7)``: time, position, velocity."""
        return np.array(self._kept).reshape(-1, STATE)


class SitlWorld:
    """All vehicles; ``unix_offset_s`` is Unix time minus the clock of the truths."""

    def __init__(self, config: FleetConfig, unix_offset_s: float) -> None:
        """Raises `ScenarioError` for rates that cannot be had."""
        self.scenario: Scenario = dataclasses.replace(
            scenario_from_config(config), uwb_reach_m=sitl_table(config).uwb_reach_m
        )
        if any(has_arms(agent) for agent in config.agents):
            raise ScenarioError("agents.uwb_tags_m: expected none in SITL, whose truth has no tilt to turn them with")
        self.unix_offset_s = unix_offset_s
        self.tracks = {agent_id: VehicleTrack() for agent_id in config.ids}
        self._run: _Run | None = None
        self.stale_s = 0.0
        """For how long a truth was missing, so that there were no ranges to or from its vehicle."""

    @property
    def start_s(self) -> float | None:
        """When the run began; ``None`` before `begin`."""
        return None if self._run is None else self._run.start_s

    def begin(self, now_s: float) -> float:
        """The run begins with the next fleet tick, at the time returned."""
        for track in self.tracks.values():
            track.begin()
        self._run = _Run(self.scenario, aligned_start(now_s, self.unix_offset_s, self.scenario), self.unix_offset_s)
        return self._run.start_s

    def positions_at(self, host_s: float) -> Array:
        """Positions ``(n, 3)`` NED m in order of the agents, NaN where a truth is missing or too old."""
        missing = np.full(3, np.nan)
        found = (track.position_at(host_s) for track in self.tracks.values())
        return np.array([missing if position is None else position for position in found])

    def ranges(self, now_s: float) -> list[tuple[float, SensedRanges]]:
        """The ranges whose turn has come, with their instants; turns that were slept through are left out."""
        run = self._run
        if run is None or not run.move_to(now_s):
            return []
        run.world.position_m[:] = self.positions_at(run.now_s)
        for slot, track in enumerate(self.tracks.values()):
            run.world.yaw_rad[slot] = 0.0 if track.last is None else track.last.yaw_rad
        # a distance to nowhere is not within reach, so that a vehicle without truth is neither observer nor target
        taken = [(run.now_s, ranges) for ranges in run.sensors.ranges()]
        self.stale_s += run.moved_s if np.isnan(run.world.position_m).any() else 0.0
        return taken

    def truth(self, end_s: float) -> Truth:
        """The record from the begin to ``end_s``, or to where the first track ends; raises `TruthError` if too short.

        All vehicles at common times, each interpolated in its own track.
        """
        run = self._run
        if run is None:
            raise TruthError("truth: expected a run that has begun, found none")
        tracks = {agent_id: track.samples() for agent_id, track in self.tracks.items()}
        first_s = max(run.start_s, *(float(samples[0, 0]) for samples in tracks.values()))
        last_s = min(end_s, *(float(samples[-1, 0]) for samples in tracks.values()))
        if last_s - first_s < 2.0 / TRUTH_HZ:
            raise TruthError(f"truth: expected more than two samples, found {max(last_s - first_s, 0.0):.3f} s")
        grid = first_s + np.arange(math.floor((last_s - first_s) * TRUTH_HZ) + 1) / TRUTH_HZ
        states = [_track_truth(agent_id, samples).at(grid)[:, 0] for agent_id, samples in tracks.items()]
        joint = np.stack(states, axis=1)
        bias_m = run.sensors.pair_bias_m
        return Truth(
            time_unix_s=grid + self.unix_offset_s,
            agents=tuple(tracks),
            position_m=joint[:, :, :3],
            velocity_mps=joint[:, :, 3:],
            pairs=np.array([sorted(pair) for pair in bias_m], int).reshape(len(bias_m), 2),
            pair_bias_m=np.array(list(bias_m.values()), float),
        )


class _Run:
    """Sensors over vehicles that are put, not flown, from ``start_s`` on."""

    def __init__(self, scenario: Scenario, start_s: float, unix_offset_s: float) -> None:
        count = len(scenario.ids)
        self.start_s = start_s
        self.moved_s = 0.0
        """Length of the last move."""
        nowhere = np.zeros((count, 3))
        self.world = FleetWorld(nowhere, nowhere, [default_path(slot, count) for slot in range(count)])
        self.sensors = FleetSensors(scenario, self.world, start_s + unix_offset_s - scenario.epoch_unix_s)

    @property
    def now_s(self) -> float:
        return self.start_s + self.world.time_s

    def move_to(self, now_s: float) -> bool:
        """Set the world's clock to its last step up to now; false if that is the present one."""
        step = math.floor((now_s - self.start_s) * STEP_RATE_HZ)
        if step <= self.world.step_index:
            return False
        self.moved_s = (step - self.world.step_index) * self.world.step_s
        self.world.step_index = step
        return True


def _track_truth(agent_id: int, samples: Array) -> Truth:
    """One vehicle's track as a truth of its own, for its interpolation."""
    none = np.empty((0, 2))
    position_m = smoothed_position(samples[:, 0], samples[:, 1:4], samples[:, 4:7])
    return Truth(samples[:, 0], (agent_id,), position_m[:, None], samples[:, None, 4:7], none, none[:, 0])


def smoothed_position(time_s: Array, position_m: Array, velocity_mps: Array) -> Array:
    """Positions ``(K, 3)`` whose steps agree with the velocities, at times ``(K,)``.

    Latitude and longitude come in whole 1e-7 deg (11 mm), so that between neighbours 20 ms apart the position alone
    would say a velocity wrong by up to 0.5 m/s. The velocity's integral carries the short term, the positions' mean
    distance from it over half a second the rest.
    """
    steps_m = 0.5 * np.diff(time_s)[:, None] * (velocity_mps[1:] + velocity_mps[:-1])
    travelled_m = np.concatenate((np.zeros((1, 3)), np.cumsum(steps_m, axis=0)))
    rest_m = position_m - travelled_m
    from_, to = (np.searchsorted(time_s, time_s + offset_s) for offset_s in (-0.5 * SMOOTHED_S, 0.5 * SMOOTHED_S))
    total_m = np.concatenate((np.zeros((1, 3)), np.cumsum(rest_m, axis=0)))
    return np.asarray(travelled_m + (total_m[to] - total_m[from_]) / (to - from_)[:, None])
