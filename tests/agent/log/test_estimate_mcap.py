"""Estimates in MCAP: what other tools find in the file, to the last digit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from agent.errors import LogFileError
from agent.log.estimate_mcap import EstimateMcap, EstimateMessage, estimate_message
from agent.outputs import EstimateReady
from estimators.estimator import Estimate, SolverReport, Status
from transport.messages.estimate_body import MAX_AGE_TICKS

EPOCH_UNIX_S, PERIOD_S = 1_767_225_600.0, 0.1
AGENTS = (3, 12)


def ready(tick: int, mean: np.ndarray, variance: np.ndarray, ages: tuple[int, int] = (0, 5)) -> EstimateReady:
    estimate = Estimate(tick, mean, np.diag(variance), Status.OK, np.array(ages), SolverReport())
    return EstimateReady(estimate, tick * PERIOD_S, tick * PERIOD_S + 0.12, True)


def messages(path: Path) -> list[tuple[Any, Any, Any, Any]]:
    with path.open("rb") as stream:
        return [
            (schema, channel, message, json.loads(message.data))
            for schema, channel, message in make_reader(stream).iter_messages()
        ]


def test_a_viewer_finds_curves_of_every_agent_and_poses_with_north_ahead_and_up_up(tmp_path: Path) -> None:
    # GIVEN estimates of two agents in one file
    path = tmp_path / "new" / "a.mcap"
    file = EstimateMcap(path, AGENTS, PERIOD_S, EPOCH_UNIX_S)
    mean, variance = np.arange(12.0), np.full(12, 0.04)
    for tick in range(30):
        for agent_id in AGENTS:
            file.write(agent_id, ready(tick, mean + tick, variance), tick * PERIOD_S + 0.12)
    file.close()
    # WHEN the library's own reader goes through it
    found = messages(path)
    # THEN each agent has its channel with a schema, each message its time and its numbers
    topics = {channel.topic for _, channel, _, _ in found}
    assert topics == {f"/agent_{i:03d}/{name}" for i in AGENTS for name in ("estimate", "poses")}
    for schema, channel, _, content in found:
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        described = json.loads(schema.data)
        assert described["type"] == "object"
        assert content.keys() <= described["properties"].keys()
    estimates = [(m, c) for _, channel, m, c in found if channel.topic == "/agent_012/estimate"]
    assert [content["tick"] for _, content in estimates] == list(range(30))
    message, last = estimates[-1]
    assert message.log_time == round((EPOCH_UNIX_S + 29 * PERIOD_S + 0.12) * 1e9)
    assert last["agents"]["agent_012"]["position_m"] == {"north": 35.0, "east": 36.0, "down": 37.0}
    assert last["agents"]["agent_012"]["velocity_sigma_mps"]["down"] == pytest.approx(0.2)
    assert last["agents"]["agent_012"]["age_s"] == pytest.approx(0.5)
    poses = [c for schema, _, _, c in found if schema.name == "foxglove.PosesInFrame"]
    assert len(poses) == 60
    assert poses[-1]["poses"][0]["position"] == {"x": 30.0, "y": 29.0, "z": -31.0}
    stamp = poses[-1]["timestamp"]
    assert stamp["sec"] + 1e-9 * stamp["nsec"] == pytest.approx(EPOCH_UNIX_S + 29 * PERIOD_S)


def test_an_agent_never_heard_of_has_no_age() -> None:
    message = estimate_message(ready(1, np.zeros(12), np.ones(12), (0, MAX_AGE_TICKS)), 0.2, AGENTS, PERIOD_S)
    assert [agent.age_s for agent in message.agents.values()] == [0.0, None]


@given(st.lists(st.floats(-1e6, 1e6), min_size=12, max_size=12))
def test_what_is_read_is_what_was_estimated_bit_by_bit(values: list[float]) -> None:
    import msgspec

    mean, variance = np.array(values), np.abs(values) + 1e-9
    message = estimate_message(ready(7, mean, variance), 1 / 3, AGENTS, PERIOD_S)
    again = msgspec.json.decode(msgspec.json.encode(message), type=EstimateMessage)
    assert again == message
    assert np.array_equal(again.arrays()[0], mean)
    assert np.array_equal(again.arrays()[1], np.sqrt(variance))


def test_a_file_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LogFileError, match=r"record .*a\.mcap: cannot be written: "):
        EstimateMcap(tmp_path / "file" / "a.mcap", AGENTS, PERIOD_S, EPOCH_UNIX_S)
