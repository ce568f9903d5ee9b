"""What a notebook needs: estimate logs, flight logs and truth as arrays, and flights repeated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.log import estimate_log
from agent.log.estimate_mcap import EstimateMessage
from agent.log.flight_reader import FlightReader
from estimators.factory import make_estimator
from estimators.model.layout import STATES_PER_AGENT
from sim_bridge.replay import flight_log_replay
from sim_bridge.world.truth import Truth, load_truth

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EstimateLog:
    """The estimates of one drone of a whole fleet of n, K ticks; NED, m and m/s.

    Attributes
    ----------
    agent_id
        Whose estimates they are.
    agents
        Ids of the fleet, in the order of the axis n.
    period_s
        Length of a tick.
    epoch_unix_s
        Unix time of fleet time zero.
    tick, t_s, published_s
        ``(K,)`` number of the tick, fleet time of the estimate, and fleet time at which it was out.
    status
        ``(K,)``, see `Status`.
    on_time
        ``(K,)`` bool: out within one period of the tick's end.
    age_s
        ``(K, n)`` age of the newest measurement of each drone that is in the estimate; infinite: none yet.
    position_m, velocity_mps
        ``(K, n, 3)``.
    position_sigma_m, velocity_sigma_mps
        ``(K, n, 3)``, 1-sigma.
    """

    agent_id: int
    agents: tuple[int, ...]
    period_s: float
    epoch_unix_s: float
    tick: NDArray[np.int64]
    t_s: Floats
    published_s: Floats
    status: NDArray[np.int8]
    on_time: NDArray[np.bool_]
    age_s: Floats
    position_m: Floats
    velocity_mps: Floats
    position_sigma_m: Floats
    velocity_sigma_mps: Floats
    _entries: NDArray[np.void] = field(repr=False)

    def covariance(self, k: int) -> Floats:
        """Covariance ``(6n, 6n)`` of entry k; the state is position and velocity of each drone in turn."""
        return estimate_log.covariance_of(self._entries[k], len(self.agents))


def read_estimate_log(path: str | Path) -> EstimateLog:
    """Read ``agent_001.estimates``, also of a run that goes on or was killed; raises `LogFileError`."""
    header, entries = estimate_log.read_entries(Path(path))
    count, n = len(entries), len(header.agents)
    mean = entries["mean"].reshape(count, n, STATES_PER_AGENT)
    sigma = np.sqrt(estimate_log.variances_of(entries, n)).reshape(count, n, STATES_PER_AGENT)
    age_ticks = entries["age_ticks"].astype(float)
    age_ticks[age_ticks >= estimate_log.MAX_AGE_TICKS] = np.inf
    return EstimateLog(
        header.agent, header.agents, header.period_s, header.epoch_unix_s,
        entries["tick"], entries["t_s"], entries["published_s"], entries["status"], entries["on_time"],
        age_ticks * header.period_s,
        mean[..., :3], mean[..., 3:], sigma[..., :3], sigma[..., 3:], entries,
    )  # fmt: skip


def read_flight_estimates(path: str | Path) -> Iterator[EstimateMessage]:
    """The estimates in a flight log (``agent_001.mcap`` with its .tlog beside it), in their order.

    Each has ``tick``, ``t_s``, ``published_s``, ``status``, ``on_time``, ``agents`` by name (``agent_001``) and
    ``arrays()``, mean and 1-sigma ``(6n,)``. Raises `LogFileError`.
    """
    for entry in FlightReader(Path(path)):
        if isinstance(entry, EstimateMessage):
            yield entry


def read_truth(path: str | Path) -> Truth:
    """Read ``truth.npz`` of a simulated flight; raises `TruthError`."""
    return load_truth(Path(path))


def replay_flight_log(path: str | Path, config: FleetConfig | None = None) -> flight_log_replay.FlightLogReplay:
    """Repeat a flight log (``agent_001.mcap`` with its .tlog beside it) and compare with what was estimated.

    Without ``config`` it runs with the configuration it was flown with. Raises `LogFileError`.
    """
    (result,) = flight_log_replay.replay_flight_log([Path(path)], config, make_estimator)
    return result
