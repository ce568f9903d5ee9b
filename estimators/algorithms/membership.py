"""A fleet that changes: states joined and removed, and information pairs of agents that see another fleet.

Removal is marginalisation: in moment form the rows and columns of an agent are dropped, in information form its
block is eliminated (Schur complement), so that the estimates of the others stay what they were. A new agent gets
an independent block with a wide prior, which says nothing of the others either.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from estimators.algorithms.dekf_ci import DistributedEkf
from estimators.algorithms.moving_horizon import MovingHorizonEstimator
from estimators.algorithms.relay_mhe import RelayMovingHorizonEstimator
from estimators.estimator import Payload, symmetrised
from estimators.integrity.witness import Witness
from estimators.model.layout import STATES_PER_AGENT, Layout, block
from estimators.model.measurements import Matrix, RowTable, Vector
from estimators.model.motion import input_matrix, transition_matrix
from estimators.model.row_kernels import IntArray
from estimators.window.history import MeasurementWindow

Pair = tuple[Matrix, Vector]
"""Information matrix ``(6n, 6n)`` and vector ``(6n,)``."""
Prior = tuple[Vector, Matrix]
"""Mean ``(6,)`` and covariance ``(6, 6)`` of one agent, NED m and m/s."""
Changeable = MovingHorizonEstimator | DistributedEkf
"""Estimators whose fleet can change; the centralised filter is a yardstick of fixed fleets."""
E = TypeVar("E", MovingHorizonEstimator, DistributedEkf)

MANOEUVRE_S = 3.0
"""How long an acceleration that is not known lasts."""
FLAT_INFORMATION = 1e-8
"""What stands for no information (1/m2, s2/m2) where a pair must stay definite: a sigma of 10 km."""


def states_of(slots: Sequence[int]) -> IntArray:
    """Indices ``(6 len(slots),)`` of the states of some slots, in their order."""
    firsts = STATES_PER_AGENT * np.asarray(slots, np.int64)
    return np.asarray((firsts[:, None] + np.arange(STATES_PER_AGENT)).ravel(), np.int64)


def marginal_pair(pair: Pair, slots: Sequence[int]) -> Pair:
    """The information pair of some slots alone, the others eliminated.

    With the kept states K and the others O: ``I_KK - I_KO I_OO^-1 I_OK`` and ``i_K - I_KO I_OO^-1 i_O``. Raises
    ``numpy.linalg.LinAlgError`` where ``I_OO`` is singular.
    """
    information, vector = pair
    kept = states_of(slots)
    others = np.setdiff1d(np.arange(len(vector)), kept)
    marginal, right = information[np.ix_(kept, kept)], vector[kept]
    if len(others):
        cross = information[np.ix_(kept, others)]
        columns = np.column_stack((cross.T, vector[others]))
        solved = np.linalg.solve(information[np.ix_(others, others)], columns)
        marginal, right = marginal - cross @ solved[:, :-1], right - cross @ solved[:, -1]
    return symmetrised(marginal), np.asarray(right)


def mapped_pair(
    pair: Pair, sender: Sequence[int], receiver: Sequence[int], flat: float = 0.0, centre: Vector | None = None
) -> Pair:
    """A pair over the agents ``sender`` (ids) as a pair over the agents ``receiver``.

    Agents that only the sender has are marginalised; those that only the receiver has get the information
    ``flat`` about ``centre`` ``(6n,)`` (zero: none at all). Raises ``numpy.linalg.LinAlgError`` where what is to be
    marginalised is singular.
    """
    common = [agent for agent in receiver if agent in sender]
    reduced, right = marginal_pair(pair, [list(sender).index(agent) for agent in common])
    dimension = STATES_PER_AGENT * len(receiver)
    information, vector = flat * np.eye(dimension), np.zeros(dimension)
    if centre is not None:
        vector = flat * centre
    at = states_of([list(receiver).index(agent) for agent in common])
    information[np.ix_(at, at)], vector[at] = reduced, right
    return information, vector


def mapped_payload(payload: Payload, sender: Sequence[int], receiver: Sequence[int], centre: Vector) -> Payload:
    """A neighbour's payload as one over the receiver's agents; unknown agents are as good as unknown."""
    information, vector = mapped_pair(
        (payload.information, payload.vector), sender, receiver, FLAT_INFORMATION, centre
    )
    return Payload(payload.tick, information, vector, payload.rank, payload.degree)


def silence_sigma_m(silent_s: float, accel_variance: float, period_s: float) -> float:
    """1-sigma per axis that a time without any data adds to a position.

    An acceleration of variance q, drawn anew each tick T, moves a position by ``sqrt(q T t^3 / 3)`` in a time t.
    """
    return math.sqrt(accel_variance * period_s * max(silent_s, 0.0) ** 3 / 3.0)


def unseen_variance(unseen_ticks: int, accel_variance: float, period_s: float) -> float:
    """Variance per axis of the tick-averaged acceleration of a drone that has not been heard for some ticks.

    Drawn anew each tick, unknown accelerations would cancel out; real ones last. The position variance of a constant
    one grows with the fourth power of time, which white ones give whose variance grows with time, ``2 q t / T``;
    after the time that a manoeuvre lasts it grows no further (R. A. Singer, 1970).
    """
    lasting_ticks = min(unseen_ticks, MANOEUVRE_S / period_s)
    return max(2.0 * lasting_ticks, 1.0) * accel_variance


def prior_tick(estimator: Changeable) -> int:
    """The tick that a prior of a joining agent has to speak of; call it between two ticks, after the first."""
    window = estimator.window
    if isinstance(estimator, MovingHorizonEstimator):
        return max(window.first, window.last + 1 - window.ticks)
    return window.last


def with_members(estimator: E, agents: Sequence[int], own: int, fresh: Mapping[int, Prior]) -> E:
    """The estimator of a changed fleet, between two ticks (after ``solve``, before ``begin``).

    ``agents`` are the ids of the new fleet in the order of their blocks, ``own`` among them. Those in ``fresh`` begin
    with a prior at `prior_tick`, uncorrelated with the rest, also if they were there before; all others keep their
    block. Rows in the window that name a removed or replaced agent are dropped. Raises ``KeyError`` for an agent that
    is neither old nor fresh, ``numpy.linalg.LinAlgError`` where the old information is singular.
    """
    old = estimator.layout
    layout = Layout(tuple(agents))
    kept = [agent for agent in layout.agents if agent not in fresh]
    slots = [old.slot(agent) for agent in kept]
    changed = type(estimator)(
        estimator.settings,
        layout,
        layout.slot(own),
        np.zeros(layout.dimension),
        np.eye(layout.dimension),
        estimator.period_s,
    )
    changed.refused_pairs = estimator.refused_pairs
    sources = [old.slot(agent) if agent in kept else None for agent in layout.agents]
    _transplant_window(estimator.window, changed.window, sources, {a: old.slot(a) for a in fresh if a in old.agents})
    at = states_of([layout.slot(agent) for agent in kept])
    mean, information = np.zeros(layout.dimension), np.zeros((layout.dimension, layout.dimension))
    old_mean, old_information = _state(estimator)
    information[np.ix_(at, at)] = marginal_pair((old_information, old_mean), slots)[0] if kept else 0.0
    mean[at] = old_mean[states_of(slots)] if kept else 0.0
    for agent, (agent_mean, agent_covariance) in fresh.items():
        where = block(layout.slot(agent))
        mean[where] = agent_mean
        information[where, where] = symmetrised(np.linalg.inv(agent_covariance))
    _set_state(changed, mean, information)
    if isinstance(estimator, MovingHorizonEstimator) and isinstance(changed, MovingHorizonEstimator):
        changed._path = _path(estimator, at, states_of(slots), mean)
    if isinstance(estimator, RelayMovingHorizonEstimator) and isinstance(changed, RelayMovingHorizonEstimator):
        _transplant_data(estimator, changed, kept, information)
        _transplant_witness(estimator, changed, fresh.get(own))
    return changed


def _state(estimator: Changeable) -> tuple[Vector, Matrix]:
    """Mean and information at `prior_tick`."""
    if isinstance(estimator, MovingHorizonEstimator):
        return estimator.prior_mean, estimator.prior_information
    return estimator._mean, estimator._information


def _set_state(estimator: Changeable, mean: Vector, information: Matrix) -> None:
    if isinstance(estimator, MovingHorizonEstimator):
        estimator.prior_mean, estimator.prior_information = mean, information
    else:
        estimator._mean, estimator._information = mean, information
    estimator._pair = (information, information @ mean)


def _path(estimator: MovingHorizonEstimator, at: IntArray, source: IntArray, mean: Vector) -> list[Vector]:
    """The states of the last window: of a fresh agent its prior, moved along with its velocity."""
    path = []
    first = estimator.window.last + 1 - len(estimator._path)
    for k, state in enumerate(estimator._path):
        states = mean.reshape(-1, STATES_PER_AGENT).copy()
        states[:, :3] += (first + k - prior_tick(estimator)) * estimator.period_s * states[:, 3:]
        moved = states.ravel()
        moved[at] = state[source]
        path.append(moved)
    return path


def _transplant_data(
    old: RelayMovingHorizonEstimator, new: RelayMovingHorizonEstimator, kept: Sequence[int], information: Matrix
) -> None:
    """What the data say of the kept agents stays; of a fresh one they say what its prior says."""
    at = states_of([new.layout.slot(agent) for agent in kept])
    slots = [old.layout.slot(agent) for agent in kept]
    new.switches, new.reversals = old.switches, old.reversals
    new._moved, new._mirror = old._moved, old._mirror
    new._data.information = information.copy()
    if kept:
        new._data.information[np.ix_(at, at)] = marginal_pair((old._data.information, old.prior_mean), slots)[0]


def _transplant_witness(
    old: RelayMovingHorizonEstimator, new: RelayMovingHorizonEstimator, prior: Prior | None
) -> None:
    """The witness goes on, or begins anew from the own ``prior``, brought to the window's last tick."""
    if prior is None:
        new._witness, new._own = old._witness, old._own
        new._witness.slot = new.slot
        return
    mean, covariance = prior
    move, push = transition_matrix(1, new.period_s), input_matrix(1, new.period_s)
    mine = slice(3 * new.slot, 3 * new.slot + 3)
    accel, variance = new.window.inputs()
    for k in range(prior_tick(new) - new.window.first, len(accel)):
        mean = move @ mean + push @ accel[k, mine]
        covariance = move @ covariance @ move.T + (push * variance[k, mine]) @ push.T
    new._own = mean, symmetrised(covariance)
    new._witness = Witness(new.slot, new._own, new.period_s)


def _transplant_window(
    old: MeasurementWindow, new: MeasurementWindow, sources: Sequence[int | None], replaced: Mapping[int, int]
) -> None:
    """Give a window the content of another; ``sources`` are the old slots of the new ones (None: new)."""
    new.first, new.last, new._origin = old.first, old.last, old._origin
    new.dropped, new.refused = old.dropped, old.refused
    new._rows = _renamed(old._rows, sources, old.layout.size)
    before_start = np.iinfo(np.int64).min
    new._last_heard = np.array([before_start if s is None else old._last_heard[s] for s in sources], np.int64)
    for agent, old_slot in replaced.items():  # what is known of its motion stays
        new._last_heard[new.layout.slot(agent)] = old._last_heard[old_slot]
    known = {slot: s for slot, s in enumerate(sources) if s is not None}
    known |= {new.layout.slot(agent): old_slot for agent, old_slot in replaced.items()}
    new._inputs.take_over(old._inputs, known)


def _renamed(rows: RowTable, sources: Sequence[int | None], old_size: int) -> RowTable:
    """Rows with the slots of the new fleet; those that name an agent which was not kept are left out."""
    target = np.full(old_size + 1, -2, np.int32)
    target[old_size] = -1  # index -1, "no other end", stays what it is
    for slot, source in enumerate(sources):
        if source is not None:
            target[source] = slot
    renamed = rows.copy()
    for field in ("agent", "other", "observer"):
        renamed[field] = target[rows[field]]
    kept = (renamed["agent"] >= 0) & (renamed["other"] >= -1) & (renamed["observer"] >= 0)
    return renamed[kept]
