"""``--drop-gps`` and ``--autopilot-gps`` of a live run: without GPS for a while, spelled as in a replay."""

from __future__ import annotations

from collections.abc import Collection

from fleetloc.errors import InputError
from sim_bridge.replay.what_if import OPTION, GpsDrop
from sim_bridge.world.sim_table import GpsOutage

FOR_EVER_S = 1e9


def gps_outage(
    text: str, ids: Collection[int], duration_s: float | None, option: str = OPTION
) -> GpsOutage:
    """The outage that an option describes; raises `InputError` or `ReplayError`.

    Times in s from the begin, negative from the end, which then has to be known (``duration_s``).
    """
    drop = GpsDrop.parsed(text)
    if drop.agent_id not in ids:
        raise InputError(option, "", f"one of the ids {', '.join(map(str, ids))}", str(drop.agent_id))
    window = drop.window
    if duration_s is None and min(window.from_s or 0.0, window.to_s or 0.0) < 0.0:
        raise InputError(option, "", "--duration for times from the end", repr(text))
    from_s, to_s = window.resolved(0.0, FOR_EVER_S if duration_s is None else duration_s)
    from_s, to_s = max(from_s, 0.0), min(to_s, FOR_EVER_S)
    if not from_s < to_s:
        raise InputError(option, "", "FROM before TO", repr(text))
    return GpsOutage(agent=drop.agent_id, from_s=from_s, to_s=to_s)
