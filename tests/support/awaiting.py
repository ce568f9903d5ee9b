"""Waiting for what a daemon or a radio does on the test's own event loop: for the event, not for a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

PATIENCE_S = 30.0
POLL_S = 0.01


async def until(condition: Callable[[], bool], what: str) -> None:
    """Return when a condition holds; the test fails where it does not come, and says what was waited for."""

    async def poll() -> None:
        while not condition():
            await asyncio.sleep(POLL_S)

    try:
        await asyncio.wait_for(poll(), PATIENCE_S)
    except TimeoutError:
        pytest.fail(f"in {PATIENCE_S:g} s not seen: {what}")
