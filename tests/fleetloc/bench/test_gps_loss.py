"""A drone that loses GPS flies on with a tilted attitude, held by ranges: what it and the others say stays honest."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from fleetloc.bench.fault_flights import Flight, fly
from fleetloc.whole_config import load_whole
from sim_bridge.faults.fault_tables import FaultTable

LINE = Path(__file__).parents[3] / "configs" / "line3.toml"
BLIND = (2,)
FROM_S, TO_S, END_S = 15.0, 65.0, 72.0


def test_a_drone_that_two_located_ones_hold_knows_how_much_it_does_not_know() -> None:
    # GIVEN a fleet whose middle drone loses GPS for a while: it may turn about the axis of the two others
    lost = {"kind": "gps_off", "agents": BLIND, "from_s": FROM_S, "to_s": TO_S}
    faults = tuple(msgspec.convert([lost], list[FaultTable]))
    config = load_whole(LINE)
    flown = fly(Flight(config, 0, faults, END_S))
    ticks = len(flown.error_m)
    t_s = np.arange(ticks) * config.fleet.period_s
    hit = [config.ids.index(agent) for agent in BLIND]
    since, during = t_s >= FROM_S, (t_s >= FROM_S) & (t_s < TO_S)
    # THEN no error is beyond three sigma but by chance, and none beyond five where nothing is flagged
    sigmas = flown.error_m[since] / flown.sigma_m[since]
    assert np.nanpercentile(sigmas, 99) < 3.0
    assert not ((sigmas > 5.0) & ~flown.flagged[since]).any()
    # and the drone that does not know where it is says neither too little nor too much
    assert np.sqrt(np.nanmean(flown.error_m[during][:, hit] ** 2)) > 0.5
    assert np.nanpercentile(flown.error_m[during][:, hit] / flown.sigma_m[during][:, hit], 99) > 0.5
    for nees in (flown.nees[during][:, hit], flown.nees_fleet[during]):
        assert 0.1 < np.nanmean(nees) < 2.5
    # and the first fix is believed: five seconds later all is as it was
    back = t_s >= TO_S + 5.0
    assert np.nanmax(flown.error_m[back]) < 4.0 * np.nanmax(flown.error_m[(t_s > 8.0) & (t_s < FROM_S)])
