"""The files of a run: records of a restarted daemon are kept, a new run starts clean."""

from __future__ import annotations

from pathlib import Path

from fleetloc.run_files import clear, keep_earlier_record, record_path, records


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
