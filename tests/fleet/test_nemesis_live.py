"""The live nemesis without its processes: what a seed strikes, and that a history that is not kept is noticed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.reading import dump, load_config
from agent.config.tables import FleetConfig
from agent.log.estimate_log import EstimateLogWriter, header_of
from agent.outputs import EstimateReady
from estimators.estimator import Estimate, SolverReport, Status
from fleetloc.run import run_files
from sim_bridge.world.truth import TruthRecorder
from tests.fleet.nemesis import LINE3, Blow
from tests.fleet.nemesis_live import (
    CALM_S,
    FAULTS_S,
    HEALED_S,
    JUDGED_S,
    PERIOD_S,
    STRUCK,
    LiveFlight,
    live_schedule,
    overrides_of,
)

END_S = CALM_S + HEALED_S + JUDGED_S


def test_a_seed_strikes_the_same_and_nobody_twice() -> None:
    schedules = [live_schedule(seed, (1, 2, 3)) for seed in range(1, 200)]
    assert schedules[6] == live_schedule(7, (1, 2, 3))
    assert {blow.kind for blows in schedules for blow in blows} == set(STRUCK)
    for blows in schedules:
        struck = [agent for blow in blows for agent in (blow.agent, blow.of)]
        assert blows
        assert len(struck) == len(set(struck))
        assert all(CALM_S <= blow.from_s < blow.to_s <= CALM_S + FAULTS_S for blow in blows)


@pytest.mark.parametrize("link", ["udp", "tcp"])
def test_what_a_seed_sets_can_be_flown(link: str) -> None:
    for seed in range(1, 6):
        blows = (*live_schedule(seed, (1, 2, 3)), Blow("one_way", 2, 6.0, 9.0, 0.0, 3))
        config = load_config(LINE3, overrides_of(seed, link, blows))
        assert any(outage.receivers == (2,) and outage.senders == (3,) for outage in config.transport.faults.outages)
        assert config.connect(2)[0].startswith(f"{link}/")
        assert (config.transport.loss == 0.0) == (seed % 2 == 0)


class Flown(LiveFlight):
    """A flight that left what it is told to, and was struck once."""

    def __init__(self, folder: Path, blow: Blow) -> None:
        self.seed, self.out, self.blows, self.broken = 1, folder, (blow,), []
        self.last_blow_s = blow.to_s


def leave(
    folder: Path,
    config: FleetConfig,
    *,
    until_s: float = END_S,
    off_m: float = 0.0,
    status: Status = Status.OK,
    age: int = 0,
    backward: bool = False,
) -> None:
    """The files of a flight in which all drones hover at their starts and know it, ``until_s``."""
    folder.mkdir(exist_ok=True)
    (folder / run_files.CONFIG).write_text(dump(config))
    starts = np.zeros((3, 6))
    starts[:, 0] = 10.0, 20.0, 30.0
    begin_s = 1000.0
    truth = TruthRecorder(config.ids, {})
    for tick in range(round(END_S / PERIOD_S) + 1):
        truth.record(config.fleet.epoch_unix_s + begin_s + PERIOD_S * tick, starts[:, :3], starts[:, 3:])
    truth.truth().save(folder / run_files.TRUTH)
    for agent_id in config.ids:
        log = EstimateLogWriter(run_files.record_path(folder, agent_id), header_of(config, agent_id), 10**9)
        ticks = range(round(until_s / PERIOD_S))
        for tick in reversed(ticks) if backward else ticks:
            mean = starts.ravel().copy()
            mean[0::6] += off_m
            estimate = Estimate(tick, mean, 0.01 * np.eye(18), status, np.full(3, age), SolverReport())
            t_s = begin_s + PERIOD_S * tick
            log.write(EstimateReady(estimate, t_s, t_s + PERIOD_S, True), t_s + PERIOD_S, 0.0)
        log.close()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({}, []),
        ({"until_s": CALM_S + HEALED_S}, ["1 is not back 10 s after the last fault"]),
        ({"off_m": 0.6}, ["1 is 6.0 sigmas off once the fleet is well"]),
        ({"status": Status.NO_DATA}, ["1 is not well at the end"]),
        ({"age": 30}, ["1 does not know all others 10 s after the last fault"]),
        ({"backward": True}, ["stamps of 1 do not rise"]),
    ],
)
def test_a_history_that_is_not_kept_is_noticed(tmp_path: Path, wrong: dict[str, Any], words: list[str]) -> None:
    config = load_config(LINE3, [f"fleet.period_s={PERIOD_S}"])
    leave(tmp_path / "run", config, **wrong)
    found = Flown(tmp_path / "run", Blow("stop", 2, 1.0, CALM_S)).judged()
    assert [line for line in found.broken if line.split()[0] == "1" or " of 1 " in line] == words
    assert len(found.broken) == 3 * len(words)


def test_who_was_deprived_of_its_disk_is_not_asked_for_its_record(tmp_path: Path) -> None:
    config = load_config(LINE3, [f"fleet.period_s={PERIOD_S}"])
    leave(tmp_path / "run", config, until_s=3.0)
    found = Flown(tmp_path / "run", Blow("full_disk", 1, 1.0, CALM_S)).judged()
    assert [line.split()[0] for line in found.broken] == ["2", "3"]
