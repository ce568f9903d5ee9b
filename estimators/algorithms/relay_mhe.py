"""Moving horizon estimation over everything the fleet shared (``dmhe_relay``), see docs/algorithms.md.

Records and inputs travel over hops, so that the window of every agent holds what the fleet measured and each
solves the central problem. The window is DMHE-1's (input corrections as variables); its arrival cost is
filtered, so that nothing is used twice; consensus on it only repairs what was lost on the way.

What an arrival cost holds is never linearised anew. So a range between places that are not known well enters it
with what its linearisation misses (`estimators.model.second_order`), and a drone without fixes has a witness
that keeps other places in mind (`estimators.integrity.witness`), and so has the whole fleet
(`estimators.integrity.fleet_mirror`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimators.algorithms.moving_horizon import MovingHorizonEstimator
from estimators.consensus.inheritance import inherit, survey
from estimators.estimator import Estimate, Payload, SolverReport, Status, symmetrised
from estimators.integrity.data_information import DataInformation
from estimators.integrity.fleet_mirror import FleetMirror, doubtful, mirror_offset, mirrored
from estimators.integrity.witness import Body, Opinion, Witness, body_of, own_rows
from estimators.model.layout import Layout, block
from estimators.model.measurements import ROW, Matrix, Vector
from estimators.model.motion import input_matrix, transition_matrix
from estimators.model.row_kernels import POSITION, any_of
from estimators.model.second_order import filter_reweighted
from estimators.settings import EstimatorSettings
from estimators.window.types import WindowProblem, WindowSolution

RESEATED_SPREAD = 2.0
"""Factor on the covariance of a place taken over from the witness: the window's rows are in it already."""


class RelayMovingHorizonEstimator(MovingHorizonEstimator):
    """One agent's ``dmhe_relay``; arguments as in `estimators.factory.make_estimator`."""

    def __init__(
        self,
        settings: EstimatorSettings,
        layout: Layout,
        slot: int,
        prior_mean: Vector,
        prior_covariance: Matrix,
        period_s: float,
    ) -> None:
        super().__init__(settings, layout, slot, prior_mean, prior_covariance, period_s)
        self._covariance = symmetrised(np.asarray(prior_covariance, float))
        self._data = DataInformation(layout.size)
        self._observable = np.ones(layout.size, np.bool_)
        self._own: Body = body_of(self.prior_mean, self._covariance, slot)
        self._witness = Witness(slot, self._own, period_s)
        self.switches = 0
        """How often the own state was moved to the only place that the data allow."""
        self._mirror = FleetMirror()
        self.reversals = 0
        """How often the fleet turned out to be the mirror image of the estimate."""
        self._moved = 0
        """Both, at the last tick."""

    def _observability_rank(self) -> int:
        """Not used: consensus here has no weights."""
        return 0

    def mix(self, round_: int, received: Mapping[int, Payload]) -> None:
        """Inherit from each neighbour's pair what it knows better. Pairs of another window start are not used."""
        timely = {slot: pair for slot, pair in received.items() if pair.tick == self.window.first}
        usable, better = survey(self._pair[0], timely, self.slot)
        self.refused_pairs += len(timely) - len(usable)
        if not better or self.window.last == self.window.first:
            return
        for slot, pair in usable.items():
            mixed = inherit(self._pair, (pair.information, pair.vector), self.slot)
            if mixed is not self._pair:
                self.window.hear(slot, self.window.first)
            self._pair = mixed

    def _slide(self, problem: WindowProblem, solution: WindowSolution) -> None:
        """Marginalise the oldest tick where the window is full; keep the covariance of the newest."""
        information, mean = self._filter(problem, solution.path)
        full = self.window.last - self.window.first == self.settings.window
        self._observable = self._data.advance(problem, solution.path, self.settings.norm_smoothing_m, slide=full)
        self._path = list(solution.path)
        if not full:  # the start stays
            information = np.ascontiguousarray(problem.information)
            mean = np.asarray(np.linalg.solve(information, problem.vector), np.float64)
        self.prior_information, self.prior_mean = information, mean
        self._look_at_mirror(problem, solution.path, full)

    def _look_at_mirror(self, problem: WindowProblem, path: Matrix, full: bool) -> None:
        """Weigh the oldest tick, whose rows are all there by now, as it leaves; become the image if that is it."""
        if full:
            self._mirror.weigh(problem.rows[: problem.start[1]], path[0], self.settings.norm_smoothing_m)
        self._mirror.pass_by(self.prior_mean, self.prior_information)
        if self._mirror.reversed:
            self.reversals += 1
            self._mirror = FleetMirror(-self._mirror.lead_nats)
            _, self._covariance = mirrored(path[-1], self._covariance)
            prior_covariance = symmetrised(np.linalg.inv(self.prior_information))
            self.prior_mean, prior_covariance = mirrored(self.prior_mean, prior_covariance)
            self.prior_information = symmetrised(np.linalg.inv(prior_covariance))
            self._path = [state + mirror_offset(state) for state in self._path]

    def _filter(self, problem: WindowProblem, path: Matrix) -> tuple[Matrix, Vector]:
        """Information and mean one tick after the window's start; sets the covariance at its end.

        The rows of ``problem`` get variances that hold what their linearisation misses.
        """
        n = len(problem.vector)
        information, mean, covariance = np.empty((n, n)), np.empty(n), np.empty((n, n))
        rows = np.empty(len(problem.rows), ROW)
        sound = filter_reweighted(
            problem.rows,
            problem.start,
            problem.accel,
            problem.accel_variance,
            np.ascontiguousarray(path),
            self.period_s,
            self.settings.norm_smoothing_m,
            problem.information,
            problem.vector,
            rows,
            information,
            mean,
            covariance,
        )
        if not sound:
            raise ArithmeticError("the window's information is not positive definite")
        problem.rows = rows
        self._covariance = symmetrised(covariance)
        return information, mean

    def _estimate(self, problem: WindowProblem, mean: Vector, status: Status, report: SolverReport) -> Estimate:
        """The smoothed newest state, or its mirror image, with the covariance of the filter along the window."""
        if status is Status.OK and not len(problem.rows):
            status = Status.NO_DATA
        mean = self._path[-1]
        covariance, observable = self._doubted(problem, mean)
        if not observable[self.slot] and status in (Status.OK, Status.NOT_CONVERGED):
            status = Status.NOT_OBSERVABLE
        moved, self._moved = self.switches + self.reversals - self._moved, self.switches + self.reversals
        report = replace(report, moves=moved)
        return Estimate(self.window.last, mean, covariance, status, self.window.ages(), report, observable)

    def _doubted(self, problem: WindowProblem, mean: Vector) -> tuple[Matrix, NDArray[np.bool_]]:
        """The covariance over all places that the fleet may be at, and whose place the data tell."""
        covariance, observable = self._covariance, self._observable
        opinion = self._second_opinion(problem, mean)
        if opinion is not None and opinion.ambiguous:
            observable = observable.copy()
            observable[self.slot] = False
        if opinion is not None and opinion.understated:
            covariance = covering(covariance, opinion.second_moment, self.slot)
        if opinion is not None and opinion.elsewhere is not None:
            self._move(opinion.elsewhere, problem)
        weighed = 1 if self.window.last - self.window.first == self.settings.window else 0
        eps = self.settings.norm_smoothing_m
        image = self._mirror.image(mean, problem.rows, problem.start[weighed:], self._path[weighed:], eps)
        if image is not None:
            observable = observable & ~doubtful(image, covariance)
            covariance = image.covered(covariance)
        return covariance, observable

    def _second_opinion(self, problem: WindowProblem, mean: Vector) -> Opinion | None:
        """Let the witness see the newest tick, and ask it about the estimate."""
        before, self._own = self._own, body_of(mean, self._covariance, self.slot)
        if any_of(problem.rows, POSITION, self.slot):
            self._witness.rest()
            return None
        mine = slice(3 * self.slot, 3 * self.slot + 3)
        rows, start = self.window.rows()
        newest = own_rows(rows[start[-2] :], self.slot)
        self._witness.advance(newest, problem.accel[-1, mine], problem.accel_variance[-1, mine], False, before)
        located = np.flatnonzero(self._observable)
        bodies = {int(s): body_of(mean, self._covariance, int(s)) for s in located if s != self.slot}
        self._witness.see(newest, bodies)
        return self._witness.judge(self._own)

    def _move(self, there: Body, problem: WindowProblem) -> None:
        """Put the own block of the arrival cost where the witness is sure to be, carried back through the window."""
        self.switches += 1
        mine, own = slice(3 * self.slot, 3 * self.slot + 3), block(self.slot)
        back, push = transition_matrix(1, -self.period_s), input_matrix(1, self.period_s)
        mean, spread = there[0], RESEATED_SPREAD * there[1]
        full = self.window.last - self.window.first == self.settings.window
        for k in range(len(problem.accel) - 1, 0 if full else -1, -1):
            mean = back @ (mean - push @ problem.accel[k, mine])
            spread = back @ (spread + (push * problem.accel_variance[k, mine]) @ push.T) @ back.T
        covariance = covering(symmetrised(np.linalg.inv(self.prior_information)), spread, self.slot)
        self.prior_mean[own] = mean
        self.prior_information = symmetrised(np.linalg.inv(covariance))


def covering(covariance: Matrix, own: Matrix, slot: int) -> Matrix:
    """The fleet's covariance with another one of the own state ``(6, 6)``, uncorrelated with the others."""
    out = covariance.copy()
    out[block(slot), :] = 0.0
    out[:, block(slot)] = 0.0
    out[block(slot), block(slot)] = own
    return symmetrised(out)
