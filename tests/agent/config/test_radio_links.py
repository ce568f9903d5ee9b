"""Links between agents: endpoints by kind of link, link profiles laid over a fleet, injected faults by agent."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.config.documents import merged, read_document
from agent.config.reading import config_from, load_config
from agent.config.tables import FleetConfig
from agent.errors import ConfigError
from agent.radio.radio_faults import FaultsTable, RadioOutage, channel_settings
from agent.radio.security import agent_session, driver_session, observer_session
from transport.link.channel import Channel, Outage
from transport.link.session_settings import zenoh_config

CONFIGS = Path(__file__).parents[3] / "configs"
LINE3, MESH5 = CONFIGS / "line3.toml", CONFIGS / "mesh5.toml"
PROFILES = sorted((CONFIGS / "links").glob("*.toml"))
ON_RADIO = [f'agents.{agent_id}.radio="10.77.0.{agent_id}"' for agent_id in (1, 2, 3)]


def line3(*overrides: str) -> FleetConfig:
    return load_config(LINE3, overrides)


@pytest.mark.parametrize(
    ("link", "radio"),
    [
        ("tcp", ("tcp/10.77.0.2:7447",)),
        ("udp", ("udp/10.77.0.2:7447",)),
        ("multilink", ("tcp/10.77.0.2:7447?rel=1", "udp/10.77.0.2:7447?rel=0")),
    ],
)
def test_neighbours_dial_the_address_on_the_radio_and_devices_the_loopback(link: str, radio: tuple[str, ...]) -> None:
    config = line3(f"transport.link={link}", *ON_RADIO)
    assert config.device_endpoints(2) == ("tcp/127.0.0.1:17448",)
    assert config.listen(2) == ("tcp/127.0.0.1:17448", *radio)
    assert config.connect(3) == radio
    assert config.connect(1) == ()


def test_a_uwb_driver_and_an_observer_go_to_the_devices_endpoint() -> None:
    config = line3("transport.link=udp", *ON_RADIO)
    assert driver_session(config, 2, LINE3.parent).connect == ("tcp/127.0.0.1:17448",)
    everybody = tuple(f"tcp/127.0.0.1:{port}" for port in (17447, 17448, 17449))
    assert observer_session(config, LINE3.parent).connect == everybody


def test_endpoints_of_ones_own_stay_for_the_devices() -> None:
    config = line3('agents.2.listen=["tcp/10.88.0.2:7440"]', *ON_RADIO)
    assert config.device_endpoints(2) == ("tcp/10.88.0.2:7440",)
    assert config.listen(2) == ("tcp/10.88.0.2:7440", "tcp/10.77.0.2:7447")
    assert config.connect(3) == ("tcp/10.77.0.2:7447",)


def test_in_the_field_streams_on_the_radio_are_tls() -> None:
    config = line3("security.profile=field", "security.mode=signed", *ON_RADIO)
    assert config.listen(2) == ("tls/127.0.0.1:17448", "tls/10.77.0.2:7447")
    assert config.connect(3) == ("tls/10.77.0.2:7447",)


@pytest.mark.parametrize("link", ["tcp", "udp", "multilink"])
def test_on_one_machine_no_two_agents_want_one_port(link: str) -> None:
    config = load_config(MESH5, [f"transport.link={link}"])
    own = [endpoint for agent_id in config.ids for endpoint in config.listen(agent_id)]
    assert len({endpoint.partition("?")[0] for endpoint in own}) == len(own)


@pytest.mark.parametrize("profile", PROFILES, ids=lambda path: path.stem)
def test_a_shipped_profile_goes_over_a_shipped_fleet_and_zenoh_takes_it(profile: Path) -> None:
    config = load_config(MESH5, [f'agents.{i}.radio="10.77.0.{i}"' for i in range(1, 6)], [profile])
    assert config.fleet == load_config(MESH5).fleet
    for agent_id in config.ids:
        zenoh_config(agent_session(config, agent_id, MESH5.parent), config.fleet.name, agent_id, config.ids)


def test_there_are_profiles_for_every_kind_of_link() -> None:
    links = {load_config(LINE3, ON_RADIO, [profile]).transport.link for profile in PROFILES}
    assert links == {"tcp", "udp", "multilink"}


def test_of_file_profiles_and_overrides_the_last_one_wins(tmp_path: Path) -> None:
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text('[transport]\nlink = "udp"\nlease_s = 3.0\n[[agents]]\nid = 2\nradio = "10.0.0.2"\n')
    second.write_text('[transport]\nlink = "multilink"\n')
    config = load_config(LINE3, ["transport.loss=0.25"], [first, second])
    transport = config.transport
    assert (transport.link, transport.lease_s, transport.loss) == ("multilink", 3.0, 0.25)
    assert transport.base_port == load_config(LINE3).transport.base_port
    # AND agents are told apart by their ids
    assert [agent.radio for agent in config.agents] == [None, "10.0.0.2", None]
    assert config.agent(2).mavlink == load_config(LINE3).agent(2).mavlink
    assert load_config(LINE3, ["transport.link=tcp"], [first]).transport.link == "tcp"


def test_laying_over_changes_neither_document() -> None:
    below, above = read_document(LINE3).tables, {"agents": [{"id": 1, "name": "one"}], "transport": {"link": "udp"}}
    merged(below, above)
    assert below == read_document(LINE3).tables
    assert above == {"agents": [{"id": 1, "name": "one"}], "transport": {"link": "udp"}}


def test_a_bad_profile_is_named(tmp_path: Path) -> None:
    profile = tmp_path / "typo.toml"
    profile.write_text('[transport]\nlinks = "udp"\n')
    with pytest.raises(ConfigError, match=r"typo\.toml:2: transport\.links: expected one of base_port") as caught:
        load_config(LINE3, (), [profile])
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"missing\.toml: expected a TOML file, found no such file"):
        load_config(LINE3, (), [tmp_path / "missing.toml"])


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["transport.link=quic"], "transport.link"),
        (["transport.link=udp", 'agents.2.listen=["udp/10.0.0.2:7447"]'], "agent 2, radio"),
        (["transport.faults.outages=[{from_s=2.0, to_s=1.0}]"], "transport.faults.outages, entry 1, to_s"),
        (["transport.faults.outages=[{from_s=0,to_s=1,senders=[9]}]"], "transport.faults.outages, entry 1, senders"),
        (["transport.faults.burst_end=0"], "transport.faults.burst_end"),
    ],
)
def test_a_wrong_link_is_refused(overrides: list[str], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        line3(*overrides)
    assert caught.value.key == key


# --- injected faults ----------------------------------------------------------------------------------------


def heard(faults: FaultsTable, receiver: int, now: float, began_s: float = 100.0) -> set[int]:
    """Of whom an agent of five hears a packet that comes at ``now``."""
    settings = channel_settings(faults, receiver, loss=0.0, delay_s=0.0, delay_jitter_s=0.0, began_s=began_s)
    others = [other for other in range(1, 6) if other != receiver]
    channel: Channel[int] = Channel.seeded(settings, seed=0, receiver=receiver, neighbours=others)
    for other in others:
        channel.offer(other, other, now)
    return {other for _, other in channel.due(now)}


def test_a_partition_leaves_two_islands_until_it_heals() -> None:
    faults = FaultsTable(outages=(RadioOutage(from_s=10.0, to_s=30.0, receivers=(1, 2), senders=(3, 4, 5)),))
    assert heard(faults, 1, 109.9) == {2, 3, 4, 5}
    assert heard(faults, 1, 110.0) == {2}
    assert heard(faults, 4, 129.9) == {3, 5}
    assert heard(faults, 4, 130.0) == {1, 2, 3, 5}


def test_one_way_the_other_side_still_hears() -> None:
    faults = FaultsTable(outages=(RadioOutage(from_s=0.0, to_s=9.0, receivers=(2,), senders=(1,), one_way=True),))
    assert heard(faults, 2, 101.0) == {3, 4, 5}
    assert heard(faults, 1, 101.0) == {2, 3, 4, 5}
    assert heard(faults, 3, 101.0) == {1, 2, 4, 5}


def test_groups_that_are_left_out_are_everybody() -> None:
    everybody = FaultsTable(outages=(RadioOutage(from_s=0.0, to_s=9.0),))
    alone = FaultsTable(outages=(RadioOutage(from_s=0.0, to_s=9.0, receivers=(3,)),))
    assert [heard(everybody, agent_id, 101.0) for agent_id in range(1, 6)] == [set()] * 5
    assert heard(alone, 3, 101.0) == set()
    assert heard(alone, 1, 101.0) == {2, 4, 5}


def test_all_faults_reach_the_channel_with_those_of_the_caller() -> None:
    table = {"burst_start": 0.1, "burst_end": 0.5, "reorder": 0.2, "duplicate": 0.04}
    document = read_document(LINE3).tables
    document["transport"]["faults"] = table
    faults = config_from(document, "test").transport.faults
    mine = Outage(1.0, 2.0, (3,))
    settings = channel_settings(faults, 1, loss=0.3, delay_s=0.1, delay_jitter_s=0.02, began_s=0.0, more=[mine])
    assert {name: getattr(settings, name) for name in table} == table
    assert (settings.loss, settings.delay_s, settings.delay_exponential_s) == (0.3, 0.1, 0.02)
    assert settings.outages == (mine,)
