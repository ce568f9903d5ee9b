"""A notebook reads what a flight has left, and the scripts that are shown do so."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import fleetloc
from agent.log.estimate_log import covariance_of, read_entries
from fleetloc import cli

ROOT = Path(__file__).parents[3]
RECORD = ROOT / "tests/data/records/one_exchange_002.mcap"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder ``out/line3`` of a short flight, where the scripts that are shown look for it."""
    folder = tmp_path_factory.mktemp("flown")
    out = folder / "out/line3"
    config = ROOT / "configs/line3.toml"
    assert cli.main(["fleet", str(config), "--lockstep", "--duration", "5", "--out", str(out)]) == 0
    return folder


def test_an_estimate_log_is_what_the_file_holds(flown: Path) -> None:
    path = flown / "out/line3/agent_002.estimates"
    log, (header, entries) = fleetloc.read_estimate_log(path), read_entries(path)
    count = len(entries)
    assert count >= 45
    assert (log.agent_id, log.agents, log.period_s) == (2, header.agents, header.period_s)
    assert log.position_m.shape == log.velocity_mps.shape == log.position_sigma_m.shape == (count, 3, 3)
    states = np.concatenate((log.position_m, log.velocity_mps), axis=2).reshape(count, 18)
    sigmas = np.concatenate((log.position_sigma_m, log.velocity_sigma_mps), axis=2).reshape(count, 18)
    np.testing.assert_array_equal(states, entries["mean"])
    for k in (0, count - 1):
        np.testing.assert_array_equal(log.covariance(k), covariance_of(entries[k], 3))
        np.testing.assert_array_equal(sigmas[k], np.sqrt(np.diag(log.covariance(k))))
    known = entries["age_ticks"] < 2**31 - 1
    np.testing.assert_array_equal(np.isfinite(log.age_s), known)
    np.testing.assert_allclose(log.age_s[known], entries["age_ticks"][known] * 0.1)
    assert fleetloc.Status(log.status[-1]) is fleetloc.Status.OK


def test_the_shown_notebook_finds_what_the_report_says(
    flown: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    script = page.partition("## A notebook")[2].partition("```python\n")[2].partition("```")[0]
    monkeypatch.chdir(flown)
    exec(compile(script, "docs/python.md", "exec"), {})
    rmse_m, share = map(float, re.findall(r"\d+\.\d+", capsys.readouterr().out))
    of_report = json.loads((flown / "out/line3/report.json").read_text())["agents"][0]
    assert rmse_m == pytest.approx(of_report["position_rmse_m"])
    assert share == pytest.approx(1.0 - of_report["ticks_without_estimate"] / of_report["ticks_expected"])


def test_the_estimates_of_a_flight_record_come_in_order() -> None:
    ticks = [entry.tick for entry in fleetloc.read_flight_estimates(RECORD)]
    assert len(ticks) > 10
    assert ticks == sorted(set(ticks))


@pytest.mark.parametrize(
    ("read", "name"),
    [
        (fleetloc.read_estimate_log, "a.estimates"),
        (lambda path: list(fleetloc.read_flight_estimates(path)), "a.mcap"),
    ],
)
def test_another_file_is_refused_by_name(read: object, name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(b"something else\n")
    with pytest.raises(fleetloc.LogFileError, match=re.escape(str(path))):
        read(path)  # type: ignore[operator]


def test_the_shown_replay_repeats_a_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs/replay.md").read_text(encoding="utf-8")
    script = page.partition("```python\nfrom fleetloc")[2].partition("```")[0]
    (tmp_path / "out/line3").mkdir(parents=True)
    for suffix in (".mcap", ".tlog"):
        (tmp_path / "out/line3/agent_001").with_suffix(suffix).symlink_to(RECORD.with_suffix(suffix))
    monkeypatch.chdir(tmp_path)
    exec(compile("from fleetloc" + script, "docs/replay.md", "exec"), {})
    compared, different, difference = capsys.readouterr().out.split()
    assert int(compared) > 10
    assert int(different) <= int(compared)
    assert float(difference) <= 0.01
