"""Processes beside this one for work that does not depend on it: copies of this process that end with their work."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.context import ForkContext

Killed = BrokenProcessPool
"""A copy was killed, by the system for want of memory or by somebody."""
CONTEXT: ForkContext = multiprocessing.get_context("fork")


def may_fork() -> bool:
    """Whether a copy of this process can work: a second processor, and no thread that could hold a lock."""
    return sys.platform == "linux" and (os.cpu_count() or 1) > 1 and threading.active_count() == 1


@contextmanager
def forking() -> Iterator[None]:
    """Without the warning of native threads (Python >= 3.12): those of BLAS are made for it, no copy uses them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def ignore_interrupts() -> None:
    """In a copy: the process that waits for it ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def workers(tasks: int) -> Iterator[ProcessPoolExecutor]:
    """As many copies as there are tasks or processors; where one is killed, `Killed` is raised.

    Whatever is raised within ends them at once.
    """
    count = min(tasks, os.cpu_count() or 1)
    with forking(), ProcessPoolExecutor(count, CONTEXT, initializer=ignore_interrupts) as pool:
        before = set(multiprocessing.active_children())
        try:
            yield pool
        except BaseException:
            copies = set(multiprocessing.active_children()) - before
            for process in copies:
                process.terminate()
            pool.shutdown(cancel_futures=True)
            for process in copies:
                process.join()
            raise
