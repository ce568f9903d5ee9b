"""Who could know whose records of a study input, had every packet that reaches anybody carried all that was known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_bridge.studies.relay import adjacency
from sim_bridge.studies.study_input import StudyInput


def heard_of(recording: StudyInput, exchanges: int) -> NDArray[np.bool_]:
    """By the estimate of each tick ``(T+1, n, T+1, n)``: of receiver, tick and owner of the records.

    ``exchanges`` packets follow each other on every link in a tick; links are as the input says.
    """
    ticks, n = recording.ticks + 1, len(recording.agents)
    reached = recording.received & adjacency(recording)
    known = np.zeros((n, ticks, n), bool)
    heard = np.zeros((ticks, n, ticks, n), bool)
    under_way: dict[int, list[tuple[int, NDArray[np.bool_]]]] = {}
    for tick in range(ticks):
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
        heard[tick] = known
    return heard
