"""Every installation holds the examples and the unit, and flies one of them from any folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fleetloc import cli

ROOT = Path(__file__).parents[3]


def test_the_examples_are_listed_with_what_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["examples"]) == 0
    listed = capsys.readouterr().out
    for path in [*(ROOT / "configs").rglob("*.toml"), *(ROOT / "deploy").rglob("*.service")]:
        (line,) = [line for line in listed.splitlines() if line.split()[0].endswith(f"/{path.name}")]
        assert len(line.split()) > 2, f"{path.name} has no comment at its head that says what it is"


def test_copies_are_whole_and_usable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "mine"
    assert cli.main(["examples", "--copy", str(folder)]) == 0
    assert (folder / "configs/line3.toml").read_bytes() == (ROOT / "configs/line3.toml").read_bytes()
    unit = "systemd/fleetloc@.service"
    assert (folder / unit).read_bytes() == (ROOT / "deploy" / unit).read_bytes()
    assert not any(path.is_symlink() for path in folder.rglob("*"))
    assert cli.main(["check", str(folder / "configs/line3.toml")]) == 0
    capsys.readouterr()
    assert cli.main(["examples", "--copy", str(folder)]) == 2
    assert "--copy: expected a folder that is new or empty, found" in capsys.readouterr().err


def test_the_demo_needs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["fleet", "--demo", "--lockstep", "--duration", "2"]) == 0
    assert json.loads((tmp_path / "fleetloc-demo/report.json").read_text())["config"]["fleet"]["name"] == "line3"
    assert [path.name for path in tmp_path.iterdir()] == ["fleetloc-demo"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["fleet"], "CONFIG: expected a configuration of a fleet (TOML), or --demo, found neither"),
        (["fleet", "x.toml", "--demo"], "--demo: expected no configuration beside it, found x.toml"),
    ],
)
def test_there_is_exactly_one_configuration(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(arguments) == 2
    assert capsys.readouterr().err == f"fleetloc: error: {expected}\n"
