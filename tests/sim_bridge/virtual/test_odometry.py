"""Drones with cameras that tell their velocity: what that is worth without GPS, and that it is counted."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.model.layout import block
from sim_bridge.virtual.fleet_lockstep import Fidelity, FleetLockstep

BLIND_FROM_S, DURATION_S = 6.0, 21.0


class Flight:
    """One drone, alone, turning, without fixes after a while; the errors at the end and what was counted."""

    def __init__(self, odometry_hz: float, fidelity: Fidelity = "values") -> None:
        document: dict[str, Any] = {
            "fleet": {"name": "alone", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}},
            "agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:14561", "autopilot": "px4"}],
            "sim": {
                "seed": 4,
                "profile": "realistic",
                "odometry_hz": odometry_hz,
                "yaw_rate_radps": 0.3,
                "gps_outages": [{"agent": 1, "from_s": BLIND_FROM_S, "to_s": 1000.0}],
            },
            "security": {"mode": "unsigned"},
        }
        self._ready: list[EstimateReady] = []
        config = config_from(document, "test")
        report = FleetLockstep(config, make_estimator, self._on_estimate, fidelity).run(DURATION_S)
        self.counters = Counter(report.counters[1])
        errors, squares = [], []
        for ready in self._ready:
            unix_s = ready.t_s + config.fleet.epoch_unix_s
            if unix_s < report.start_unix_s + BLIND_FROM_S + 10.0 or ready.estimate.status is Status.NO_DATA:
                continue
            truth = report.truth.at(min(unix_s, report.truth.time_unix_s[-1]))
            error = (ready.estimate.mean[block(0)] - truth[0])[3:]
            covariance = ready.estimate.covariance[3:6, 3:6]
            errors.append(float(error @ error))
            squares.append(float(error @ np.linalg.solve(covariance, error)) / 3)
        self.velocity_rms_mps, self.anees = float(np.sqrt(np.mean(errors))), float(np.mean(squares))

    def _on_estimate(self, _agent: OnboardAgent, ready: EstimateReady) -> None:
        self._ready.append(ready)


def test_a_drone_without_fixes_knows_its_velocity_by_its_camera() -> None:
    # GIVEN one drone without GPS for 15 s, with a camera and without
    bare, seeing = Flight(0.0), Flight(20.0)
    # THEN it knows its velocity several times better, as well as it says
    assert seeing.velocity_rms_mps < 0.2
    assert bare.velocity_rms_mps > 2.0 * seeing.velocity_rms_mps
    assert 0.1 < seeing.anees < 2.0


@pytest.mark.parametrize("fidelity", ["values", "bytes"])
def test_each_velocity_is_counted_once(fidelity: Fidelity) -> None:
    counters = Flight(20.0, fidelity).counters
    # GIVEN 20 a second, THEN every fourth is used
    came = {name: count for name, count in counters.items() if "odometry: " in name}
    samples, received = came.pop("odometry: samples"), came.pop("odometry: received")
    assert sum(came.values()) == received >= samples
    assert counters["odometry: used"] == pytest.approx(5 * DURATION_S, abs=12)
    if fidelity == "bytes":  # where PX4 sends its own estimate beside it, which is none
        assert counters["skipped odometry: the autopilot's own"] > 20 * DURATION_S
