"""The agent's own MAVLink session on the fake autopilots, in virtual time: both ends speak of the same world."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.mavlink.session import LinkState
from agent.sensing.frames import gravity_mps2, rotated
from agent.sensing.samples import AttitudeSample, GpsSample, ImuSample
from sim_bridge.world.scenario_config import scenario_from_config
from sim_bridge.world.simulation import Simulation
from tests.support.onboard import onboard_of

START_S = 5000.0
EPOCH_S = 1.7e9
TRANSIT_S = 0.002
BOTH = pytest.mark.parametrize("flavour", ["px4", "ardupilot"])


class Run:
    """One agent's session and its simulated drone, joined by a link that takes 2 ms each way."""

    def __init__(self, flavour: str, attitude_hz: float = 50.0, **sim: Any) -> None:
        config = config_from(
            {
                "fleet": {
                    "name": "t",
                    "origin": {"lat_deg": 47.4, "lon_deg": 8.5, "alt_m": 480.0, "altitude": "ellipsoid"},
                    "epoch_unix_s": EPOCH_S,
                },
                "agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:14551", "autopilot": flavour}],
                "sensors": {"gps_speed": "norm", "imu_latency_s": 0.0},
                "mavlink": {"attitude_hz": attitude_hz},
                "sim": sim,
            },
            "test",
        )
        self.gravity = gravity_mps2(config)
        scenario = replace(scenario_from_config(config), attitude_hz=attitude_hz)
        self.simulation = Simulation(scenario, START_S, EPOCH_S - START_S)
        self.session = onboard_of(config, linked=True, fleet_offset_s=-START_S).autopilot
        self.samples: list[Any] = []
        self.states: dict[int, np.ndarray] = {}

    def to(self, time_s: float) -> Run:
        """Fly to ``time_s`` after the start; ``states`` by step holds position, velocity, acceleration."""
        while self.simulation.world.time_s < time_s - 1e-9:
            now = self.simulation.next_step_s()
            frames = [frame for _, frame in self.simulation.advance(now).frames]
            world = self.simulation.world
            self.states[world.step_index] = np.hstack(
                (world.position_m[0], world.velocity_mps[0], world.accel_mps2[0])
            )
            arrival = now + TRANSIT_S
            self._deliver(frames, arrival)
            for frame in self.session.to_send(arrival, None):
                self._deliver(self.simulation.receive(1, frame, arrival + TRANSIT_S), arrival + 2 * TRANSIT_S)
        return self

    def _deliver(self, frames: list[bytes], now: float) -> None:
        for frame in frames:
            self.samples += self.session.receive(frame, now)

    def state_at(self, t_s: float) -> np.ndarray:
        """The truth at a sample's time, which has to be that of a step."""
        step = round(t_s * 200)
        assert t_s == pytest.approx(step / 200, abs=1.5e-3)
        return self.states[step]

    def of(self, kind: type, from_s: float = 3.0) -> list[Any]:
        """Samples of one kind after the clocks have found each other."""
        return [sample for sample in self.samples if isinstance(sample, kind) and sample.t_s > from_s]


@BOTH
def test_rates_are_granted_and_clocks_agree(flavour):
    run = Run(flavour).to(12.0)
    assert run.session.state is LinkState.CONNECTED
    assert run.session.clock.synchronised
    assert run.session.clock.rtt_s == pytest.approx(2 * TRANSIT_S, abs=1e-6)
    assert len(run.of(ImuSample, 6.0)) == pytest.approx(600, rel=0.03)
    assert len(run.of(AttitudeSample, 6.0)) == pytest.approx(300, rel=0.03)
    assert len(run.of(GpsSample, 6.0)) == pytest.approx(60, abs=2)
    assert not run.session.decoder.bad


@BOTH
def test_gravity_removed_leaves_the_true_acceleration_and_the_papers_noise(flavour):
    run = Run(flavour, attitude_hz=200.0, seed=6).to(8.0)
    attitudes = {round(sample.t_s * 200): sample.quaternion for sample in run.of(AttitudeSample)}
    errors = []
    for sample in run.of(ImuSample):
        quaternion = attitudes.get(round(sample.t_s * 200))
        if quaternion is not None:
            north, east, down = rotated(quaternion, sample.specific_force_mps2)
            errors.append(np.array((north, east, down + run.gravity)) - run.state_at(sample.t_s)[6:])
    assert len(errors) > 250
    # ArduPilot's integers add half a milli-g per axis
    assert np.abs(errors).max() <= 0.1 + (1e-4 if flavour == "px4" else 0.009)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.04


@BOTH
def test_fixes_are_where_and_when_the_drone_was(flavour):
    run = Run(flavour, seed=2).to(12.0)
    fixes = run.of(GpsSample)
    errors = np.array([np.subtract(fix.position_m, run.state_at(fix.t_s)[:3]) for fix in fixes])
    # the wire keeps 1e-7 deg and mm
    assert np.abs(errors).max() <= 0.15 + 0.012
    assert errors.std() == pytest.approx(0.15 / np.sqrt(3.0), rel=0.2)
    for fix in fixes:
        speed = np.linalg.norm(run.state_at(fix.t_s)[3:6])
        assert fix.speed_mps == pytest.approx(speed, abs=0.08 + 0.006)
        assert fix.horizontal_sigma_m == pytest.approx(0.0866, abs=1e-3)


@BOTH
def test_an_outage_leaves_no_fix_behind(flavour):
    run = Run(flavour, gps_outages=[{"agent": 1, "from_s": 4.0, "to_s": 8.0}]).to(10.0)
    assert not [fix for fix in run.of(GpsSample) if 4.0 <= fix.t_s < 8.0]
    assert [fix for fix in run.of(GpsSample) if fix.t_s >= 8.0]
