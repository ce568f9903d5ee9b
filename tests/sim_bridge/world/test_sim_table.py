"""The ``[sim]`` table of a fleet's file: read as strictly as the agent's own."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from agent.config.reading import config_from, load_config, with_other_table
from agent.errors import ConfigError
from sim_bridge.world.sim_table import CirclePath, SimTable, sim_table

CONFIGS = Path(__file__).parents[3] / "configs"
LINE3 = CONFIGS / "line3.toml"


def test_the_shipped_fleets_fly_what_they_say() -> None:
    configs = {name: load_config(CONFIGS / f"{name}.toml") for name in ("line3", "mesh5", "gps_loss")}
    assert [outage.agent for outage in sim_table(configs["gps_loss"]).gps_outages] == [4]
    for config in configs.values():
        assert {path.agent for path in sim_table(config).paths} == set(config.ids)


def test_overrides_reach_it() -> None:
    path = sim_table(load_config(LINE3, ["sim.paths.1.radius_m=9.5"])).paths[0]
    assert isinstance(path, CirclePath)
    assert path.radius_m == 9.5


def test_what_is_put_in_is_what_is_read() -> None:
    table = SimTable(seed=7, paths=sim_table(load_config(LINE3)).paths)
    assert sim_table(with_other_table(load_config(LINE3), "sim", table)) == table


@pytest.mark.parametrize(
    ("override", "key", "expected", "found"),
    [
        ("sim.sed=3", "sim.sed", "one of seed, profile, duration_s", "an unknown key"),
        ("sim=3", "sim", "a table", "3"),
        ("sim.duration_s=nan", "sim.duration_s", "a finite number", "nan"),
        ("sim.paths.1.kind=loop", "sim.paths of agent 1, kind", "one of waypoints, circle, figure_eight", "'loop'"),
        ("sim.paths.1.points_m=[]", "sim.paths of agent 1, points_m", "one of kind, agent, center_m", "unknown"),
        ("sim.paths.1.center_m=[1,2]", "sim.paths of agent 1, center_m", "an array of length 3", "[1, 2]"),
        ("sim.paths.1.agent=2", "sim.paths, entry 2, agent", "one path per drone or target", "a second path of 2"),
        ("sim.paths.1.agent=8", "sim.paths of agent 8, agent", "ids of agents", "8"),
    ],
)
def test_a_wrong_value_is_refused_in_one_line_naming_key_expected_and_found(
    override: str, key: str, expected: str, found: str
) -> None:
    config = load_config(LINE3, [override])
    with pytest.raises(ConfigError) as caught:
        sim_table(config)
    assert caught.value.key == key
    assert expected in caught.value.expected
    assert found in caught.value.found
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(("--set: ", str(LINE3)))


def test_an_outage_must_end_after_it_begins() -> None:
    document = tomllib.loads(LINE3.read_text())
    document["sim"]["gps_outages"] = [{"agent": 1, "from_s": 5.0, "to_s": 5.0}]
    with pytest.raises(ConfigError, match=r"sim.gps_outages of agent 1, to_s: expected later than from_s = 5"):
        sim_table(config_from(document, "here"))


def test_a_target_has_a_path_like_a_drone_but_cannot_leap_between_waypoints() -> None:
    document = tomllib.loads(LINE3.read_text()) | {"targets": [{"id": 101}]}
    document["sim"]["paths"].append({"agent": 101, "kind": "line", "start_m": [0, 0, 0], "velocity_mps": [1, 0, 0]})
    assert sim_table(config_from(document, "here")).paths[-1].agent == 101
    document["sim"]["paths"][-1] = {"agent": 101, "kind": "waypoints", "points_m": [[0, 0, 0], [5, 0, 0]]}
    with pytest.raises(ConfigError, match=r"points_m: expected one point, where the target stands"):
        sim_table(config_from(document, "here"))


def test_the_fleets_of_situational_awareness_fly_what_they_say() -> None:
    configs = {path.stem: load_config(path) for path in (CONFIGS / "awareness").glob("*.toml")}
    assert set(configs) == {"sparse_graph", "link_failures", "fixed_target", "moving_target", "survey"}
    for config in configs.values():
        assert {path.agent for path in sim_table(config).paths} == set(config.bodies)
