"""The estimate log: read back as written, cut off, full, foreign."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.errors import LogFileError
from agent.log.estimate_log import (
    FORMAT_JOINT,
    EstimateLogHeader,
    EstimateLogWriter,
    covariance_of,
    entry_dtype,
    read_entries,
    record_chunks,
    variances_of,
    write_summary,
)
from agent.outputs import EstimateReady
from estimators.estimator import Estimate, Status
from estimators.model.layout import states_of

HEADER = EstimateLogHeader(fleet="test", agent=1, agents=(1, 2), period_s=0.1, epoch_unix_s=5.0)


def ready(tick: int, seed: int = 0) -> EstimateReady:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(12, 12))
    estimate = Estimate(tick, rng.normal(size=12), half @ half.T, Status.OK, np.array([0, 3]))
    return EstimateReady(estimate, tick * 0.1, tick * 0.1 + 0.12, True)


def test_a_record_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "new" / "agent_001.estimates"
    recorder = EstimateLogWriter(path, HEADER, 10**6)
    for tick in range(20):
        recorder.write(ready(tick, tick), 0.1 * tick + 0.13, 0.002)
    recorder.close()
    header, entries = read_entries(path)
    assert header == HEADER
    assert entries["tick"].tolist() == list(range(20))
    assert entries["published_s"] == pytest.approx(0.1 * np.arange(20) + 0.13)
    assert (entries[7]["mean"] == ready(7, 7).estimate.mean).all()
    assert covariance_of(entries[7], 2) == pytest.approx(ready(7, 7).estimate.covariance)
    assert entries["age_ticks"][0].tolist() == [0, 3]
    assert entries["on_time"].all()


def test_an_estimate_out_more_than_a_period_after_its_tick_is_late(tmp_path: Path) -> None:
    recorder = EstimateLogWriter(tmp_path / "a.estimates", HEADER, 10**6)
    for published_s in (1.19, 1.21):
        recorder.write(ready(10), published_s, 0.0)
    recorder.close()
    assert read_entries(recorder.path)[1]["on_time"].tolist() == [True, False]


def test_a_killed_writer_leaves_whole_entries(tmp_path: Path) -> None:
    path = tmp_path / "agent_001.estimates"
    recorder = EstimateLogWriter(path, HEADER, 10**6)
    recorder.write(ready(1), 0.0, 0.0)
    recorder.write(ready(2), 0.0, 0.0)
    recorder.close()
    path.write_bytes(path.read_bytes()[:-5])
    assert read_entries(path)[1]["tick"].tolist() == [1]


def test_a_log_that_has_just_begun_is_read_as_one_without_estimates(tmp_path: Path) -> None:
    # GIVEN a daemon that has begun and is killed before its first estimate
    path = tmp_path / "agent_001.estimates"
    writer = EstimateLogWriter(path, HEADER, 10**6)
    header, entries = read_entries(path)
    assert header == HEADER
    assert len(entries) == 0
    writer.close()


def test_a_full_record_stops_growing_and_says_so(tmp_path: Path) -> None:
    recorder = EstimateLogWriter(tmp_path / "a.estimates", HEADER, 3 * entry_dtype(2).itemsize)
    for tick in range(5):
        recorder.write(ready(tick), 0.0, 0.0)
    recorder.close()
    assert (recorder.written, recorder.skipped) == (3, 2)


def test_what_is_no_record_is_named(tmp_path: Path) -> None:
    for content in (b"", b"not json\n", b'{"format":"other/1"}\n'):
        path = tmp_path / "wrong.estimates"
        path.write_bytes(content)
        with pytest.raises(LogFileError, match=r"wrong.estimates: expected"):
            read_entries(path)
    with pytest.raises(LogFileError, match="cannot be read"):
        read_entries(tmp_path / "missing")
    (tmp_path / "file").write_text("")
    with pytest.raises(LogFileError, match="cannot be written"):
        EstimateLogWriter(tmp_path / "file" / "a.estimates", HEADER, 10**6)
    with pytest.raises(LogFileError, match="cannot be written"):
        write_summary(tmp_path / "file" / "a.json", {})


def test_a_record_of_a_large_fleet_holds_a_joint_state_and_the_variances_of_all(tmp_path: Path) -> None:
    agents = tuple(range(1, 9))
    header = EstimateLogHeader(
        format=FORMAT_JOINT, fleet="test", agent=2, agents=agents, period_s=0.1, epoch_unix_s=5.0, joint=3
    )
    rng = np.random.default_rng(5)
    covariances = []
    writer = EstimateLogWriter(tmp_path / "agent_002.estimates", header, 10**6)
    for tick, joint in enumerate([(2, 3, 7), (2,), (1, 2)]):
        covariance = np.diag(rng.uniform(1.0, 2.0, 48))
        at = states_of([agent - 1 for agent in joint])
        half = rng.normal(size=(len(at), len(at)))
        covariance[np.ix_(at, at)] = half @ half.T
        covariances.append(covariance)
        estimate = Estimate(tick, rng.normal(size=48), covariance, Status.OK, np.zeros(8, np.int64))
        writer.write(EstimateReady(estimate, 0.1 * tick, 0.1 * tick + 0.12, True, joint), 0.1 * tick + 0.13, 0.0)
    writer.close()
    read, entries = read_entries(writer.path)
    (chunk,) = record_chunks(writer.path, 8)
    assert read == header
    for k, covariance in enumerate(covariances):
        np.testing.assert_array_equal(covariance_of(entries[k], 8), covariance)
        np.testing.assert_array_equal(covariance_of(chunk[k], 8), covariance)
        np.testing.assert_array_equal(variances_of(entries, 8)[k], covariance.diagonal())
    assert entry_dtype(100, 10).itemsize < 0.02 * entry_dtype(100).itemsize


def test_variances_are_the_diagonal_of_a_whole_covariance_too(tmp_path: Path) -> None:
    writer = EstimateLogWriter(tmp_path / "agent_001.estimates", HEADER, 10**6)
    writer.write(ready(1, 3), 0.0, 0.0)
    writer.close()
    _, entries = read_entries(writer.path)
    np.testing.assert_array_equal(variances_of(entries, 2)[0], ready(1, 3).estimate.covariance.diagonal())
