"""The genie: what an agent could know of the fleet at best over the packets of records that reached it.

At every tick the genie of an agent holds all records (rows and tick-averaged accelerations, of all agents) that
could have reached it by then: every packet of records that arrived carried all that its sender held, of any age
and size, and was passed on over any number of hops (`sim_bridge.studies.flown.KnowledgeTap` follows that). On
exactly these it solves the full-information problem: all ticks since the start, the agent's own first estimate
as prior, every norm row linearised at the optimum (Gauss-Newton as iterated Kalman smoothing). What stands for
accelerations that have not arrived is the same as in the estimator it is compared with.

It is a reference, not an estimator: its packets have no bound and its work grows with the flight. An estimator with
the same model of unknown accelerations can only be luckier than it, not better on average; a better model of
them would lower the genie too. Starting points of other agents are no records, nor are the information pairs of the
consensus rounds: in the first ticks an estimator that fuses its neighbours' priors may know more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.model.measurements import InputTable, RowTable, empty_inputs, empty_rows
from estimators.settings import EstimatorSettings
from sim_bridge.studies.full_information import FullInformationSmoother
from sim_bridge.studies.lockstep import LockstepResult, StudyEstimates, own_input, own_rows
from sim_bridge.studies.study_input import StudyInput

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Genie:
    """Stands among the settings of a study's methods; ``settings`` are those of the estimator it bounds."""

    settings: EstimatorSettings

    def run(
        self, recording: StudyInput, heard: Bools, progress: Callable[[int], None] | None = None
    ) -> LockstepResult:
        """The genie of every agent; the same result as of an estimator's run.

        ``heard`` ``(T+1, n, T+1, n)``: by the estimate of a tick, an agent has the records of which tick and owner;
        those of a tick hold the acceleration from it to the next.
        """
        n = len(recording.agents)
        fleet = [FullInformationSmoother(recording, self.settings, slot) for slot in range(n)]
        record = StudyEstimates(recording, centralised=False)
        had = np.zeros(heard.shape[1:], np.bool_)
        pushed = np.zeros_like(had)
        for tick, now in enumerate(heard):
            fresh, had = now & ~had, had | now
            past = had.copy()
            past[:, tick:] = False  # an acceleration acts until the tick after
            for slot, smoother in enumerate(fleet):
                rows = _rows(recording, fresh[slot])
                inputs = _inputs(recording, past[slot] & ~pushed[slot])
                record.add(tick, slot, smoother.step(tick, rows, inputs))
            pushed |= past
            if progress is not None:
                progress(tick)
        return record.result([0] * n)


def _rows(recording: StudyInput, which: Bools) -> RowTable:
    """The rows of some (tick, owner)."""
    tables = [own_rows(recording, int(tick), int(owner)) for tick, owner in np.argwhere(which)]
    return np.concatenate([empty_rows(), *tables])


def _inputs(recording: StudyInput, which: Bools) -> InputTable:
    """The accelerations from some ticks to the next, of some owners."""
    tables = [own_input(recording, int(tick) + 1, int(owner)) for tick, owner in np.argwhere(which)]
    return np.concatenate([empty_inputs(), *tables])
