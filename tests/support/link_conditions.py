"""Recordings whose packets are lost or late, for estimators that run tick by tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim_bridge.studies.study_input import StudyInput


def with_loss(recording: StudyInput, probability: float, rng: np.random.Generator) -> StudyInput:
    """Every packet of every directed link is lost independently with ``probability`` (Bernoulli)."""
    kept = rng.random(recording.received.shape) >= probability
    return replace(recording, received=recording.received & kept)


def with_delay(
    recording: StudyInput, ticks: int, spread_ticks: int = 0, rng: np.random.Generator | None = None
) -> StudyInput:
    """Every packet comes ``ticks`` late, or uniformly up to ``spread_ticks`` later still (which reorders them)."""
    shape = recording.delay_ticks.shape
    more = rng.integers(0, spread_ticks + 1, shape) if rng is not None and spread_ticks else np.zeros(shape, np.int64)
    return replace(recording, delay_ticks=recording.delay_ticks + ticks + more)


def with_partition(
    recording: StudyInput, island: Sequence[int], first: int, last: int, *, ranges: bool = False
) -> StudyInput:
    """No packet crosses between the slots of ``island`` and the others in ticks first..last-1.

    With ``ranges`` no range is measured between them either (a hill instead of a jammed channel).
    """
    inside = np.zeros(len(recording.agents), bool)
    inside[list(island)] = True
    same = inside[:, None] == inside[None, :]
    received, measured = recording.received.copy(), recording.ranges.copy()
    received[first:last] &= same
    if ranges:
        measured[first:last, ~same] = np.nan
    return replace(recording, received=received, ranges=measured)


def with_one_way(recording: StudyInput, receiver: int, sender: int) -> StudyInput:
    """Nothing that ``sender`` sends reaches ``receiver``; the other direction is as before."""
    received = recording.received.copy()
    received[:, receiver, sender] = False
    return replace(recording, received=received)
