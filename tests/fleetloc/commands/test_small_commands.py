"""``fleetloc check`` and ``fleetloc keys``."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from fleetloc import cli
from fleetloc.whole_config import load_whole

CONFIGS = Path(__file__).parents[3] / "configs"
LINE3 = CONFIGS / "line3.toml"


@pytest.mark.parametrize("name", ["line3", "mesh5", "gps_loss"])
def test_the_sample_configurations_are_right(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(CONFIGS / f"{name}.toml")]) == 0
    assert f"fleet {name}, 10 Hz" in capsys.readouterr().out


def test_check_prints_what_is_in_effect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(LINE3), "--print", "--set", "estimator.window=3"]) == 0
    printed = tmp_path / "printed.toml"
    printed.write_text(capsys.readouterr().out)
    text = printed.read_text()
    assert load_whole(printed) == load_whole(LINE3, ["estimator.window=3"])
    assert "duration_s = 60.0" in text
    assert "track_s = 60.0" in text


@pytest.mark.parametrize("epoch_s", [0, 4_000_000_000])
def test_an_epoch_whose_ticks_fit_no_packet_is_refused(capsys: pytest.CaptureFixture[str], epoch_s: int) -> None:
    for command in (["check", str(LINE3)], ["agent", str(LINE3), "--id", "1"]):
        assert cli.main([*command, "--set", f"fleet.epoch_unix_s={epoch_s}"]) == 2
        told = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: packets are")]
        (line,) = told
        assert ": fleet.epoch_unix_s: expected " in line
        assert f"found {epoch_s}" in line


def test_check_looks_at_the_scenario_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(LINE3), "--set", "sim.paths.1.lap_s=2"]) == 2
    assert "path: expected one that needs at most 2.0 m/s2" in capsys.readouterr().err


@pytest.fixture
def signed(tmp_path: Path) -> Path:
    path = tmp_path / "fleet.toml"
    path.write_text(LINE3.read_text().replace('"unsigned"', '"signed"'))
    return path


def test_keys_from_first_to_last(signed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["keys", "init", str(signed)]) == 0
    first = capsys.readouterr().out.splitlines()
    assert [line.split()[:5] for line in first[:3]] == [["agent", str(i), "secret", "here", "key"] for i in (1, 2, 3)]
    assert [line.split()[0] for line in first[3:]] == ["authority", "observer", "group"]
    assert stat.S_IMODE((signed.parent / "keys" / "agent_002.key").stat().st_mode) == 0o600
    assert cli.main(["keys", "rotate", str(signed), "--id", "2"]) == 0
    out, err = capsys.readouterr()
    rotated, former = out.splitlines()[1].split(), first[1].split()[5]
    assert f"former key {former} (accepted until it is retired)" in out.splitlines()[1]
    assert err.startswith("next: `fleetloc keys export ")
    assert err.endswith(f"then `fleetloc keys retire {signed} --id 2`\n")
    assert cli.main(["keys", "retire", str(signed), "--id", "2"]) == 0
    capsys.readouterr()
    assert cli.main(["keys", "list", str(signed)]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert listed[1].split()[5:7] == [rotated[5], "certificate"]
    assert (listed[0], listed[2]) == (first[0], first[2])


def test_keys_are_not_overwritten_nor_made_for_strangers(signed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["keys", "init", str(signed)]) == 0
    capsys.readouterr()
    assert cli.main(["keys", "init", str(signed)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert cli.main(["keys", "add", str(signed), "--id", "9"]) == 2
    assert "--id: expected one of 1, 2, 3" in capsys.readouterr().err
