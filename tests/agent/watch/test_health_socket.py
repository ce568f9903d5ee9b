"""A daemon's health socket: what it answers, and what is said where nobody does."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from agent.errors import LinkError
from agent.watch.health import Health, State
from agent.watch.health_query import ask
from agent.watch.health_socket import HealthSocket
from agent.watch.observers import DaemonState


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


async def test_a_socket_that_another_daemon_serves_is_left_to_it(tmp_path: Path) -> None:
    # GIVEN a daemon's socket
    path = tmp_path / "health.sock"
    first, second = HealthSocket(path), HealthSocket(path)
    await first.open()
    # WHEN another daemon is configured to the same THEN it says so, and its end does not touch the first's
    with pytest.raises(LinkError, match=rf"health socket {path}: another daemon listens there"):
        await second.open()
    await second.close(state_of(State.INIT))
    assert (await answer_of(first, path))["state"] == "init"
    await first.close(state_of(State.OK))
    assert not path.exists()


async def test_only_ones_own_socket_is_removed(tmp_path: Path) -> None:
    # GIVEN a socket that was removed under its daemon, and one that another daemon made in its place
    path = tmp_path / "health.sock"
    first, second = HealthSocket(path), HealthSocket(path)
    await first.open()
    path.unlink()
    await second.open()
    # WHEN the first ends THEN the second goes on
    await first.close(state_of(State.OK))
    assert (await answer_of(second, path))["state"] == "init"
    path.unlink()
    await second.close(state_of(State.OK))  # nothing left to remove


async def test_a_path_that_is_too_long_for_a_socket_is_named(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"health socket .*: cannot be opened: .*too long"):
        await HealthSocket(tmp_path / ("x" * 120)).open()


async def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "health.sock"
    with pytest.raises(LinkError, match=r"health socket .*nowhere.*: cannot be opened"):
        await HealthSocket(path).open()


def test_nobody_there_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"health socket .*: no answer: No such file or directory"):
        ask(tmp_path / "health.sock", 1.0)
