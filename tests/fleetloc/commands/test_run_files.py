"""The files of a run: records of a restarted daemon are kept, a new run starts clean."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from agent.config.reading import load_config
from fleetloc import cli
from fleetloc.errors import InputError
from fleetloc.run.run_files import clear, in_folder, keep_earlier_record, record_path, records, refuse_inputs

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"


def names(paths: list[Path]) -> list[str]:
    return [path.name for path in paths]


def test_restarts_keep_every_record_in_order(tmp_path: Path) -> None:
    for life in range(3):
        keep_earlier_record(tmp_path, 2)
        record_path(tmp_path, 2).write_text(str(life))
    assert names(records(tmp_path, 2)) == ["agent_002.1.estimates", "agent_002.2.estimates", "agent_002.estimates"]
    assert [path.read_text() for path in records(tmp_path, 2)] == ["0", "1", "2"]
    assert records(tmp_path, 1) == []


def test_counters_and_flight_record_go_with_their_record(tmp_path: Path) -> None:
    record_path(tmp_path, 1).write_text("")
    beside = [".json", ".tlog", ".mcap"]
    for suffix in beside:
        (tmp_path / f"agent_001{suffix}").write_text("first")
    keep_earlier_record(tmp_path, 1)
    for suffix in beside:
        assert (tmp_path / f"agent_001.1{suffix}").read_text() == "first"
        assert not (tmp_path / f"agent_001{suffix}").exists()


def test_clearing_removes_what_a_run_wrote_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "run"
    clear(folder)
    written = ["agent_001.estimates", "agent_001.2.estimates", "agent_001.json", "agent_001.log", "truth.npz"]
    written += ["agent_001.mcap", "agent_001.2.tlog"]
    kept = ["notes.txt", "agent_plan.json", "figures.json"]
    for name in written + kept:
        (folder / name).write_text("")
    clear(folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted(kept)


@pytest.mark.parametrize("name", ["fleet.toml", "agent_001.tlog", "agent_002.1.mcap", "truth.npz", "agent_001.csv"])
def test_a_folder_in_which_a_run_would_lose_its_input_is_refused(tmp_path: Path, name: str) -> None:
    kept, linked = tmp_path / name, tmp_path / "elsewhere" / "another name"
    kept.write_text("precious")
    linked.parent.mkdir()
    linked.symlink_to(kept)
    also = re.compile(r"agent_[0-9]{3}\.csv")
    for path in (kept, linked):
        with pytest.raises(InputError, match=f"--out: {tmp_path}: expected another folder.* an input .*{name}"):
            refuse_inputs(tmp_path, ("recorded", path), also)
    # what is of another name, or in another folder, is in no danger
    refuse_inputs(tmp_path, (tmp_path / "no such file", LINE3), also)
    refuse_inputs(tmp_path / "new", (kept,), also)


@pytest.mark.parametrize("command", [("fleet", "--lockstep"), ("fleet",), ("sitl",)])
def test_a_run_does_not_overwrite_the_configuration_it_is_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    mine = tmp_path / "fleet.toml"
    text = LINE3.with_stem("sitl3" if command[0] == "sitl" else "line3").read_text()
    mine.write_text(text)
    assert cli.main([command[0], str(mine), "--out", str(tmp_path), *command[1:]]) == 2
    stderr = capsys.readouterr().err
    assert f"--out: {tmp_path}: expected another folder" in stderr
    assert stderr.count("\n") == 1
    assert mine.read_text() == text


def test_a_run_does_not_overwrite_what_is_laid_over_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile = tmp_path / "fleet.toml"
    profile.write_text("[transport]\nloss = 0.1\n")
    arguments = ["fleet", str(LINE3), "--with", str(profile), "--out", str(tmp_path), "--lockstep"]
    assert cli.main(arguments) == 2
    assert "an input of this run, fleet.toml" in capsys.readouterr().err
    assert profile.exists()


def test_a_live_fleet_refuses_faults_that_only_virtual_time_can_inject(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lie = 'sim.faults=[{kind="member_stuck", agents=[2]}]'
    assert cli.main(["fleet", str(LINE3), "--set", lie, "--out", str(tmp_path / "run")]) == 2
    stderr = capsys.readouterr().err
    assert "sim.faults: expected faults of sensors in a live run" in stderr
    assert '"member_stuck"' in stderr
    assert not (tmp_path / "run").exists()


def test_the_folders_of_keys_and_state_are_found_from_anywhere(tmp_path: Path) -> None:
    config = load_config(LINE3, ["security.keys=mine", "security.state=run/state"])
    written = in_folder(config, tmp_path, tmp_path / "out")
    assert written.security.keys == str(tmp_path / "mine")
    assert written.security.state == str(tmp_path / "run" / "state")
    assert written.record.directory == str(tmp_path / "out")
    assert in_folder(load_config(LINE3), tmp_path, tmp_path).security.state is None
