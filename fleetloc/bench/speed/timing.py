"""Interleaved timing: every method gets the same windows in one run, in an order that changes all the time.

On a shared machine two runs differ by a factor of two, and a loop over one method measures it with caches
that it never finds in a real daemon. So the methods take turns, each solution is timed by itself, and only ratios
within one run are compared.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Clock = Callable[[], float]


@dataclass(frozen=True, slots=True)
class Method:
    """One way to do the step: ``calls[w]()`` does it on window w."""

    name: str
    calls: Sequence[Callable[[], Any]]
    elsewhere: Callable[[Any], float] | None = None
    """Where the work is done in another process: the CPU time in s that an answer says it took."""


@dataclass(slots=True)
class Timing:
    """``cpu_s``: one entry a timed call; ``answers``: what the last call on each window returned."""

    cpu_s: list[float] = field(default_factory=list)
    answers: list[Any] = field(default_factory=list)

    @property
    def median_s(self) -> float:
        """Median CPU time of a call."""
        return float(np.median(self.cpu_s))

    @property
    def p99_s(self) -> float:
        """99th percentile of the CPU time of a call."""
        return float(np.percentile(self.cpu_s, 99))


def time_interleaved(
    methods: Sequence[Method],
    repeats: int,
    limit_s: float,
    rng: np.random.Generator,
    clock: Clock = time.process_time,
) -> dict[str, Timing]:
    """CPU times of all methods, by name.

    Every method first does all windows once, untimed: that fills caches, compiles what is compiled and shows
    how long the method takes. It then takes part in up to ``repeats`` rounds over the windows, in fewer (at
    least one) where they would need more than ``limit_s`` of CPU time.
    """
    timings = {method.name: Timing() for method in methods}
    rounds: dict[str, int] = {}
    for method in methods:
        begun = clock()
        answers = [call() for call in method.calls]
        spent = clock() - begun if method.elsewhere is None else sum(map(method.elsewhere, answers))
        spent = max(spent, 1e-9)
        timings[method.name].answers = answers
        rounds[method.name] = max(1, min(repeats, int(limit_s / spent)))
    with collector_off():
        for round_ in range(max(rounds.values(), default=0)):
            playing = [method for method in methods if round_ < rounds[method.name]]
            for window in range(max(len(method.calls) for method in playing)):
                for turn in rng.permutation(len(playing)):
                    method = playing[turn]
                    call = method.calls[window]
                    begun = clock()
                    answer = call()
                    spent = clock() - begun if method.elsewhere is None else method.elsewhere(answer)
                    timings[method.name].cpu_s.append(spent)
                    timings[method.name].answers[window] = answer
    return timings


@contextmanager
def collector_off() -> Iterator[None]:
    """No garbage collection in a timed call; what is there is collected before."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
