"""Flight logs repeated: the same estimates, bit by bit, whatever happened in flight."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.records import Channel, DataEnd, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from nacl.signing import SigningKey

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.errors import LogFileError
from agent.log.disk import DiskLimit
from agent.log.flight_format import CLOSED, CUT_OFF
from agent.outputs import EstimateReady
from estimators.estimator import Status
from estimators.factory import make_estimator
from sim_bridge.replay.flight_log_replay import FlightLogReplay, ReplayedTick, replay_flight_log
from sim_bridge.world.scenario import Reboot
from tests.support.recorded_fleet import ROOM, RecordedFleet
from transport.link.streams import Stream

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
DURATION_S = 3.0


def record_of(fleet: RecordedFleet, agent_id: int) -> Path:
    return fleet.out / f"agent_{agent_id:03d}.mcap"


def repeat(
    fleet: RecordedFleet, agent_id: int, config: FleetConfig | None = None
) -> tuple[FlightLogReplay, list[ReplayedTick]]:
    ticks: list[ReplayedTick] = []
    (result,) = replay_flight_log(
        [record_of(fleet, agent_id)], config, make_estimator, lambda i, tick: ticks.append(tick)
    )
    return result, ticks


def same(one: EstimateReady, other: EstimateReady) -> bool:
    """Equal in every bit."""
    a, b = one.estimate, other.estimate
    arrays = ((a.mean, b.mean), (a.covariance, b.covariance), (a.age_ticks, b.age_ticks))
    return (a.tick, a.status, one.t_s, one.ready_s) == (b.tick, b.status, other.t_s, other.ready_s) and all(
        np.array_equal(x, y) for x, y in arrays
    )


def expect_equal(fleet: RecordedFleet, agent_id: int, share: slice = slice(None)) -> FlightLogReplay:
    """The replay gives the live estimates (of a part of the flight) and what is counted."""
    result, ticks = repeat(fleet, agent_id)
    made = [tick.ready for tick in ticks if tick.ready is not None]
    assert result.equal
    assert (result.different, result.only_recorded) == (0, 0)
    live = fleet.estimates[agent_id][share]
    assert len(made) == len(live)
    assert all(same(one, other) for one, other in zip(made, live, strict=True))
    return result


# --- plain ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> RecordedFleet:
    fleet = RecordedFleet(load_config(LINE3), tmp_path_factory.mktemp("flown"))
    fleet.fly(DURATION_S)
    return fleet


def test_a_flight_repeated_gives_its_estimates_bit_by_bit(flown: RecordedFleet) -> None:
    for agent_id, drone in flown.drones.items():
        result = expect_equal(flown, agent_id)
        assert result.ended == CLOSED
        assert result.complete
        assert result.compared == len(flown.estimates[agent_id]) >= 10 * DURATION_S - 2
        assert result.counters == dict(drone.agent.core.counters)
        assert result.counters["status: ok"] > 5


def test_each_estimate_says_which_inputs_it_had(flown: RecordedFleet) -> None:
    _, ticks = repeat(flown, 2)
    pairs = [(tick.inputs, tick.recorded.inputs) for tick in ticks if tick.recorded is not None]
    assert all(made == recorded for made, recorded in pairs)
    assert sorted({made for made, _ in pairs}) == [made for made, _ in pairs]


def test_another_configuration_says_what_would_have_been(flown: RecordedFleet) -> None:
    # GIVEN a record, WHEN it is repeated with another estimator
    config = flown.config
    other = msgspec.structs.replace(config, estimator=msgspec.structs.replace(config.estimator, kind="dekf_ci"))
    result, ticks = repeat(flown, 1, other)
    # THEN there are as many ticks, with other estimates
    assert result.ticks == result.compared == len(flown.estimates[1])
    assert result.different > 10
    assert not result.equal
    assert all(tick.ready is not None and np.isfinite(tick.ready.estimate.mean).all() for tick in ticks)


def retold(path: Path, folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of a flight log in which the twentieth estimate says something else."""
    copy, seen = folder / path.name, 0
    shutil.copy(path.with_suffix(".tlog"), folder)
    with path.open("rb") as stream, copy.open("wb") as out:
        writer = Writer(out)
        writer.start()
        topics: dict[int, str] = {}
        for record in StreamReader(stream).records:
            if isinstance(record, DataEnd):
                break  # the index behind it is made anew
            if isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Schema):
                writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in topics:
                topics[record.id] = record.topic
                assert writer.register_channel(record.topic, record.message_encoding, record.schema_id) == record.id
            elif isinstance(record, Message):
                data = record.data
                if topics[record.channel_id].endswith("/estimate"):
                    seen += 1
                    if seen == 20:
                        said = json.loads(data)
                        change(said)
                        data = json.dumps(said).encode()
                writer.add_message(record.channel_id, record.log_time, data, record.publish_time, record.sequence)
        writer.finish()
    return copy


def other_status(said: dict[str, Any]) -> None:
    said["status"] = int(Status.FELL_BACK)


def other_age(said: dict[str, Any]) -> None:
    said["agents"]["agent_002"]["age_s"] += 0.1


def no_age(said: dict[str, Any]) -> None:
    del said["agents"]["agent_003"]["age_s"]


def other_mean(said: dict[str, Any]) -> None:
    said["agents"]["agent_002"]["position_m"]["north"] += 1e-6


def rounded_mean(said: dict[str, Any]) -> None:
    said["agents"]["agent_002"]["position_m"]["north"] += 1e-10


@pytest.mark.parametrize(
    ("change", "contradicted", "different", "equal"),
    [
        (lambda said: None, 0, 0, True),
        (rounded_mean, 0, 1, True),
        (other_mean, 0, 1, False),
        (other_status, 1, 1, False),
        (other_age, 1, 1, False),
        (no_age, 1, 1, False),
    ],
    ids=["same", "rounded mean", "other mean", "other status", "other age", "no age"],
)
def test_a_run_is_equal_only_if_status_and_ages_are_too(
    flown: RecordedFleet,
    tmp_path: Path,
    change: Callable[[dict[str, Any]], None],
    contradicted: int,
    different: int,
    equal: bool,
) -> None:
    # GIVEN a flight log one of whose estimates says something else in a single place
    path = retold(record_of(flown, 1), tmp_path, change)
    (result,) = replay_flight_log([path], None, make_estimator)
    # THEN only rounding passes for equal
    assert result.complete
    assert (result.contradicted, result.different, result.equal) == (contradicted, different, equal)


def test_a_configuration_without_the_agent_is_refused(flown: RecordedFleet) -> None:
    config = msgspec.structs.replace(flown.config, agents=flown.config.agents[:2])
    with pytest.raises(LogFileError, match=r"agent_003\.mcap: of agent 3, expected one of 1, 2"):
        repeat(flown, 3, config)


# --- rough ---------------------------------------------------------------------------------------------------


def spoiler(seed: int) -> Callable[[int, bytes], list[bytes]]:
    """Garbage, truncated datagrams and, for agent 1 (a serial line), reads that end anywhere."""
    rng = np.random.default_rng(seed)

    def spoil(agent_id: int, data: bytes) -> list[bytes]:
        if rng.random() < 0.03:
            data = rng.bytes(9) + data
        if rng.random() < 0.02:
            data = data[: int(rng.integers(1, len(data)))]
        if agent_id != 1:
            return [data]
        middle = int(rng.integers(0, len(data)))
        return [part for part in (data[:middle], data[middle:]) if part]

    return spoil


@pytest.fixture(scope="module")
def rough(tmp_path_factory: pytest.TempPathFactory) -> RecordedFleet:
    """Signed packets, garbage on all links, forged and repeated packets, a clock that steps, a reboot."""
    config = load_config(LINE3, ["agents.1.mavlink=tcp:127.0.0.1:5760", "security.mode=signed"])
    keys = {i: SigningKey(bytes([i]) * 32) for i in config.ids}
    fleet = RecordedFleet(
        config,
        tmp_path_factory.mktemp("rough"),
        spoil=spoiler(3),
        change=lambda scenario: replace(scenario, reboots=(Reboot(2, 2.0, 0.5),)),
        signing=dict(keys),
        trust={i: (key.verify_key,) for i, key in keys.items()},
    )
    rng = np.random.default_rng(4)
    begin_s = fleet.queue.now_s

    def forge() -> None:
        for sender in fleet.config.ids:
            fleet.fleet.transmit(sender, Stream.MEAS, rng.bytes(int(rng.integers(0, 300))))

    def step_clock() -> None:
        fleet.drones[3].utc_error_s = 1.7

    for k in range(30):
        fleet.queue.at(begin_s + 0.5 + 0.1 * k, forge)
    fleet.queue.at(begin_s + 1.8, step_clock)
    fleet.queue.at(begin_s + 1.5, lambda: fleet.agent(2).on_gone(1, fleet.queue.now_s))
    fleet.fly(4.0)
    return fleet


def test_a_rough_flight_is_repeated_bit_by_bit_too(rough: RecordedFleet) -> None:
    for agent_id, drone in rough.drones.items():
        assert expect_equal(rough, agent_id).counters == dict(drone.agent.core.counters)


def test_the_rough_flight_was_rough(rough: RecordedFleet) -> None:
    first, second, third = (drone.agent for drone in rough.drones.values())
    assert third.clock.steps == 1
    assert len(rough.estimates[3]) > third.core.counters["ticks"] > 5  # two cores
    assert second.autopilot.reboots == 1
    assert first.autopilot.decoder.bad.total() > 3
    assert sum(second.opener.peers.rejections().values()) > 20


# --- records that end early ----------------------------------------------------------------------------------


def test_a_record_that_ended_at_its_size_repeats_the_flight_until_there(tmp_path: Path) -> None:
    limit = DiskLimit(tmp_path, 50_000, 0, lambda _: ROOM)
    fleet = RecordedFleet(load_config(LINE3), tmp_path, limit=limit)
    fleet.fly(4.0)
    for agent_id, record in fleet.records.items():
        assert record.counters["record entries"] > 0
        assert record.counters["record dropped"] > 0
        result, ticks = repeat(fleet, agent_id)
        assert result.equal
        assert not result.complete
        assert "flight_max_mb" in result.ended
        assert 3 < result.compared < len(fleet.estimates[agent_id])
        assert all(
            same(tick.ready, live)
            for tick, live in zip(ticks, fleet.estimates[agent_id][: len(ticks)], strict=True)
            if tick.ready is not None
        )


def test_a_killed_daemons_record_repeats_the_flight_until_the_last_flush(tmp_path: Path) -> None:
    # GIVEN a record that is never closed (what is buffered in the process is lost)
    fleet = RecordedFleet(load_config(LINE3), tmp_path)
    fleet.fly(2.5, close=False)
    result, _ = repeat(fleet, 2)
    # THEN all but about the last second is there
    assert result.ended.startswith(CUT_OFF)
    assert result.max_mean_difference == result.max_sigma_difference == result.different == 0.0
    assert result.compared >= len(fleet.estimates[2]) - 16
    for record in fleet.records.values():
        record.close()


def test_a_full_disk_leaves_the_flight_as_it_is(tmp_path: Path, flown: RecordedFleet) -> None:
    (tmp_path / "agent_001.tlog").symlink_to("/dev/full")
    fleet = RecordedFleet(load_config(LINE3), tmp_path)
    fleet.fly(DURATION_S)
    # THEN the agent's flight is the one with a good disk, and only its record is short
    pairs: Any = zip(fleet.estimates[1], flown.estimates[1], strict=True)
    assert all(same(one, other) for one, other in pairs)
    assert "No space left" in fleet.records[1].ended
    assert not repeat(fleet, 1)[0].complete
    expect_equal(fleet, 2)
