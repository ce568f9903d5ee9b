"""The configuration: what is read, what is refused, and in which words."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from agent.config.reading import config_from, dump, load_config, load_estimator_settings
from agent.errors import ConfigError
from estimators.model.layout import BodyKind
from estimators.settings import EstimatorSettings

CONFIGS = sorted((Path(__file__).parents[3] / "configs").glob("*.toml"))
LINE3 = next(path for path in CONFIGS if path.stem == "line3")
FLEETS = [path for path in CONFIGS if path.stem in ("line3", "mesh5", "gps_loss")]


@pytest.mark.parametrize("path", FLEETS, ids=lambda path: path.stem)
def test_a_shipped_configuration_survives_dump_and_load(path: Path) -> None:
    config = load_config(path)
    assert config_from(tomllib.loads(dump(config)), "dump") == config


def test_two_fleets_are_what_they_say() -> None:
    line3, mesh5 = (load_config(LINE3.with_stem(name)) for name in ("line3", "mesh5"))
    assert line3.neighbours(2) == (1, 3)
    assert line3.neighbours(1) == (2,)
    assert line3.fleet.period_s == 0.1
    assert mesh5.neighbours(3) == (1, 2, 4, 5)


def test_no_two_shipped_fleets_share_a_port() -> None:
    taken: list[str] = []
    for path in FLEETS:
        config = load_config(path)
        taken += [agent.mavlink for agent in config.agents]
        taken += [endpoint for agent in config.ids for endpoint in config.listen(agent)]
    assert len(set(taken)) == len(taken)


def test_of_two_neighbours_the_one_with_the_higher_id_dials() -> None:
    config = load_config(LINE3)
    assert config.listen(2) == ("tcp/127.0.0.1:17448",)
    assert config.connect(1) == ()
    assert config.connect(3) == ("tcp/127.0.0.1:17448",)


def test_overrides_beat_the_file_and_speak_toml() -> None:
    overrides = [
        "estimator.window=3",
        "estimator.kind=dekf_ci",
        "agents.2.mavlink=udpin:127.0.0.1:24552",
        'agents.2.name="two = 2"',
        "record.directory=out",
        "transport.link=multilink",
    ]
    config = load_config(LINE3, overrides)
    assert (config.estimator.window, config.estimator.kind) == (3, "dekf_ci")
    assert (config.agent(2).mavlink, config.agent(2).name) == ("udpin:127.0.0.1:24552", "two = 2")
    assert config.record.directory == "out"
    assert config.transport.link == "multilink"


@pytest.mark.parametrize(
    ("override", "key", "expected", "found"),
    [
        ("estimator.windo=3", "estimator.windo", "one of kind, window, rounds", "an unknown key"),
        ("estimator.window=0", "estimator.window", "a whole number >= 1", "0"),
        ("estimator.window=many", "estimator.window", "a whole number", "'many'"),
        ("estimator.kind=ekf", "estimator.kind", "one of dmhe_pre_ekf, dmhe", "'ekf'"),
        ("fleet.period_s=fast", "fleet.period_s", "a number", "'fast'"),
        ("fleet.period_s=inf", "fleet.period_s", "a finite number", "inf"),
        ("sensors.gps_latency_s=nan", "sensors.gps_latency_s", "a finite number", "nan"),
        ("fleet.origin.lat_deg=100", "fleet.origin.lat_deg", "a number <= 90", "100"),
        ("fleet.origin.height=1", "fleet.origin.height", "one of lat_deg, lon_deg, alt_m", "an unknown key"),
        ("fleet.name=Upper Case", "fleet.name", "1 to 32 of the characters a-z", "'Upper Case'"),
        ("fleet=3", "fleet", "a table", "3"),
        ("agents=[]", "agents", "an array of length >= 1", "[]"),
        ("unknown=1", "unknown", "one of fleet, agents, anchors", "an unknown key"),
        ("agents.9.name=x", "agents.9", "one of the ids 1, 2, 3", "9"),
        ("agents.1.autopilot=apm", "agent 1, autopilot", "one of px4, ardupilot, auto", "'apm'"),
        ("agents.1.mavlink=udp", "agent 1, mavlink", "udpin:HOST:PORT", "names no transport"),
        ("agents.1.mavlink=udpout::1", "agent 1, mavlink", "udpin:HOST:PORT", "no host"),
        ("agents.1.mavlink=udpin:127.0.0.1:14552", "agent 2, mavlink", "another address", "14552"),
        ("agents.1.mavlink=serial:/dev/ttyS0:57600", "agent 1, mavlink", "a baud rate of 154714", "ttyS0:57600'"),
        ("agents.1.mavlink=/dev/ttyS0", "agent 1, mavlink", "a baud rate of 154714", "'/dev/ttyS0', which is 57600"),
        ("agents.1.id=2", "agents, entry 2, id", "distinct ids", "a second agent 2"),
        ("agents.3.id=300", "agent 300, system_id", "1..255", "nothing"),
        ("agents.1={}", "agents, entry 1, id", "a value (it is required)", "nothing"),
        ("fleet.edges=[[1,7]]", "fleet.edges, entry 1", "ids of agents (1, 2, 3)", "7"),
        ("fleet.edges=[[1,1]]", "fleet.edges, entry 1", "two different agents", "[1, 1]"),
        ("transport.exchange_fraction=0.9", "transport.rounds_fraction", "at most 1 together", "1.3"),
        ("transport.guard_s=0.05", "transport.guard_s", "less than", "0.05"),
        ("agents.1.mavlink=tcpout:..bad:5760", "agent 1, mavlink", "tcpout:HOST:PORT", "host '..bad' is no address"),
        ('agents.1.listen=["tcp/127.0.0.1:99999"]', "agent 1, listen, entry 1", "a port 0..65535", "99999"),
        ('agents.1.connect=["tcp/127.0.0.1:1","udp/10.0.0.2:abc"]', "agent 1, connect, entry 2", "a port 1..", "abc"),
        ('agents.1.listen=["tcp/10.0.0.256:7447"]', "agent 1, listen, entry 1", "a host's name or", "10.0.0.256"),
        ('agents.1.listen=["http/10.0.0.2:80"]', "agent 1, listen, entry 1", "one of tls/HOST:PORT", "http/10.0"),
        ("agents.1.radio=192.168.7.3:7447", "agent 1, radio", "without port", "192.168.7.3:7447"),
        ("agents.1.radio=fe80::1", "agent 1, radio", "IPv6 in brackets", "fe80::1"),
        ("metrics.base_port=65535", "metrics.base_port", "a port for each agent up to 65535", "65537 for the last"),
        ("metrics.host=0.0.0", "metrics.host", "an address to listen on", "0.0.0"),
        ("adsb.address=foo", "adsb.address", "udpout:HOST:PORT", "names no transport"),
        ("estimator.kind=centralized_ekf", "estimator.kind", "a kind for agents", "centralized_ekf"),
        ("estimator.limits.target.ceiling_m=nan", "estimator.limits.target.ceiling_m", "a finite", "nan"),
        ("targets=[{id=1}]", "target 1, id", "an id that no other body has", "1"),
        ("targets=[{id=9},{id=9}]", "targets, entry 2, id", "an id that no other body has", "9"),
        ("targets=[{id=9,motion='jumping'}]", "target 9, motion", "one of", "jumping"),
        ("estimator.limits.vehicle.floor=1", "estimator.limits.vehicle.floor", "one of floor_m", "an unknown key"),
        ("estimator.limits.vehicle.floor_m=inf", "estimator.limits.vehicle.floor_m", "a finite number", "inf"),
        ("estimator.limits.vehicle.east_m=[4,4]", "estimator.limits.vehicle.east_m", "[lowest, highest]", "[4"),
        ("estimator.limits.vehicle.north_m=[4]", "estimator.limits.vehicle.north_m", "an array of length 2", "[4]"),
        ("estimator.limits.vehicle.speed_mps=0", "estimator.limits.vehicle.speed_mps", "a number > 0", "0"),
        ("anchors=[{id=2,position_m=[0,0,0]}]", "anchor 2, id", "an id that no drone", "2"),
        ("anchors=[{id=9,position_m=[0,0,2e6]}]", "anchor 9, position_m", "at most 1e+06 m", "2000000.0"),
        ("anchors=[{id=9}]", "anchor 9, position_m", "a value (it is required)", "nothing"),
        ("agents.1.uwb_tags_m=[[0,0]]", "agent 1, uwb_tags_m, entry 1", "an array of length 3", "[0, 0]"),
        ("nonsense", "nonsense", "key=value with a dotted key", "'nonsense'"),
        ("fleet..name=1", "fleet..name", "key=value with a dotted key", "'fleet..name=1'"),
        ("fleet.name.x=1", "fleet.name", "a table", "'line3'"),
    ],
)
def test_a_wrong_value_is_refused_in_one_line_naming_key_expected_and_found(
    override: str, key: str, expected: str, found: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(LINE3, [override])
    assert caught.value.key == key
    assert expected in caught.value.expected
    assert found in caught.value.found
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(("--set: ", str(LINE3)))


@pytest.mark.parametrize(("north_m", "is_fine"), [("[500, 600]", False), ("[-9, -5]", True), ("[50, 600]", True)])
def test_sides_lie_within_the_box_of_the_states(north_m: str, is_fine: bool) -> None:
    overrides = ["estimator.state_box_position_m=100", f"estimator.limits.vehicle.north_m={north_m}"]
    if is_fine:
        load_config(LINE3, overrides)
        return
    with pytest.raises(ConfigError) as caught:
        load_config(LINE3, overrides)
    assert caught.value.key == "estimator.limits.vehicle.north_m"
    assert "state_box_position_m" in caught.value.expected


def test_a_ceiling_is_above_the_floor() -> None:
    limits = "estimator.limits.vehicle"
    config = load_config(LINE3, [f"{limits}.floor_m=-2", f"{limits}.ceiling_m=30"])
    assert config.estimator.limits.vehicle.ceiling_m == 30.0
    with pytest.raises(ConfigError) as caught:
        load_config(LINE3, [f"{limits}.floor_m=-2", f"{limits}.ceiling_m=-3"])
    assert (caught.value.key, caught.value.expected) == (f"{limits}.ceiling_m", "above floor_m = -2")


def test_tables_of_other_rooms_are_carried_along_and_nothing_in_them_is_refused() -> None:
    document = tomllib.loads(LINE3.read_text())
    document["sim"] = {"duration_s": "for ever", "paths": 3}
    config = config_from(document, "here")
    assert config.others.tables == {"sim": document["sim"]}
    assert tomllib.loads(dump(config))["sim"] == document["sim"]
    assert load_config(LINE3, ["sim.duration_s=7"]).others.tables["sim"]["duration_s"] == 7


def test_the_field_that_carries_them_is_no_table_of_the_file() -> None:
    document = tomllib.loads(LINE3.read_text())
    with pytest.raises(ConfigError, match=r"here: others: expected one of fleet, .*, sitl, monitor, found an"):
        config_from(document | {"others": {}}, "here")


def test_the_centralised_filter_is_for_studies_and_no_agents() -> None:
    assert load_estimator_settings(None, ["estimator.kind=centralized_ekf"]).kind == "centralized_ekf"
    with pytest.raises(ConfigError, match=r"estimator.kind: expected a kind for agents; .* `fleetloc estimate`"):
        load_config(LINE3, ["estimator.kind=centralized_ekf"])


@pytest.mark.parametrize("ids", ["[]", "{ a = 1 }", "1.5"])
def test_a_profile_whose_ids_are_none_is_refused_by_key(tmp_path: Path, ids: str) -> None:
    profile = tmp_path / "over.toml"
    profile.write_text(f"[[agents]]\nid = {ids}\nmavlink = 'udpin:127.0.0.1:1'\n")
    with pytest.raises(ConfigError, match=rf"^{profile}:2: agents, entry \d, id: expected a whole number"):
        load_config(LINE3, (), [profile])


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    missing, broken, huge = (tmp_path / name for name in ("missing.toml", "broken.toml", "huge.toml"))
    broken.write_text("[fleet\n")
    huge.write_bytes(b"#" * 1_000_001)
    with pytest.raises(ConfigError, match=r"missing.toml: expected a TOML file, found no such file"):
        load_config(missing)
    with pytest.raises(ConfigError, match=r"broken.toml:1: no valid TOML: Expected ']'"):
        load_config(broken)
    with pytest.raises(ConfigError, match="at most 1000000 bytes"):
        load_config(huge)


def test_a_kind_brings_its_own_defaults_and_what_is_written_beats_them() -> None:
    nothing_said = load_estimator_settings(None)
    assert (nothing_said.kind, nothing_said.window, nothing_said.relay_hops) == ("dmhe_shared", 6, 2)
    assert nothing_said == load_config(LINE3).estimator
    paper = load_estimator_settings(None, ["estimator.kind=dmhe_pre_ekf"])
    assert paper == EstimatorSettings()
    assert (paper.window, paper.rounds, paper.share_inputs, paper.relay_hops) == (2, 1, "none", 0)
    longer = load_estimator_settings(None, ["estimator.window=9"])
    assert (longer.kind, longer.window, longer.share_inputs) == ("dmhe_shared", 9, "fleet")


def test_drones_with_addresses_on_the_radio_may_have_the_same_device() -> None:
    document = tomllib.loads(LINE3.read_text())
    for agent in document["agents"]:
        agent["mavlink"] = "serial:/dev/ttyAMA0:921600"
    with pytest.raises(ConfigError, match=r"agent 2, mavlink: expected another address than agent 1's"):
        config_from(document, "here")
    for agent in document["agents"]:
        agent["radio"] = f"192.168.7.{agent['id']}"
    assert config_from(document, "here").agent(3).mavlink == "serial:/dev/ttyAMA0:921600"


def test_targets_stand_behind_the_drones_and_say_whether_they_move():
    config = load_config(LINE3, ["targets=[{id=9},{id=8,motion='fixed'}]", "estimator.limits.target.ceiling_m=5"])
    assert config.bodies == (*config.ids, 9, 8)
    assert config.layout.kinds[len(config.ids) :] == (BodyKind.TARGET, BodyKind.ANCHOR)
    with pytest.raises(ConfigError) as caught:
        load_config(LINE3, ["estimator.limits.target.ceiling_m=5", "estimator.limits.target.floor_m=6"])
    assert caught.value.key == "estimator.limits.target.ceiling_m"


def test_a_fleet_beyond_its_joint_state_has_no_targets():
    with pytest.raises(ConfigError) as caught:
        load_config(LINE3, ["targets=[{id=9}]", "fleet.joint_bodies=2"])
    assert caught.value.key == "targets"
