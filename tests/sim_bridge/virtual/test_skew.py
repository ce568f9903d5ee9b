"""A fleet whose drones were not all given the same: both sides say so within two seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from sim_bridge.virtual.fleet_lockstep import START_FLEET_S, FleetLockstep, Surroundings
from transport.link.streams import Stream, key_expression
from transport.messages.header import VERSION, VERSION_AT

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
TOLD_WITHIN_S = 2.0
FLIGHT_S = 4.0


class SkewedFleet:
    """line3 whose drone 3 has another configuration; ``told`` has what each drone's health said first, and when."""

    def __init__(self, *skew: str) -> None:
        self.config: FleetConfig = load_config(LINE3)
        self.skewed = load_config(LINE3, skew)
        self.agents: dict[int, OnboardAgent] = {}
        self.told: dict[int, tuple[float, str]] = {}
        self.healthy: set[int] = set()

    def fly(self) -> SkewedFleet:
        FleetLockstep(
            self.config, make_estimator, self._on_estimate, "values", Surroundings(make_agent=self._make)
        ).run(FLIGHT_S)
        return self

    def _make(self, _config: FleetConfig, agent_id: int, *arguments: Any, **options: Any) -> OnboardAgent:
        config = self.skewed if agent_id == 3 else self.config
        self.agents[agent_id] = OnboardAgent(config, agent_id, *arguments, **options)
        return self.agents[agent_id]

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        unix_s = ready.ready_s + (self.skewed if agent.agent_id == 3 else self.config).fleet.epoch_unix_s
        since_s = unix_s - self.config.fleet.epoch_unix_s - START_FLEET_S
        for reason in agent.core.health.health.reasons:
            if "differs in" in reason and "all have to share" not in reason:
                self.told.setdefault(agent.agent_id, (since_s, reason))


@pytest.mark.parametrize(
    ("skew", "key"),
    [
        ("fleet.origin.lat_deg=47.398242", "fleet.origin"),
        ("fleet.origin.alt_m=490.0", "fleet.origin"),
        ('fleet.origin.altitude="ellipsoid"', "fleet.origin"),
        ("fleet.period_s=0.2", "fleet.period_s"),
        ("fleet.epoch_unix_s=1767225637.0", "fleet.epoch_unix_s"),
        ("fleet.edges=[[1,2],[2,3],[1,3]]", "fleet.edges"),
        ('estimator.kind="dekf_ci"', "estimator.kind"),
        ("estimator.window=5", "estimator.window"),
    ],
)
def test_both_sides_name_the_drone_and_the_setting_within_two_seconds(skew: str, key: str) -> None:
    fleet = SkewedFleet(skew).fly()
    for agent_id, other in ((2, 3), (3, 2)):
        since_s, reason = fleet.told[agent_id]
        assert since_s <= TOLD_WITHIN_S
        assert reason.startswith(f"{other} refused, differs in {key}")
    for agent_id in (2, 3):
        rejected = fleet.agents[agent_id].opener.peers.rejections()
        assert set(rejected) == {"disagrees"}
    # AND who shares the same goes on together
    assert fleet.agents[1].opener.peers.rejections() == {}
    assert 1 not in fleet.told


def test_who_shares_the_same_has_nothing_to_tell() -> None:
    # GIVEN a fleet whose drones differ in what is nobody else's business
    fleet = SkewedFleet("sensors.uwb_sigma_m=0.3", "transport.exchanges=2", "fleet.edges=[[3,2],[2,1]]").fly()
    assert fleet.told == {}
    for agent in fleet.agents.values():
        assert agent.opener.peers.rejections() == {}


def test_another_version_is_named_while_nothing_else_comes_of_that_drone() -> None:
    # GIVEN a drone that hears nothing but packets of version 1 in the name of drone 2
    fleet = SkewedFleet().fly()
    agent, host_s = fleet.agents[1], 60_000.0
    key = key_expression("line3", 2, Stream.MEAS)
    (good,) = fleet.agents[2].sealer.seal(fleet.agents[2].agreement.own, t_ns=0)
    old = good.data[:VERSION_AT] + b"\x01" + good.data[VERSION_AT + 1 :]

    def findings() -> list[str]:
        agent.keep_house(unix_s=host_s + 1e9, host_s=host_s)
        return [str(finding.what.name) for finding in agent.agreement.observe(host_s)]

    agent.on_packet(key, old, arrived_s=host_s, host_s=host_s, unix_ns=0)
    assert findings() == ["OTHER_VERSION"]
    assert agent.agreement.observe(host_s)[0].value == 1.0
    assert agent.agreement.observe(host_s)[0].limit == VERSION
    # WHEN its own packets come too, it is somebody else who sends those
    agent.on_packet(key_expression("line3", 2, Stream.AGREE), good.data, arrived_s=host_s, host_s=host_s, unix_ns=0)
    assert findings() == []
