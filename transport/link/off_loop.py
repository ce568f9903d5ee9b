"""What may block, away from the event loop where there is a thread for it."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


async def off_loop(function: Callable[..., Result], *arguments: object) -> Result:
    """Call on a thread, or on the loop itself where the system has no more threads; ``function`` may be called twice.

    A pool that cannot start another thread has taken the work down all the same, and does it later if it has one.
    """
    try:
        working = asyncio.get_running_loop().run_in_executor(None, functools.partial(function, *arguments))
    except RuntimeError:
        return function(*arguments)
    return await working
