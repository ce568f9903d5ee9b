"""`fleetloc init` writes a configuration that `fleetloc check` passes, whatever is asked for; it changes no file."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path

import pytest

from agent.config.reading import config_from, load_config
from agent.config.tables import FleetConfig
from fleetloc import cli
from tests.support.doc_pages import blocks

ORIGIN = ("--origin", "47.3977,8.5456,488")


def made(folder: Path, *options: str) -> FleetConfig:
    """The configuration that is written with these options."""
    file = folder / "fleet.toml"
    assert cli.main(["init", str(file), *ORIGIN, *options]) == 0
    assert cli.main(["check", str(file)]) == 0
    return load_config(file)


def test_the_first_one_needs_an_origin_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = made(tmp_path)

    assert config.ids == (1, 2, 3)
    assert (config.fleet.origin.lat_deg, config.fleet.origin.alt_m) == (47.3977, 488.0)
    assert [agent.mavlink for agent in config.agents] == [f"udpin:127.0.0.1:{port}" for port in (14551, 14552, 14553)]
    assert config.feedback.kind == "off"
    said = capsys.readouterr().out
    assert f"fleetloc check {tmp_path / 'fleet.toml'}" in said


def test_the_newcomers_page_shows_what_is_written(tmp_path: Path) -> None:
    shown = next(b for b in blocks() if b.page == "first-configuration.md" and b.language == "toml")

    assert made(tmp_path) == config_from(tomllib.loads(shown.text), "the page")


@pytest.mark.parametrize(
    ("autopilot", "uwb", "radio"),
    [
        *itertools.product(
            ("px4", "ardupilot", "auto"),
            ("none", "linktrack", "uci", "dwm1001", "dwm3001-cli"),
            ("wired", "mixed", "lossy_radio"),
        )
    ],
)
def test_every_combination_passes_the_check(tmp_path: Path, autopilot: str, uwb: str, radio: str) -> None:
    address = ("--address", "192.168.7.{id}", "--link", "serial:/dev/autopilot:921600")

    config = made(tmp_path, "--autopilot", autopilot, "--uwb", uwb, "--radio", radio, *address, "--feedback")

    assert {agent.autopilot for agent in config.agents} == {autopilot}
    assert [agent.radio for agent in config.agents] == [f"192.168.7.{i}" for i in (1, 2, 3)]
    assert config.transport.link == {"wired": "tcp", "mixed": "multilink", "lossy_radio": "udp"}[radio]
    assert config.estimator.reciprocal_ranges == ("shared" if uwb == "dwm3001-cli" else "independent")
    assert config.feedback.kind == "odometry"


def test_a_large_fleet(tmp_path: Path) -> None:
    config = made(tmp_path, "--drones", "12", "--name", "orchard-2")

    assert config.ids == tuple(range(1, 13))
    assert config.agents[11].mavlink == "udpin:127.0.0.1:14562"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--origin", "47.4;8.5;488"), "--origin: expected latitude and longitude in deg and height in m"),
        (("--origin", "nan,8.5,488"), "fleet.origin.lat_deg: expected a finite number, found nan"),
        (("--origin", "95,8.5,488"), "fleet.origin.lat_deg: expected"),
        ((*ORIGIN, "--name", 'My "fleet"'), "fleet.name: expected 1 to 32 of the characters"),
        ((*ORIGIN, "--link", "serial:/dev/autopilot:57600"), "expected a baud rate of"),
        ((*ORIGIN, "--link", "udpin:127.0.0.1:14551"), "expected another address than agent 1's"),
        ((*ORIGIN, "--link", "nonsense"), "agent 1, mavlink: expected"),
        ((*ORIGIN, "--drones", "0"), "--drones"),
        ((), "Missing option '--origin'"),
    ],
)
def test_what_cannot_be_is_said_in_a_line_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], said: str
) -> None:
    file = tmp_path / "fleet.toml"

    assert cli.main(["init", str(file), *options]) == 2

    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert not file.exists()


def test_a_file_that_is_there_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text("mine", encoding="utf-8")

    assert cli.main(["init", str(file), *ORIGIN]) == 2
    assert file.read_text(encoding="utf-8") == "mine"
    assert "expected a file that is not there yet" in capsys.readouterr().err
