"""Fleets with UWB modules at known places."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.config.reading import config_from
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.model.layout import block
from sim_bridge.virtual.fleet_lockstep import FleetLockstep

ANCHORS = ((201, (30, 30, 0)), (202, (-30, 30, -8)), (203, (-30, -30, 0)), (204, (30, -30, -8)))
OFF_S = 8.0


class Flight:
    """A fleet of which nobody has GPS after a while, or from the beginning."""

    def __init__(self, drones: int, duration_s: float, off_s: float = OFF_S, seed: int = 1, **agent: Any) -> None:
        ids = range(1, drones + 1)
        document: dict[str, Any] = {
            "fleet": {"name": "anchored", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}},
            "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{14560 + i}", **agent} for i in ids],
            "anchors": [{"id": anchor, "position_m": list(place)} for anchor, place in ANCHORS],
            "sensors": {"gps_speed": "norm"},
            "sim": {
                "seed": seed,
                "yaw_rate_radps": 0.5 if agent else 0.0,
                "gps_outages": [{"agent": i, "from_s": off_s, "to_s": 1000.0} for i in ids],
            },
            "security": {"mode": "unsigned"},
        }
        config = config_from(document, "test")
        self.ready: list[tuple[int, EstimateReady]] = []
        self.report = FleetLockstep(config, make_estimator, self._on_estimate, "values").run(duration_s)
        squares, nees, self.statuses = [], [], set[Status]()
        for agent_id, ready in self.ready:
            unix_s = ready.t_s + config.fleet.epoch_unix_s
            if unix_s < self.report.start_unix_s + OFF_S or ready.estimate.status is Status.NO_DATA:
                continue
            self.statuses.add(ready.estimate.status)
            truth = self.report.truth.at(min(unix_s, self.report.truth.time_unix_s[-1]))
            at = block(agent_id - 1)
            error = (ready.estimate.mean - truth.ravel())[at]
            squares.append(float(error[:3] @ error[:3]))
            nees.append(float(error @ np.linalg.solve(ready.estimate.covariance[at, at], error)) / 6)
        self.count, self.rmse_m, self.anees = len(squares), float(np.sqrt(np.mean(squares))), float(np.mean(nees))

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        self.ready.append((agent.agent_id, ready))


def test_anchors_hold_a_fleet_that_has_lost_gps_altogether() -> None:
    # GIVEN three turning drones with lever arms whose GPS goes off, and four anchors
    flight = Flight(3, 20.0, gps_antennas_m=[[0.2, 0.0, -0.1]], uwb_tags_m=[[0.0, 0.3, 0.0]])
    # THEN they stay where the anchors say, and know how well
    assert flight.count >= 3 * 115
    assert flight.rmse_m <= 0.25
    assert 0.2 <= flight.anees <= 1.5
    assert flight.statuses == {Status.OK}


def test_anchors_locate_a_fleet_that_never_had_gps() -> None:
    # GIVEN two drones without any fix WHEN they range four anchors THEN they are located and held
    flight = Flight(2, 14.0, off_s=0.0)
    assert flight.count >= 2 * 40
    assert flight.rmse_m <= 0.4
