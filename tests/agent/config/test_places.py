"""Every mistake is told at once, with its line or the option that was typed, in the words of the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.config.documents import Given, Override
from agent.config.faults import shown
from agent.config.reading import config_from, config_of, load_config, load_document, read
from agent.errors import ConfigError

FLEET = """[fleet]
name = "places"
origin = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 400.0 }
edges = [
    [5, 7],
]

[[agents]]
id = 5
mavlink = "udpin:127.0.0.1:14551"

[[agents]]
id = 7
mavlink = "udpin:127.0.0.1:14552"

[transport]
exchange_fraction = 0.3
"""


def file(folder: Path, text: str = FLEET, name: str = "fleet.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def only(path: Path, *overrides: Override, profiles: tuple[Path, ...] = ()) -> ConfigError:
    """The one mistake that there is."""
    _, errors = read(load_document(path, overrides, profiles))
    (error,) = errors
    return error


@pytest.mark.parametrize(
    ("old", "new", "line", "key", "says"),
    [
        ('name = "places"', 'name = "No Name"', 2, "fleet.name", "expected 1 to 32 of the characters a-z, 0-9"),
        ('name = "places"', 'nam = "x"\nname = "x"', 2, "fleet.nam", "found an unknown key; did you mean name?"),
        ("lat_deg = 47.0", "lat_deg = 470", 3, "fleet.origin.lat_deg", "expected a number <= 90, found 470"),
        ("lat_deg = 47.0, ", "", 3, "fleet.origin.lat_deg", "expected a value (it is required), found nothing"),
        ("[5, 7]", "[5, 9]", 5, "fleet.edges, entry 1", "expected ids of agents (5, 7), found 9"),
        ("[5, 7]", "[5, 7, 7]", 5, "fleet.edges, entry 1", "expected an array of length 2"),
        ('mavlink = "udpin:127.0.0.1:14552"', "", 12, "agent 7, mavlink", "expected a value (it is required)"),
        ("14552", "99999", 14, "agent 7, mavlink", "whose port '99999' is not 0..65535"),
        ("14552", "14551", 14, "agent 7, mavlink", "expected another address than agent 5's"),
        ('"udpin:127.0.0.1:14552"', "3", 14, "agent 7, mavlink", "expected a string, found 3"),
        ("id = 7\n", "id = 7\nautopilot = 'pix4'\n", 14, "agent 7, autopilot", "found 'pix4'; did you mean px4?"),
        ("id = 7", "id = 5", 13, "agents, entry 2, id", "expected distinct ids, found a second agent 5"),
        ("[5, 7]", "[5, 7]]\nloss = [0", 6, "fleet.loss", "found an unknown key; did you mean transport.loss?"),
        ("exchange_fraction = 0.3", "exchange_fraction = nan", 17, "transport.exchange_fraction", "a finite number"),
        ("exchange_fraction = 0.3", "rounds_fraction = 0.8", 17, "transport.rounds_fraction", "at most 1 together"),
        ("exchange_fraction = 0.3", "exchange_fraction = 0.7", 16, "transport.rounds_fraction", "at most 1 together"),
        ("[transport]", "[transprt]", 16, "transprt", "found an unknown key; did you mean transport?"),
    ],
)
def test_a_mistake_is_told_with_its_line(tmp_path: Path, old: str, new: str, line: int, key: str, says: str) -> None:
    assert old in FLEET
    path = file(tmp_path, FLEET.replace(old, new, 1))
    error = only(path) if new != "id = 5" else read(load_document(path))[1][0]
    assert (error.line, error.key) == (line, key)
    assert str(error).startswith(f"{path}:{line}: {key}: ")
    assert says in str(error)


def test_all_mistakes_are_told_also_those_between_settings(tmp_path: Path) -> None:
    text = FLEET.replace("exchange_fraction", "exchange_fractoin").replace("[5, 7]", "[5, 9]")
    path = file(tmp_path, text.replace("14552", "14551") + "guard_s = 'long'\n[recrod]\n")
    _, errors = read(load_document(path))
    told = [(error.line or 0, error.key) for error in errors]
    assert sorted(told) == [
        (5, "fleet.edges, entry 1"),
        (14, "agent 7, mavlink"),
        (17, "transport.exchange_fractoin"),
        (18, "transport.guard_s"),
        (19, "recrod"),
    ]
    with pytest.raises(ConfigError, match=r"and 4 more: `fleetloc check` shows all") as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


def test_the_file_that_wrote_it_last_is_named(tmp_path: Path) -> None:
    path = file(tmp_path)
    first = file(tmp_path, '[transport]\nlink = "upd"\n', "first.toml")
    second = file(tmp_path, '[[agents]]\nid = 7\nradio = "a:1"\n', "second.toml")
    assert str(only(path, profiles=(first,))).startswith(f"{first}:2: transport.link: expected one of tcp, udp")
    assert str(only(path, profiles=(second,))).startswith(f"{second}:3: agent 7, radio: ")
    edges = file(tmp_path, "[fleet]\nedges = [\n[5, 7],\n[7]]\n", "edges.toml")
    assert str(only(path, profiles=(edges,))).startswith(f"{edges}:4: fleet.edges, entry 2: ")


def test_an_option_is_named_as_it_was_typed(tmp_path: Path) -> None:
    path = file(tmp_path)
    assert str(only(path, Given("--loss", "transport.loss", 30))) == "--loss: expected a number <= 1, found 30"
    assert str(only(path, "transport.loss=30")) == "--set: transport.loss: expected a number <= 1, found 30"
    assert str(only(path, "fleet.edges=[[5,9]]")).startswith("--set: fleet.edges, entry 1: ")
    assert str(only(path, "agents.7.autopilot=x")).startswith("--set: agent 7, autopilot: ")
    assert str(only(path, "transprt.link=udp")).startswith("--set: transprt: ")


def test_what_stands_nowhere_is_told_of_the_file(tmp_path: Path) -> None:
    path = file(tmp_path, '[[agents]]\nid = 1\nmavlink = "udpin:127.0.0.1:1"\n')
    assert str(only(path)) == f"{path}: fleet: expected a table (it is required), found nothing"


def test_a_profile_alone_is_no_fleet(tmp_path: Path) -> None:
    path = file(tmp_path, "[transport]\nlink = 'udp'\n")
    assert str(only(path)).endswith("no [fleet] and no [[agents]]; a profile is laid over a fleet's file by --with")


def test_a_configuration_without_a_file_has_no_lines() -> None:
    origin = {"lat_deg": 0, "lon_deg": 0, "alt_m": 0}
    with pytest.raises(ConfigError, match=r"^here: agents: expected an array of length >= 1, found \[\]"):
        config_from({"fleet": {"name": "x", "origin": origin}, "agents": []}, "here")


def test_a_document_is_not_changed_by_overrides(tmp_path: Path) -> None:
    document = load_document(file(tmp_path))
    assert config_of(document.overridden(["fleet.name=other"])).fleet.name == "other"
    assert config_of(document).fleet.name == "places"


@pytest.mark.parametrize(
    ("key", "people_read"),
    [
        ("agents[1].radio", "agent 7, radio"),
        ("agents[1].listen[0]", "agent 7, listen, entry 1"),
        ("agents[1]", "agent 7"),
        ("agents[2].id", "agents, entry 3, id"),
        ("sim.paths[0].lap_s", "sim.paths of agent 5, lap_s"),
        ("fleet.edges[0][1]", "fleet.edges, entry 1, entry 2"),
        ("transport.loss", "transport.loss"),
    ],
)
def test_drones_are_shown_by_their_ids(key: str, people_read: str) -> None:
    tables = {"agents": [{"id": 5}, {"id": 7}, {}], "sim": {"paths": [{"agent": 5}]}, "fleet": {"edges": [[5, 7]]}}
    assert shown(tables, key) == people_read
