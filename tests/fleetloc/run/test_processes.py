"""Child processes: what they said last, and that none survives."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest

from fleetloc.errors import EnvironmentFault
from fleetloc.run.processes import Child, cpu_time_s, resident_mb, stop_all

PATIENCE_S = 20.0


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Makes every child run a shell script in place of the interpreter."""

    def make(body: str) -> None:
        path = tmp_path / "interpreter"
        path.write_text(f"#!/bin/sh\n{body}\n")
        path.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(path))

    return make


async def started(tmp_path: Path, name: str = "agent 1") -> Child:
    child = Child(name, ("agent", "x.toml"), tmp_path / f"{name}.log")
    await child.start()
    return child


async def says(child: Child, word: str) -> None:
    async def poll() -> None:
        while word not in child.last_lines():
            await asyncio.sleep(0.01)

    await asyncio.wait_for(poll(), PATIENCE_S)


async def test_why_it_ended_has_the_code_and_its_last_lines(script, tmp_path: Path) -> None:
    script("for i in 1 2 3 4 5 6 7; do echo line $i >&2; done; echo >&2; exit 4")
    child = await started(tmp_path)
    assert await asyncio.wait_for(child.wait(), PATIENCE_S) == 4
    assert child.why_it_ended() == "ended with exit code 4: line 3 | line 4 | line 5 | line 6 | line 7"
    assert not child.running


async def test_a_signal_is_named(script, tmp_path: Path) -> None:
    script("kill -9 $$")
    child = await started(tmp_path)
    await asyncio.wait_for(child.wait(), PATIENCE_S)
    assert child.why_it_ended() == "killed by SIGKILL"


async def test_arguments_name_the_package(script, tmp_path: Path) -> None:
    script('echo "$@" >&2')
    child = await started(tmp_path)
    await asyncio.wait_for(child.wait(), PATIENCE_S)
    assert child.last_lines() == ["-m fleetloc agent x.toml"]


async def test_stopping_asks_first_and_kills_the_stubborn_alone(script, tmp_path: Path) -> None:
    script('trap "echo bye >&2; exit 0" TERM; echo ready >&2; while :; do sleep 0.05; done')
    polite = await started(tmp_path, "polite")
    await says(polite, "ready")  # it has read its script, which is written anew now
    script('trap "" TERM; echo ready >&2; while :; do sleep 0.05; done')
    stubborn = await started(tmp_path, "stubborn")
    await says(stubborn, "ready")
    assert await stop_all((polite, stubborn), grace_s=1.0) == ["stubborn"]
    assert "bye" in polite.last_lines()
    assert stubborn.why_it_ended().startswith("killed by SIGKILL")
    assert await stop_all((polite, stubborn)) == []


async def test_what_cannot_be_started_is_the_machines_refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "nothing"))
    with pytest.raises(EnvironmentFault, match="agent 1: cannot be started: No such file"):
        await started(tmp_path)


def test_use_of_the_machine_is_read_from_the_system() -> None:
    used_s = cpu_time_s(os.getpid())
    assert used_s is not None
    assert used_s == pytest.approx(sum(os.times()[:2]), abs=0.1)
    resident = resident_mb(os.getpid())
    assert resident is not None
    assert 10 < resident < 10_000
    assert cpu_time_s(2**22 + 1) is None
    assert resident_mb(2**22 + 1) is None
