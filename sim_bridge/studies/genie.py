"""The genie: what an agent could know of the fleet at best over the links as they were.

At every tick the genie of an agent holds all records (rows and tick-averaged accelerations, of all agents) that
could have reached it by then: every packet that arrived carried all that its sender held, of any age and size, and
was passed on over any number of hops, as many per tick as the estimators exchange packets, each late by its link's
delay. On exactly these it solves the full-information problem: all ticks since the start, the agent's own first
estimate as prior, every norm row linearised at the optimum (Gauss-Newton as iterated Kalman smoothing). What
stands for accelerations that have not arrived is the same as in the estimator it is compared with.

It is a reference, not an estimator: packets have no bound and its work grows with the flight. An estimator with
the same model of unknown accelerations can only be luckier than it, not better on average; a better model of
them would lower the genie too. Starting points of other agents are no records: in the first ticks an estimator
that fuses its neighbours' priors may know more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.settings import EstimatorSettings
from sim_bridge.studies.full_information import FullInformationSmoother
from sim_bridge.studies.lockstep import LockstepResult, RunRecord, records_of
from sim_bridge.studies.recording import Recording
from sim_bridge.studies.relay import adjacency


@dataclass(frozen=True, slots=True)
class Genie:
    """Stands among the settings of a study's methods; ``settings`` are those of the estimator it bounds."""

    settings: EstimatorSettings

    def run(self, recording: Recording, progress: Callable[[int], None] | None = None) -> LockstepResult:
        """The genie of every agent over a recording; the same result as from an estimator's lockstep run."""
        slots = range(len(recording.agents))
        fleet = [FullInformationSmoother(recording, self.settings, slot) for slot in slots]
        record = RunRecord(recording, centralised=False)
        for tick, fresh in enumerate(arrivals(recording, max(1, self.settings.rounds))):
            for slot, smoother in enumerate(fleet):
                pairs = [(int(when), int(whose)) for when, whose in np.argwhere(fresh[slot])]
                record.add(tick, slot, smoother.step(tick, *records_of(recording, pairs)))
            if progress is not None:
                progress(tick)
        return record.result([0] * len(fleet))


def arrivals(recording: Recording, exchanges: int) -> Iterator[NDArray[np.bool_]]:
    """For each tick what becomes known in it: ``(n, T+1, n)`` bool, of receiver, tick and owner of the records.

    ``exchanges`` packets follow each other on every link in a tick.
    """
    ticks, n = recording.ticks + 1, len(recording.agents)
    reached = recording.received & adjacency(recording)
    known = np.zeros((n, ticks, n), bool)
    under_way: dict[int, list[tuple[int, NDArray[np.bool_]]]] = {}
    for tick in range(ticks):
        before = known.copy()
        known[np.arange(n), tick, np.arange(n)] = True
        for receiver, packet in under_way.pop(tick, []):
            known[receiver] |= packet
        for _ in range(exchanges):
            sent = known.copy()
            for receiver, sender in np.argwhere(reached[tick]).tolist():
                late = int(recording.delay_ticks[tick, receiver, sender])
                if late:
                    under_way.setdefault(tick + late, []).append((receiver, sent[sender]))
                else:
                    known[receiver] |= sent[sender]
        yield known & ~before
