"""The fleet clock, the record, the start: small parts that everything stands on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.tables import FleetConfig
from agent.errors import ConfigError, RecordError
from agent.log.estimate_log import (
    EstimateRecorder,
    RecordHeader,
    covariance_of,
    entry_dtype,
    read_record,
    write_summary,
)
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady, estimate_message
from agent.sensing.clock import FleetClock, require_epoch
from agent.warmup import warm_up
from agent.watch.health import State
from estimators.estimator import Estimate, Status
from estimators.factory import make_estimator
from transport.security.auth import Identity

MakeConfig = Callable[..., FleetConfig]

# --- clock -------------------------------------------------------------------------------------------------


def test_small_differences_are_slewed_and_time_never_goes_back() -> None:
    clock = FleetClock(1000.0, unix_s=5000.0, host_s=10.0)
    assert clock.fleet_s(10.0) == 4000.0
    last = 0.0
    for step in range(1, 300):
        host_s = 10.0 + step
        assert not clock.sync(unix_s=4990.0 + host_s - 0.2, host_s=host_s)
        assert clock.fleet_s(host_s) > last
        last = clock.fleet_s(host_s)
    assert clock.fleet_s(309.0) == pytest.approx(4299.0 - 0.2, abs=1e-9)
    assert clock.steps == 0


@given(st.floats(0.6, 1e6), st.booleans())
def test_a_step_of_utc_is_followed_at_once_and_said(size_s: float, forward: bool) -> None:
    clock = FleetClock(0.0, unix_s=2e6, host_s=0.0)
    jumped = 2e6 + 1.0 + (size_s if forward else -size_s)
    assert clock.sync(unix_s=jumped, host_s=1.0)
    assert clock.fleet_s(1.0) == pytest.approx(jumped)
    assert clock.steps == 1


def test_an_epoch_that_leaves_now_without_a_tick_is_refused(make_config: MakeConfig) -> None:
    now_s = 1_790_000_000.0
    assert require_epoch(make_config(), unix_s=now_s) is None
    for epoch_s in (0.0, 4_000_000_000.0):
        config = make_config(3, f"fleet.epoch_unix_s={epoch_s}")
        expected = r"--set: fleet.epoch_unix_s: expected 1360503270..1790000000, .* found "
        with pytest.raises(ConfigError, match=f"{expected}{epoch_s:.0f}$"):
            require_epoch(config, unix_s=now_s)


def test_a_host_that_was_never_told_the_time_is_no_fault_of_the_epoch(make_config: MakeConfig) -> None:
    assert require_epoch(make_config(), unix_s=1e9) == "clock at 2001-09-09, outside the fleet's time"
    # nor where it went on from its last shutdown, a month before the fleet's epoch
    config = make_config(3, "fleet.epoch_unix_s=1790000000")
    assert require_epoch(config, unix_s=1_790_000_000.0 - 30 * 86_400.0) is not None


def test_the_health_says_while_ticks_fit_no_packet(make_config: MakeConfig) -> None:
    # GIVEN a companion computer that starts before its clock is set
    config = make_config()
    onboard = OnboardAgent(config, 1, make_estimator, Identity(), unix_s=1e9, host_s=0.0)
    for step in range(20):
        onboard.advance(0.05 * step)
    health = onboard.core.health.health
    assert health.state is State.INIT
    assert health.reasons[0] == "clock at 2001-09-09, outside the fleet's time"
    # WHEN it is set THEN that is over
    assert onboard.keep_house(unix_s=1_790_000_000.0, host_s=1.0)
    for step in range(20):
        onboard.advance(1.0 + 0.05 * step)
    assert not [reason for reason in onboard.core.health.health.reasons if reason.startswith("clock")]


# --- record ------------------------------------------------------------------------------------------------

HEADER = RecordHeader(fleet="test", agent=1, agents=(1, 2), period_s=0.1, epoch_unix_s=5.0)


def ready(tick: int, seed: int = 0) -> EstimateReady:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(12, 12))
    estimate = Estimate(tick, rng.normal(size=12), half @ half.T, Status.OK, np.array([0, 3]))
    return EstimateReady(estimate, tick * 0.1, tick * 0.1 + 0.12, True)


def test_a_record_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "new" / "agent_001.estimates"
    recorder = EstimateRecorder(path, HEADER, 10**6)
    for tick in range(20):
        recorder.write(ready(tick, tick), 0.1 * tick + 0.13, 0.002)
    recorder.close()
    header, entries = read_record(path)
    assert header == HEADER
    assert entries["tick"].tolist() == list(range(20))
    assert entries["published_s"] == pytest.approx(0.1 * np.arange(20) + 0.13)
    assert (entries[7]["mean"] == ready(7, 7).estimate.mean).all()
    assert covariance_of(entries[7], 2) == pytest.approx(ready(7, 7).estimate.covariance)
    assert entries["age_ticks"][0].tolist() == [0, 3]
    assert entries["on_time"].all()


def test_an_estimate_out_more_than_a_period_after_its_tick_is_late(tmp_path: Path) -> None:
    recorder = EstimateRecorder(tmp_path / "a.estimates", HEADER, 10**6)
    for published_s in (1.19, 1.21):
        recorder.write(ready(10), published_s, 0.0)
    recorder.close()
    assert read_record(recorder.path)[1]["on_time"].tolist() == [True, False]


def test_a_killed_writer_leaves_whole_entries(tmp_path: Path) -> None:
    path = tmp_path / "agent_001.estimates"
    recorder = EstimateRecorder(path, HEADER, 10**6)
    recorder.write(ready(1), 0.0, 0.0)
    recorder.write(ready(2), 0.0, 0.0)
    recorder.close()
    path.write_bytes(path.read_bytes()[:-5])
    assert read_record(path)[1]["tick"].tolist() == [1]


def test_a_full_record_stops_growing_and_says_so(tmp_path: Path) -> None:
    recorder = EstimateRecorder(tmp_path / "a.estimates", HEADER, 3 * entry_dtype(2).itemsize)
    for tick in range(5):
        recorder.write(ready(tick), 0.0, 0.0)
    recorder.close()
    assert (recorder.written, recorder.skipped) == (3, 2)


def test_what_is_no_record_is_named(tmp_path: Path) -> None:
    for content in (b"", b"not json\n", b'{"format":"other/1"}\n'):
        path = tmp_path / "wrong.estimates"
        path.write_bytes(content)
        with pytest.raises(RecordError, match=r"wrong.estimates: expected"):
            read_record(path)
    with pytest.raises(RecordError, match="cannot be read"):
        read_record(tmp_path / "missing")
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordError, match="cannot be written"):
        EstimateRecorder(tmp_path / "file" / "a.estimates", HEADER, 10**6)
    with pytest.raises(RecordError, match="cannot be written"):
        write_summary(tmp_path / "file" / "a.json", {})


def test_an_estimate_travels_with_its_senders_own_block() -> None:
    message = estimate_message(ready(5).estimate, (1, 2), slice(6, 12))
    assert message.own_covariance == pytest.approx(ready(5).estimate.covariance[6:, 6:])
    assert message.variance == pytest.approx(ready(5).estimate.covariance.diagonal())
    assert (message.tick, message.status, message.age_ticks) == (5, 0, (0, 3))


# --- warm-up -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["dekf_ci", "dmhe_pre_ekf"])
def test_warming_up_runs_the_estimator_that_is_to_come(make_config: MakeConfig, kind: str) -> None:
    solved = []

    def factory(*arguments: Any) -> Any:
        made = make_estimator(*arguments)
        solve = made.solve
        made.solve = lambda budget=None: solved.append(solve(budget))  # type: ignore[assignment,method-assign,func-returns-value]
        return made

    warm_up(make_config(3, f"estimator.kind={kind}"), 2, factory)
    assert len(solved) == 3
    assert {estimate.status for estimate in solved} <= {Status.OK, Status.NOT_CONVERGED}
