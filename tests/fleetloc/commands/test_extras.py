"""A command that lacks an extra says which, in one line, and does what it can without it."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from fleetloc import cli, extras
from tests.support.logs import LOGS

ROOT = Path(__file__).parents[3]
LINE3 = ROOT / "configs" / "line3.toml"


def without(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    """As if they were not installed; those that others have imported already are hidden too."""
    for name in modules:
        monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, "matplotlib", "fleetloc.report.report_plots", "fleetloc.report.replay_plots")


def test_every_extra_is_one_of_the_project_and_brings_its_package() -> None:
    offered = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, package in extras.PACKAGES.items():
        assert any(each.startswith(package) for each in offered[extra]), extra
        assert extras.is_installed(extra), f"the tests need every extra; missing: {package}"


@pytest.mark.usefixtures("no_plots")
def test_a_fleet_flies_without_the_plotting_library(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """GIVEN no matplotlib WHEN a fleet has flown THEN figures and tables are there, and it is said what is not."""
    assert cli.main(["fleet", str(LINE3), "--lockstep", "--duration", "3", "--out", str(tmp_path)]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "pip install" in line]
    assert said == ["note: report.html has no plots: matplotlib is not installed (pip install 'fleetloc[report]')"]
    html = (tmp_path / "report.html").read_text()
    assert "pip install &#x27;fleetloc[report]&#x27;" in html
    assert "<svg" not in html
    assert html.count("<tr>") == 1 + 3, "a heading and three drones"
    assert (tmp_path / "report.json").stat().st_size > 1000


@pytest.mark.usefixtures("no_plots")
def test_a_flight_is_replayed_without_the_plotting_library(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN no matplotlib WHEN a log is replayed THEN figures and tables are there, and it is said what is not."""
    config = ROOT / "configs" / "single.toml"
    assert cli.main(["replay", str(config), str(LOGS / "copter.tlog.gz"), "--out", str(tmp_path)]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "pip install" in line]
    assert said == ["note: report.html has no plots: matplotlib is not installed (pip install 'fleetloc[report]')"]
    html = (tmp_path / "report.html").read_text()
    assert "pip install &#x27;fleetloc[report]&#x27;" in html
    assert "<svg" not in html
    assert "<h2>Errors</h2>" in html
    assert (tmp_path / "report.json").stat().st_size > 1000


@pytest.mark.usefixtures("no_plots")
def test_a_study_writes_its_figures_without_the_plotting_library(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--runs", "1", "--samples", "40", "--methods", "dekf_ci", "--gps-shares", "0.5,1", "--jobs", "1"]
    assert cli.main(["bench", "accuracy", *arguments, "--out", str(tmp_path)]) == 0
    assert "no plots are drawn: matplotlib is not installed" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]


def test_a_study_draws_with_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--runs", "1", "--samples", "40", "--methods", "dekf_ci", "--gps-shares", "0.5,1", "--jobs", "1"]
    assert cli.main(["bench", "accuracy", *arguments, "--out", str(tmp_path)]) == 0
    assert "no plots" not in capsys.readouterr().err
    assert list(tmp_path.glob("*.png"))


def test_a_mission_says_what_it_lacks(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    without(monkeypatch, "mavsdk")
    config, mission = LINE3.with_name("sitl3.toml"), LINE3.with_name("mission3.toml")
    assert cli.main(["sitl", str(config), "--mission", str(mission)]) == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "mavsdk is not installed (pip install 'fleetloc[sitl]')" in error


def test_a_px4_log_says_what_it_lacks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    without(monkeypatch, "pyulog")
    log = tmp_path / "flight.ulg"
    log.write_bytes(bytes.fromhex("554c6f67011235") + b"\1" + bytes(8))
    config = ROOT / "configs" / "single.toml"
    assert cli.main(["replay", str(config), str(log), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "pip install 'fleetloc[ulog]'" in error
