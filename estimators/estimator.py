"""The one interface of all estimators, and what goes in and out of it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.finding import Finding
from estimators.integrity.innovations import Innovations
from estimators.model.gaussian import Prior
from estimators.model.layout import ALL_VEHICLES, Kinds, Layout
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.systematic.range_biases import RangeBiases


class Status(IntEnum):
    """How far an estimate can be trusted; never a NaN instead."""

    OK = 0
    NOT_CONVERGED = 1
    """The last iterate is given."""
    FELL_BACK = 2
    """The solver failed: the pre-estimate (or the last good prediction) is given."""
    NOT_OBSERVABLE = 3
    """The data do not say where the agent itself is, or allow more than one place; the covariance covers them."""
    NO_DATA = 4
    """Nothing was measured or received: the prediction is given."""


@dataclass(frozen=True, slots=True)
class Payload:
    """What one agent sends its neighbours in one consensus round (Borelle et al. 2023, eqs 11-12).

    It is an information pair, or the states of a window: an algorithm that agrees on states has a ``path``, and then
    the pair is empty.

    Attributes
    ----------
    tick : int
        Tick of the state that the pair speaks of (start of the window for a moving horizon estimator).
    information : Matrix ``(6n, 6n)``
        Information matrix, symmetric positive definite.
    vector : Vector ``(6n,)``
        Information vector, ``information @ mean``.
    rank : int
        Rank of the regional observability matrix (25); the consensus weights follow from it.
    degree : int
        Number of neighbours the sender heard in the tick before; Metropolis weights follow from it.
    path : Matrix ``(S, 6n)``, optional
        The states of the sender's window, the oldest first; ``tick`` is that of the oldest.
    """

    tick: int
    information: Matrix
    vector: Vector
    rank: int
    degree: int = 0
    path: Matrix | None = None

    @classmethod
    def of_path(cls, tick: int, path: Matrix, degree: int) -> Payload:
        """The states ``(S, 6n)`` of a window that begins at ``tick``."""
        return cls(tick, np.zeros((0, 0)), np.zeros(0), 0, degree, path)


@dataclass(frozen=True, slots=True)
class SolverReport:
    """What the optimisation of one tick did."""

    iterations: int = 0
    qp_solves: int = 0
    cost: float = 0.0
    """Optimal value of (9), without the factor one half."""
    active_bounds: int = 0
    moves: int = 0
    """How often since the last tick the estimate was moved to where the data hold: its own state to another place, or
    the whole fleet to its mirror image."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """The fleet as one agent sees it at one tick.

    ``mean`` ``(6n,)`` and ``covariance`` ``(6n, 6n)`` in NED m and m/s, blocks in the order of the layout;
    ``age_ticks`` ``(n,)``: ticks since anything measured by that agent last entered this estimate.
    ``observable`` ``(n,)``: whether what was measured, without the prior, says where each agent is; all true where
    the algorithm does not tell.
    """

    tick: int
    mean: Vector
    covariance: Matrix
    status: Status
    age_ticks: NDArray[np.int64]
    report: SolverReport = field(default_factory=SolverReport)
    observable: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    findings: tuple[Finding, ...] = ()
    """Whose measurements contradict the rest, by slot."""
    innovations: Innovations | None = None
    """How well the measurements of each sensor fit; ``None`` where the algorithm does not tell."""
    range_biases: RangeBiases | None = None
    """What ranges are too long by; ``None`` where that is not estimated."""

    def __post_init__(self) -> None:
        if not len(self.observable):
            object.__setattr__(self, "observable", np.ones(len(self.age_ticks), np.bool_))


class Estimator(Protocol):
    """One agent's estimator; the same calls for all algorithms, in lockstep, replay and flight.

    A tick is ``begin``, then for each consensus round l = 0..rounds-1 ``outgoing(l)`` and ``mix(l, ...)``,
    then ``solve``. Ticks grow by one. Rows and inputs may belong to earlier ticks (late arrivals): they go
    to their place in the window; older ones are counted in ``dropped`` and ignored.
    Between two ticks the fleet may change: ``change_members``.
    """

    layout: Layout

    @property
    def fixed_members(self) -> bool:
        """Whether it is for fixed fleets only: then ``change_members`` raises ``RuntimeError``."""
        ...

    @property
    def prior_tick(self) -> int:
        """The tick that the prior of a joining agent has to speak of; between two ticks, after the first."""
        ...

    @property
    def rounds(self) -> int:
        """Consensus rounds per tick."""
        ...

    @property
    def dropped(self) -> int:
        """Rows and inputs that came too late for their place."""
        ...

    def begin(self, tick: int, measurements: RowTable, inputs: InputTable) -> None:
        """Open a tick with the regional measurements and the known inputs that arrived since the last."""
        ...

    def outgoing(self, round_: int) -> Payload:
        """What neighbours get in this round."""
        ...

    def mix(self, round_: int, received: Mapping[int, Payload]) -> Collection[int]:
        """Fuse what neighbours sent in this round, by slot; a missing neighbour is left out.

        Gives the slots of those whose pair contradicts what is known here and was not used; an algorithm that does
        not look gives none.
        """
        ...

    def solve(self, budget: int | None = None) -> Estimate:
        """The estimate of the tick, with at most ``budget`` iterations where the method iterates."""
        ...

    def change_members(
        self, agents: Sequence[int], own: int, fresh: Mapping[int, Prior], kinds: Kinds = ALL_VEHICLES
    ) -> None:
        """Let agents join and leave, between two ticks (after ``solve``, before ``begin``).

        ``agents`` are the ids of the new fleet in the order of their blocks, ``own`` among them. Those in ``fresh``
        begin with a prior at ``prior_tick``, uncorrelated with the rest, also if they were there before; all others
        keep their block. ``kinds`` says who is no vehicle. Rows that name a removed or replaced agent are dropped.
        Raises ``KeyError`` for an agent that is neither old nor fresh, and ``numpy.linalg.LinAlgError`` where the old
        information is singular; then the estimator is of no use any more.
        """
        ...
