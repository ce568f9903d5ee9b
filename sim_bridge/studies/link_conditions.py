"""Link conditions of the studies: which packets of a recording are lost or late."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from sim_bridge.studies.recording import Recording

FU_ON_TIME, FU_LATE = 0.4, 0.3
"""Channel of Fu, Bi and Gao: on time, one tick late, else lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DoubledRecording(Recording):
    """A recording some of whose packets arrive a second time.

    ``doubled`` ``(T+1, n, n)`` bool, as ``received``: a tick after its first copy there comes another one.
    """

    doubled: NDArray[np.bool_]


def with_duplicates(recording: Recording, probability: float, rng: np.random.Generator) -> DoubledRecording:
    """Every packet that arrives does so twice with ``probability``."""
    given = {field.name: getattr(recording, field.name) for field in fields(Recording)}
    return DoubledRecording(**given, doubled=rng.random(recording.received.shape) < probability)


def with_loss(recording: Recording, probability: float, rng: np.random.Generator) -> Recording:
    """Every packet of every directed link is lost independently with ``probability`` (Bernoulli)."""
    kept = rng.random(recording.received.shape) >= probability
    return replace(recording, received=recording.received & kept)


def with_bursts(
    recording: Recording, loss: float, mean_burst_ticks: float, rng: np.random.Generator
) -> Recording:
    """Gilbert-Elliott: links alternate between good and bad; all packets of a bad tick are lost.

    ``loss`` is the long-run share of bad ticks, below 1, ``mean_burst_ticks`` (at least 1) their mean run.
    """
    leave_bad = 1.0 / mean_burst_ticks
    enter_bad = min(1.0, leave_bad * loss / (1.0 - loss))
    bad = rng.random(recording.received.shape[1:]) < loss
    kept = np.empty_like(recording.received)
    for tick in range(len(kept)):
        kept[tick] = ~bad
        bad = np.where(bad, rng.random(bad.shape) >= leave_bad, rng.random(bad.shape) < enter_bad)
    return replace(recording, received=recording.received & kept)


def with_delay(
    recording: Recording, ticks: int, spread_ticks: int = 0, rng: np.random.Generator | None = None
) -> Recording:
    """Every packet comes ``ticks`` late, or uniformly up to ``spread_ticks`` later still (which reorders them)."""
    shape = recording.delay_ticks.shape
    more = rng.integers(0, spread_ticks + 1, shape) if rng is not None and spread_ticks else np.zeros(shape, np.int64)
    return replace(recording, delay_ticks=recording.delay_ticks + ticks + more)


def with_fu_channel(recording: Recording, rng: np.random.Generator) -> Recording:
    """On time with 0.4, one tick late with 0.3, lost with 0.3 (Fu, Bi, Gao: the channel of their examples)."""
    draw = rng.random(recording.received.shape)
    late = ((draw >= FU_ON_TIME) & (draw < FU_ON_TIME + FU_LATE)).astype(np.int64)
    return replace(
        recording,
        received=recording.received & (draw < FU_ON_TIME + FU_LATE),
        delay_ticks=recording.delay_ticks + late,
    )


def with_partition(
    recording: Recording, island: Sequence[int], first: int, last: int, *, ranges: bool = False
) -> Recording:
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


def with_one_way(recording: Recording, receiver: int, sender: int) -> Recording:
    """Nothing that ``sender`` sends reaches ``receiver``; the other direction is as before."""
    received = recording.received.copy()
    received[:, receiver, sender] = False
    return replace(recording, received=received)
