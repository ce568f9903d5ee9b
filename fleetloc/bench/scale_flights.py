"""One flight of the study of large fleets: a random geometric graph of agents in virtual time, and what it costs.

What an agent computes is timed afterwards, by itself: the inputs of a few agents are kept, and each is given to a new
agent alone. In the flight all agents share one process, and with it what it remembers of bytes that it has decoded.
"""

from __future__ import annotations

import gc
import math
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.config.reading import config_from, with_other_table
from agent.config.tables import FleetConfig
from agent.fleet.membership import is_absent
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from estimators.model.layout import STATES_PER_AGENT
from sim_bridge.virtual.fleet_lockstep import FleetLockstep, Surroundings
from sim_bridge.world.sim_table import SimTable
from sim_bridge.world.truth import Truth
from transport.messages.far_body import FarReports
from transport.messages.measurement_body import forget_decoded
from transport.security.sealing import Message

Floats = NDArray[np.float64]

SPACING_M = 20.0
"""Side of the square that there is for each drone."""
ALTITUDE_M = (10.0, 30.0)
RADIUS_M, LAP_S = 5.0, 20.0
"""Every drone flies a circle."""
MAX_DRAWS = 10_000
"""Of places, until the graph is connected."""
REPEATS = 3
"""So often an agent is timed; the least counts."""
NEAR, FAR = "near", "far"


@dataclass(frozen=True, slots=True)
class ScaleFlight:
    """A flight to be flown: ``size`` drones on a graph drawn from ``seed``, joint states of ``joint_bodies`` at most.

    Figures are of what is after ``settle_s``; of ``timed`` agents the computing time is measured.
    """

    size: int
    seed: int
    joint_bodies: int
    duration_s: float
    settle_s: float
    degree: float
    timed: int


@dataclass(frozen=True, slots=True)
class ScaleFlown:
    """What came of it.

    Attributes
    ----------
    degree : links of a drone, mean
    cpu_s : CPU time per tick of the agents that were timed, each, all that an agent does
    step_s : of it, working on the tick: estimate, rounds, packets out
    bytes_per_s : that an agent puts on the air, near and far field, mean over agents
    largest_packet : bytes
    own_rmse_m, own_anees : own position, 3-D, over ticks and drones
    far_rmse_m, far_anees : positions of those beyond the joint state; NaN if there is none
    far_age_s : of what is told of them, mean and largest
    shown : share of the fleet of which an estimate speaks, mean
    joint : drones in a joint state, mean
    """

    degree: float
    cpu_s: Floats
    step_s: Floats
    bytes_per_s: dict[str, float]
    largest_packet: int
    own_rmse_m: float
    own_anees: float
    far_rmse_m: float
    far_anees: float
    far_age_s: tuple[float, float]
    shown: float
    joint: float


def places_and_edges(size: int, degree: float, seed: int) -> tuple[Floats, list[tuple[int, int]]]:
    """A random geometric graph: places ``(n, 3)`` NED m, and the pairs of ids that are nearest to each other.

    So many pairs that the mean degree is ``degree``, or all; drawn anew until the graph is connected.
    """
    rng = np.random.default_rng(seed)
    first, second = np.triu_indices(size, 1)
    count = min(round(degree * size / 2), len(first))
    for _ in range(MAX_DRAWS):
        plane = rng.uniform(0.0, SPACING_M * np.sqrt(size), (size, 2))
        places = np.column_stack((plane, -rng.uniform(*ALTITUDE_M, size)))
        apart = np.linalg.norm(places[first] - places[second], axis=1)
        nearest = np.argsort(apart, kind="stable")[:count]
        edges = [(int(first[k]) + 1, int(second[k]) + 1) for k in nearest]
        if _is_connected(size, edges):
            return places, edges
    raise ValueError(f"no connected graph of {size} drones with mean degree {degree:g} in {MAX_DRAWS} draws")


def _is_connected(size: int, edges: list[tuple[int, int]]) -> bool:
    linked: dict[int, set[int]] = {agent: set() for agent in range(1, size + 1)}
    for one, other in edges:
        linked[one].add(other)
        linked[other].add(one)
    reached, frontier = {1}, [1]
    while frontier:
        new = linked[frontier.pop()] - reached
        reached |= new
        frontier += new
    return len(reached) == size


def configured(flight: ScaleFlight) -> FleetConfig:
    """The configuration of a flight: the paper's noise, everybody with GPS, on a circle about its place."""
    places, edges = places_and_edges(flight.size, flight.degree, flight.seed)
    ids = range(1, flight.size + 1)
    document: dict[str, Any] = {
        "fleet": {
            "name": "scale",
            "origin": {"lat_deg": 0.0, "lon_deg": 0.0, "alt_m": 0.0},
            "edges": edges,
            "joint_bodies": flight.joint_bodies,
        },
        "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{14549 + i}", "system_id": min(i, 255)} for i in ids],
        "sensors": {
            "gps_position_half_width_m": 1.5,
            "gps_speed": "norm",
            "gps_speed_half_width_mps": 0.5,
            "uwb_bound_m": 0.5,
        },
        "security": {"mode": "unsigned"},
    }
    paths = [
        {"kind": "circle", "agent": i, "center_m": places[i - 1].tolist(), "radius_m": RADIUS_M,
         "lap_s": LAP_S, "phase_rad": float(i)}
        for i in ids
    ]  # fmt: skip
    sim = {"seed": flight.seed, "profile": "paper", "paths": paths}
    return with_other_table(config_from(document, "scale"), "sim", msgspec.convert(sim, SimTable))


Call = tuple[str, tuple[Any, ...], dict[str, Any]]
"""A method of an agent, and what it was called with."""


class _Listening(OnboardAgent):
    """An agent whose inputs are kept."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.calls: list[Call] = []
        super().__init__(*args, **kwargs)

    def on_sample(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("on_sample", args, kwargs))
        super().on_sample(*args, **kwargs)

    def on_uwb_frame(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("on_uwb_frame", args, kwargs))
        super().on_uwb_frame(*args, **kwargs)

    def on_packet(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("on_packet", args, kwargs))
        super().on_packet(*args, **kwargs)

    def advance(self, *args: Any, **kwargs: Any) -> list[Any]:
        self.calls.append(("advance", args, kwargs))
        return super().advance(*args, **kwargs)

    def keep_house(self, *args: Any, **kwargs: Any) -> list[Any]:
        self.calls.append(("keep_house", args, kwargs))
        return super().keep_house(*args, **kwargs)


class _Traffic:
    """Bytes that went on the air since a time, near and far field, and the largest packet."""

    def __init__(self) -> None:
        self.bytes: Counter[str] = Counter()
        self.largest = 0

    def on_sent(self, sender: int, message: Message, size_bytes: int) -> None:
        self.bytes[FAR if isinstance(message, FarReports) else NEAR] += size_bytes
        self.largest = max(self.largest, size_bytes)

    def on_heard(self, receiver: int, sent: Any) -> None:
        """Whoever hears it costs nobody more."""


@dataclass(frozen=True, slots=True)
class _Said:
    """What a drone said of a tick: of itself, and now and then of those beyond its joint state."""

    slot: int
    unix_s: float
    own_m: Floats
    own_m2: Floats
    joint: int
    shown: float
    far: tuple[NDArray[np.int64], Floats, Floats, Floats] | None
    """Slots, positions ``(F, 3)``, variances ``(F, 3)``, ages in s ``(F,)``."""


FAR_EVERY_TICKS = 10
"""So often is put down what is told of those beyond."""


def fly(flight: ScaleFlight) -> ScaleFlown:
    """Fly it; the same flight gives the same figures but for times."""
    config = configured(flight)
    timed = _typical(config, flight)
    agents: dict[int, _Listening] = {}
    notes: list[_Said] = []

    def make_agent(config: FleetConfig, agent_id: int, *args: Any, **kwargs: Any) -> OnboardAgent:
        if agent_id not in timed:
            return OnboardAgent(config, agent_id, *args, **kwargs)
        agents[agent_id] = _Listening(config, agent_id, *args, **kwargs)
        made[agent_id] = (args, kwargs)
        return agents[agent_id]

    made: dict[int, tuple[tuple[Any, ...], dict[str, Any]]] = {}
    traffic = _Traffic()
    lockstep = FleetLockstep(
        config,
        make_estimator,
        lambda agent, ready: notes.append(_note(config, agent, ready)),
        surroundings=Surroundings(make_agent=make_agent, tap=traffic),
    )
    settled_s = lockstep.queue.now_s + flight.settle_s
    lockstep.queue.at(settled_s, traffic.bytes.clear)
    report = lockstep.run(flight.duration_s)
    seconds = (flight.duration_s - flight.settle_s) * flight.size
    del lockstep
    gc.collect()
    gc.freeze()  # a daemon's process holds one agent: collections are not to look at the flight's hundred
    times = []
    for i in sorted(agents):
        args, kwargs = made[i]
        alone = [_timed(OnboardAgent(config, i, *args, **kwargs), agents[i].calls, settled_s) for _ in range(REPEATS)]
        times.append(min(alone))  # what else the machine does only adds to it
    gc.unfreeze()
    per_tick = config.fleet.period_s / (flight.duration_s - flight.settle_s)
    from_unix_s = report.start_unix_s + flight.settle_s
    return ScaleFlown(
        degree=2 * len(config.fleet.edges or ()) / flight.size,
        cpu_s=per_tick * np.array([whole for whole, _ in times]),
        step_s=per_tick * np.array([step for _, step in times]),
        bytes_per_s={which: traffic.bytes[which] / seconds for which in (NEAR, FAR)},
        largest_packet=traffic.largest,
        **_errors([note for note in notes if note.unix_s >= from_unix_s], report.truth),
    )


def _typical(config: FleetConfig, flight: ScaleFlight) -> frozenset[int]:
    """The agents that are timed: those whose number of neighbours is nearest to the mean."""
    mean = 2 * len(config.fleet.edges or ()) / flight.size
    by_degree = sorted(config.ids, key=lambda agent: abs(len(config.neighbours(agent)) - mean))
    return frozenset(by_degree[: flight.timed])


def _timed(agent: OnboardAgent, calls: list[Call], settled_s: float) -> tuple[float, float]:
    """CPU time, s, that an agent takes for its inputs from a host time on: in all, and in `advance` alone."""
    forget_decoded()
    step_ns, began_ns = 0, time.thread_time_ns()
    settled = False
    for method, args, kwargs in calls:
        if not settled and method == "advance" and args[0] >= settled_s:
            settled, step_ns, began_ns = True, 0, time.thread_time_ns()
        if method == "advance":
            before_ns = time.thread_time_ns()
            agent.advance(*args, **kwargs)
            step_ns += time.thread_time_ns() - before_ns
        else:
            getattr(agent, method)(*args, **kwargs)
    return 1e-9 * (time.thread_time_ns() - began_ns), 1e-9 * step_ns


def _note(config: FleetConfig, agent: OnboardAgent, ready: EstimateReady) -> _Said:
    estimate, present = ready.estimate, agent.core.fleet.present
    slot = config.ids.index(agent.agent_id)
    states = estimate.mean.reshape(-1, STATES_PER_AGENT)
    at = slice(STATES_PER_AGENT * slot, STATES_PER_AGENT * slot + 3)
    told = ~is_absent(estimate.age_ticks)
    far = None
    if estimate.tick % FAR_EVERY_TICKS == 0:
        inside = [config.ids.index(member) for member in present]
        beyond = told.copy()
        beyond[inside] = False
        slots = np.flatnonzero(beyond)
        variances = estimate.covariance.diagonal().reshape(-1, STATES_PER_AGENT)[slots, :3]
        age_s = np.asarray(estimate.age_ticks[slots] * config.fleet.period_s, np.float64)
        far = np.asarray(slots, np.int64), states[slots, :3].copy(), variances.copy(), age_s
    return _Said(
        slot,
        ready.t_s + config.fleet.epoch_unix_s,
        states[slot, :3].copy(),
        estimate.covariance[at, at].copy(),
        len(present),
        float(told.mean()),
        far,
    )


def _errors(notes: list[_Said], truth: Truth) -> dict[str, Any]:
    """The figures of what was said that are no costs."""
    notes = [note for note in notes if note.unix_s <= truth.time_unix_s[-1]]
    places = truth.at(np.array([note.unix_s for note in notes]))[:, :, :3]
    own = np.array([note.own_m - place[note.slot] for note, place in zip(notes, places, strict=True)])
    squares = [float(e @ np.linalg.solve(note.own_m2, e)) / 3.0 for e, note in zip(own, notes, strict=True)]
    square, claimed, ages = [], [], []
    for note, place in zip(notes, places, strict=True):
        if note.far is not None:
            slots, told_m, told_m2, age_s = note.far
            error = told_m - place[slots]
            square.append((error**2).sum(axis=1))
            claimed.append((error**2 / told_m2).mean(axis=1))
            ages.append(age_s)
    far = [np.concatenate(each) for each in (square, claimed, ages)]
    is_far = len(far[0]) > 0
    return {
        "own_rmse_m": float(np.sqrt((own**2).sum(axis=1).mean())),
        "own_anees": float(np.mean(squares)),
        "far_rmse_m": float(np.sqrt(far[0].mean())) if is_far else math.nan,
        "far_anees": float(far[1].mean()) if is_far else math.nan,
        "far_age_s": (float(far[2].mean()), float(far[2].max())) if is_far else (math.nan, math.nan),
        "shown": float(np.mean([note.shown for note in notes])),
        "joint": float(np.mean([note.joint for note in notes])),
    }
