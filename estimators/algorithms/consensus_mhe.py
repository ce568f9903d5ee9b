"""Consensus MHE with local models (``consensus_mhe``): Bassolillo, D'Amato and Notaro 2025, reconstructed.

Every agent holds a window of states of all bodies. In each round it solves a small problem over its own drone and the
targets that it ranges (`estimators.window.local_problem`), writes the result into its window, and averages its window
with the neighbours' by Metropolis weights. So what is far away comes along links that are one hop long, and each
round brings it a hop nearer; L of about the graph's diameter is needed.

What the paper leaves open: the own prior is fixed during the rounds of a tick and the targets' follows the average;
the own states after the last round are those of the own problem (``reinject_own``). Others' accelerations are zero
where they are not shared. The paper's estimator has no covariance: that of the own drone and of ranged targets is
the local problem's, all others have what the local problem assumes of a neighbour.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from estimators.consensus.information import metropolis_weights
from estimators.estimator import Estimate, Payload, SolverReport, Status
from estimators.model.gaussian import Prior, symmetrised
from estimators.model.layout import ALL_VEHICLES, STATES_PER_AGENT, Kinds, Layout, block, states_of
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.model.members import MemberChange
from estimators.model.motion import predict_mean
from estimators.settings import EstimatorSettings
from estimators.solvers.qp import make_engine
from estimators.window.assembly import open_window
from estimators.window.local_problem import (
    LocalModel,
    LocalSolution,
    LocalWindow,
    own_measurements,
    ranged_targets,
    solve_local,
)

NEIGHBOUR_SIGMA_MPS = 1.0
"""What is claimed of the velocity of a body that the local problem has not."""


class ConsensusMovingHorizonEstimator:
    """One agent's consensus MHE; arguments as in `estimators.factory.make_estimator`, ``model`` for other weights."""

    fixed_members = False

    def __init__(
        self,
        settings: EstimatorSettings,
        layout: Layout,
        slot: int,
        prior_mean: Vector,
        prior_covariance: Matrix,
        period_s: float,
        model: LocalModel | None = None,
    ) -> None:
        self.settings = settings
        self.layout = layout
        self.slot = slot
        self.period_s = period_s
        self.rounds = settings.rounds
        self.model = _model(settings) if model is None else model
        self.window = open_window(settings, layout, period_s)
        self._path = np.array(prior_mean, float)[None]
        """States ``(S, 6n)`` of the window."""
        self._own_prior = self._path[0, block(slot)].copy()
        self._local: LocalSolution | None = None
        """Of the round under way; none before it is solved."""
        self._bodies: tuple[int, ...] = (slot,)
        self._degree = 0
        self._engine = make_engine(settings.qp)
        self.refused_pairs = 0
        """Neighbours' windows of the right tick that could not be averaged."""

    @property
    def dropped(self) -> int:
        """Rows and inputs that came too late for the window."""
        return self.window.dropped

    @property
    def prior_tick(self) -> int:
        """The next window's first tick."""
        return self.window.next_first

    def begin(self, tick: int, measurements: RowTable, inputs: InputTable) -> None:
        """Open a tick: append the prediction of all states, drop the oldest, insert what arrived."""
        before = self.window.last
        self.window.open(tick)
        self.window.insert(measurements, inputs)
        if before >= 0:
            accel, _ = self.window.inputs()
            predicted = predict_mean(self._path[-1], accel[-1], self.period_s)
            self._path = np.concatenate((self._path, predicted[None]))[-(self.settings.window + 1) :]
        self._own_prior = self._path[0, block(self.slot)].copy()
        self._local = None

    def outgoing(self, round_: int) -> Payload:
        """The window after the local problem of this round."""
        self._solve_round()
        return Payload.of_path(self.window.first, self._path.copy(), self._degree)

    def mix(self, round_: int, received: Mapping[int, Payload]) -> Collection[int]:
        """Average the windows of the neighbourhood by Metropolis weights; those of other ticks are left out."""
        self._solve_round()
        usable = {slot: payload for slot, payload in received.items() if self._can_be_averaged(payload)}
        slots = sorted(usable)
        self._degree = len(slots)
        weight, weights = metropolis_weights(len(slots), [usable[slot].degree or len(slots) for slot in slots])
        path = weight * self._path
        for share, slot in zip(weights, slots, strict=True):
            path += share * np.asarray(usable[slot].path)
            self.window.hear(slot, self.window.last)
        self._path = path
        if round_ + 1 < self.rounds:
            self._local = None
        return ()

    def solve(self, budget: int | None = None) -> Estimate:
        """The newest states of the window, the own ones as the own problem of the last round had them."""
        local = self._solve_round()
        if self.settings.local_window.reinject_own:
            self._path[:, block(self.slot)] = local.states[:, 0]
        return Estimate(
            self.window.last,
            self._path[-1].copy(),
            self._covariance(local),
            self._status(local),
            self.window.ages(),
            SolverReport(max(self.rounds, 1), local.programs, 0.0, local.active),
        )

    def change_members(
        self, agents: Sequence[int], own: int, fresh: Mapping[int, Prior], kinds: Kinds = ALL_VEHICLES
    ) -> None:
        """Let agents join and leave, see `estimators.estimator.Estimator`."""
        change = MemberChange.between(self.layout, agents, own, fresh, kinds)
        path = np.zeros((len(self._path), change.after.dimension))
        path[:, states_of(list(change.stayed))] = self._path[:, states_of(list(change.stayed.values()))]
        for slot, (mean, _) in change.fresh.items():
            for s in range(len(path)):
                age_s = (self.window.last + 1 - len(path) + s - self.prior_tick) * self.period_s
                path[s, block(slot)] = mean
                path[s, block(slot)][:3] += age_s * mean[3:]
        self.layout, self.slot, self._path = change.after, change.own, path
        self.window.change_members(change)
        self._local, self._degree = None, 0

    # --- one round -----------------------------------------------------------------------------------------

    def _solve_round(self) -> LocalSolution:
        """Solve the local problem at the states of now and write the result into the window, once a round."""
        if self._local is not None:
            return self._local
        rows, start = self.window.rows()
        rows, start = own_measurements(rows, start, self.slot)
        self._bodies = (self.slot, *ranged_targets(rows, self.layout.target_slots))
        prior = self._path[0].reshape(-1, STATES_PER_AGENT)[list(self._bodies)].copy()
        prior[0] = self._own_prior
        accel, _ = self.window.inputs()
        mine = slice(3 * self.slot, 3 * self.slot + 3)
        local = solve_local(
            LocalWindow(
                self._path, self._bodies, prior, rows, start, accel[:, mine],
                self.period_s, self.settings.norm_smoothing_m,
            ),
            self.model,
            self._engine,
        )  # fmt: skip
        self._path[:, states_of(self._bodies)] = local.states.reshape(len(self._path), -1)
        self._local = local
        return local

    def _can_be_averaged(self, payload: Payload) -> bool:
        """Whether a neighbour's window is of the same ticks and bodies, and finite; others of these ticks count."""
        if payload.tick != self.window.first:
            return False
        path = payload.path
        fits = path is not None and path.shape == self._path.shape and bool(np.isfinite(path).all())
        self.refused_pairs += not fits
        return fits

    def _covariance(self, local: LocalSolution) -> Matrix:
        sigma = np.repeat((max(self.model.neighbour_sigma_m, 1.0), NEIGHBOUR_SIGMA_MPS), 3)
        variance = np.tile(sigma**2, self.layout.size)
        covariance = np.diag(variance)
        at = states_of(self._bodies)
        covariance[np.ix_(at, at)] = local.newest_covariance()
        return symmetrised(covariance)

    def _status(self, local: LocalSolution) -> Status:
        if not local.solved:
            return Status.NOT_CONVERGED
        rows, _ = self.window.rows()
        return Status.OK if len(rows) or self._degree else Status.NO_DATA


def _model(settings: EstimatorSettings) -> LocalModel:
    """The local problem's weights as the settings have them."""
    table = settings.local_window
    gate_m = np.inf if table.range_gate_m is None else table.range_gate_m
    ceiling_m = settings.limits.target.ceiling_m
    return LocalModel(
        neighbour_sigma_m=table.neighbour_sigma_m,
        range_gate_m=gate_m,
        ceiling_m=np.inf if ceiling_m is None else ceiling_m,
    )
