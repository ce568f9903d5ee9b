"""Whole fleets as users start them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.fleet_process import FleetProcess, on_free_ports, with_overrides


@pytest.fixture
def start_fleet(tmp_path: Path) -> Iterator[Callable[..., FleetProcess]]:
    """Starts line3 on free ports, with more arguments; nothing of it outlives the test."""
    started: list[FleetProcess] = []

    def start(*arguments: str) -> FleetProcess:
        out = tmp_path / f"run{len(started)}"
        started.append(FleetProcess(out, *with_overrides(on_free_ports(3)), *arguments))
        return started[-1]

    yield start
    for fleet in started:
        fleet.clean_up()
