"""Repeats the runs of agents from their flight records: the same inputs, at the same instants, in the same order.

The recorded inputs drive `agent.onboard.OnboardAgent`, as the daemon did, so a replay with the recorded
configuration gives the recorded estimates, bit by bit where software and processor are the same. Another
configuration answers what the agent would have estimated with it from what it received.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from agent.config.reading import recorded_config as config_in_log
from agent.config.tables import FleetConfig
from agent.core import EstimatorFactory
from agent.errors import AgentError, LogFileError
from agent.log.estimate_mcap import EstimateMessage, estimate_message
from agent.log.flight_format import CLOSED, FlightStart, trust_from
from agent.log.flight_reader import FlightReader, RecordedInput
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from transport.security.auth import Identity

TOLERANCE = 1e-9
"""Differences of a mean or sigma up to this (m, m/s) are rounding."""
MAX_UNPAIRED = 64
"""With another configuration an estimate may come earlier or later than the recorded one, by fewer than this."""


@dataclass(frozen=True, slots=True)
class ReplayedTick:
    """An estimate made again, and the one that was recorded; ``None`` where there is only the other.

    ``published_s``: fleet time at which the agent had it, as far as the inputs tell; ``inputs`` had come in by then.
    """

    ready: EstimateReady | None
    recorded: EstimateMessage | None
    published_s: float
    inputs: int


OnTick = Callable[[int, ReplayedTick], None]
"""(agent, tick)."""


@dataclass(slots=True)
class FlightLogReplay:
    """How the replay of one record went.

    ``max_mean_difference`` and ``max_sigma_difference`` between estimates of the same tick, in m and m/s.
    """

    path: Path
    agent_id: int
    config: FleetConfig
    ended: str = ""
    """`agent.log.flight_format.CLOSED`, why the record ended early, or that it is cut off."""
    inputs: int = 0
    ticks: int = 0
    """Estimates made again."""
    compared: int = 0
    """Of them, those that a recorded one was there for."""
    only_recorded: int = 0
    """Recorded estimates that were not made again."""
    different: int = 0
    """Compared estimates that differ in any bit of mean or sigma, or are contradicted."""
    contradicted: int = 0
    """Compared estimates whose status, agents or ages differ: no rounding does that."""
    max_mean_difference: float = 0.0
    max_sigma_difference: float = 0.0
    counters: dict[str, int] = field(default_factory=dict)
    """The core's, at the end."""

    @property
    def complete(self) -> bool:
        """Whether the record holds the run to its end."""
        return self.ended == CLOSED

    @property
    def equal(self) -> bool:
        """Whether every recorded estimate was made again: its status and ages, mean and sigma to within rounding."""
        difference = max(self.max_mean_difference, self.max_sigma_difference)
        complete = self.compared > 0 and not self.only_recorded
        return complete and not self.contradicted and difference <= TOLERANCE


def replay_flight_log(
    paths: Sequence[Path],
    config: FleetConfig | None,
    make_estimator: EstimatorFactory,
    on_tick: OnTick | None = None,
) -> list[FlightLogReplay]:
    """Repeat the runs in flight records (.mcap, each with its .tlog beside it), one after the other.

    Without ``config`` each runs with the configuration it was flown with. Estimates go to ``on_tick`` as they are
    made; nothing is kept of them. Raises `LogFileError` for a file that is no flight record or has no .tlog.
    """
    return [_replay_one(path, config, make_estimator, on_tick) for path in paths]


def recorded_config(start: FlightStart, path: Path) -> FleetConfig:
    """The configuration that a record was flown with; raises `LogFileError`."""
    try:
        return config_in_log(start.config, "configuration", start.software)
    except AgentError as error:
        raise LogFileError(f"record {path}: its configuration cannot be used: {error}") from error


def _replay_one(
    path: Path, config: FleetConfig | None, make_estimator: EstimatorFactory, on_tick: OnTick | None
) -> FlightLogReplay:
    reader = FlightReader(path)
    used = recorded_config(reader.start, path) if config is None else config
    onboard = agent_of(reader, used, make_estimator)
    result = FlightLogReplay(path, onboard.agent_id, used)
    pairing = _Pairing(result, on_tick)
    for entry in reader:
        if isinstance(entry, RecordedInput):
            result.inputs = entry.number
            for output in onboard.take(entry.event):
                if isinstance(output, EstimateReady):
                    pairing.on_made(ReplayedTick(output, None, onboard.fleet_s(entry.event.host_s), entry.number))
        else:
            pairing.on_recorded(entry)
    pairing.end()
    result.ended = reader.ended
    result.counters = dict(onboard.core.counters)
    return result


def agent_of(reader: FlightReader, config: FleetConfig, make_estimator: EstimatorFactory) -> OnboardAgent:
    """The agent of a flight log, about to take its first input; raises `LogFileError` for one of another fleet."""
    start = reader.start
    if start.agent not in config.ids:
        expected = ", ".join(map(str, config.ids))
        raise LogFileError(f"record {reader.path}: of agent {start.agent}, expected one of {expected}")
    return OnboardAgent(
        config,
        start.agent,
        make_estimator,
        Identity(trust=trust_from(start.trust)),
        unix_s=start.unix_s,
        host_s=start.host_s,
        recorded=True,
    )


class _Pairing:
    """Brings estimates made again and recorded ones of the same tick together, in the order of their making."""

    def __init__(self, result: FlightLogReplay, on_tick: OnTick | None) -> None:
        self._result = result
        self._on_tick = on_tick
        self._made: deque[ReplayedTick] = deque()
        self._recorded: deque[EstimateMessage] = deque()

    def on_made(self, made: ReplayedTick) -> None:
        assert made.ready is not None
        self._result.ticks += 1
        self._made.append(made)
        self._pair()

    def on_recorded(self, recorded: EstimateMessage) -> None:
        self._recorded.append(recorded)
        self._pair()

    def end(self) -> None:
        """Nothing more comes: what has no counterpart goes out alone."""
        self._give_out_alone(len(self._made), len(self._recorded))

    def _pair(self) -> None:
        ticks = [recorded.tick for recorded in self._recorded]
        for place, made in enumerate(self._made):
            assert made.ready is not None
            if made.ready.estimate.tick in ticks:
                self._give_out_alone(place, ticks.index(made.ready.estimate.tick))
                self._give_out_pair(self._made.popleft(), self._recorded.popleft())
                return
        self._give_out_alone(len(self._made) - MAX_UNPAIRED, len(self._recorded) - MAX_UNPAIRED)

    def _give_out_alone(self, made: int, recorded: int) -> None:
        for _ in range(made):
            self._give_out(self._made.popleft())
        for _ in range(recorded):
            alone = self._recorded.popleft()
            self._result.only_recorded += 1
            self._give_out(ReplayedTick(None, alone, alone.published_s, alone.inputs or 0))

    def _give_out_pair(self, made: ReplayedTick, recorded: EstimateMessage) -> None:
        assert made.ready is not None
        result, config = self._result, self._result.config
        again = estimate_message(made.ready, made.published_s, config.bodies, config.fleet.period_s)
        result.compared += 1
        if tuple(again.agents) == tuple(recorded.agents):
            (mean, sigma), (was_mean, was_sigma) = again.arrays(), recorded.arrays()
            result.max_mean_difference = max(result.max_mean_difference, float(np.abs(mean - was_mean).max()))
            result.max_sigma_difference = max(result.max_sigma_difference, float(np.abs(sigma - was_sigma).max()))
        result.contradicted += _told(again) != _told(recorded)
        result.different += (again.agents, again.status) != (recorded.agents, recorded.status)
        self._give_out(replace(made, recorded=recorded))

    def _give_out(self, tick: ReplayedTick) -> None:
        if self._on_tick is not None:
            self._on_tick(self._result.agent_id, tick)


def _told(message: EstimateMessage) -> tuple[int, dict[str, float | None]]:
    """What an estimate says beside its numbers: its status, and the age of the data behind each agent."""
    return message.status, {agent: seen.age_s for agent, seen in message.agents.items()}
