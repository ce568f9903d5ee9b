"""A daemon's health socket: what it answers, and what is said where nobody does."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from agent.errors import LinkError
from agent.health import Health, State
from agent.health_query import ask
from agent.health_socket import HealthSocket
from agent.observers import DaemonState


def state_of(state: State, *reasons: str) -> DaemonState:
    return DaemonState(7, 12.5, Health(state, reasons), {"ticks": 3}, {"cpu_fraction": 0.1}, {})


async def answer_of(observer: HealthSocket, path: Path) -> dict[str, object]:
    return await asyncio.to_thread(ask, path, 5.0)


async def test_the_answer_is_the_state_of_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "health.sock"
    observer = HealthSocket(path)
    await observer.open()
    assert (await answer_of(observer, path))["state"] == "init"
    observer.on_second(state_of(State.DEGRADED, "gps lost"))
    answer = await answer_of(observer, path)
    assert (answer["agent"], answer["state"], answer["reasons"]) == (7, "degraded", ["gps lost"])
    assert answer["counters"] == {"ticks": 3}
    await observer.close(state_of(State.OK))
    assert not path.exists()


async def test_a_socket_left_by_a_killed_daemon_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "health.sock"
    killed = HealthSocket(path)
    await killed.open()
    assert killed._server is not None
    killed._server.close()  # as the system does: the file stays
    successor = HealthSocket(path)
    await successor.open()
    assert (await answer_of(successor, path))["state"] == "init"
    await successor.close(state_of(State.OK))


async def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "health.sock"
    with pytest.raises(LinkError, match=r"health socket .*nowhere.*: cannot be opened"):
        await HealthSocket(path).open()


def test_nobody_there_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"health socket .*: no answer: No such file or directory"):
        ask(tmp_path / "health.sock", 1.0)
