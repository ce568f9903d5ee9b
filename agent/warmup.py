"""A few ticks of a make-believe fleet, so that compiled kernels are loaded before the first real tick.

Then whatever those ticks did not call is loaded as well: in flight nothing is read from the cache any more, which may
be gone by then, or the descriptors to open it with.
"""

from __future__ import annotations

import numpy as np

from agent.config.tables import FleetConfig
from agent.core import ESTIMATOR_FAULTS, EstimatorFactory
from estimators.compiled import entries as compiled
from estimators.model.layout import STATES_PER_AGENT, Layout, position
from estimators.model.measurements import RowTable, Vector, input_rows, position_rows, range_row, speed_row

TICKS = 3
SPACING_M = 10.0


def warm_up(config: FleetConfig, agent_id: int, make_estimator: EstimatorFactory) -> None:
    """Run an estimator like the one to come; loading its kernels takes from 0.5 s to several.

    What goes wrong here is left to the real one, which is watched and reported.
    """
    layout = config.layout
    slot = layout.slot(agent_id)
    mean = np.zeros(layout.dimension)
    for other in range(layout.size):
        mean[position(other)] = (SPACING_M * other, SPACING_M * (other % 2), -SPACING_M)
    covariance = np.eye(STATES_PER_AGENT * layout.size)
    try:
        estimator = make_estimator(config.estimator, layout, slot, mean, covariance, config.fleet.period_s)
        for tick in range(TICKS):
            estimator.begin(tick, _rows(tick, layout, mean), input_rows(tick - 1, slot, np.zeros(3), 0.1))
            for round_ in range(config.estimator.rounds):
                payload = estimator.outgoing(round_)
                others = [s for s in range(layout.size) if s != slot]
                estimator.mix(round_, dict.fromkeys(others[:1], payload))
            estimator.solve()
    except ESTIMATOR_FAULTS:
        pass
    compiled.warm_up()


def _rows(tick: int, layout: Layout, mean: Vector) -> RowTable:
    """Fixes and speeds of all agents and the ranges between neighbours in the order of the layout."""
    tables = []
    for slot in range(layout.size):
        tables.append(position_rows(tick, slot, mean[position(slot)], [0.1] * 3))
        tables.append(speed_row(tick, slot, 0.1, 0.1))
        if slot:
            tables.append(range_row(tick, slot - 1, slot, SPACING_M, 0.1))
    return np.concatenate(tables)
