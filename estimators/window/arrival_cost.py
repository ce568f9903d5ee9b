"""The paper's arrival cost: what a window's start is believed to be from all that left the window.

It is *smoothed*: where the window's second state lies given everything in the window, with the information predicted
to it. (The *filtered* one, which uses nothing twice, is made by `estimators.window.first_state`.) It is a belief
before consensus about the window that the next tick opens.
"""

from __future__ import annotations

from estimators.estimator import Estimate, Status
from estimators.model.members import InformationState
from estimators.window.history import MeasurementWindow
from estimators.window.problem import WindowProblem, WindowSolution


def smoothed_arrival(problem: WindowProblem, solution: WindowSolution, *, slide: bool) -> InformationState:
    """Lines 18-23 of Algorithm 1 of Borelle et al. 2023; with ``slide`` false (t < N) the window's start stays."""
    if slide:
        return InformationState(solution.path[1], solution.next_information)
    return InformationState(solution.path[0], problem.information)


def first_estimate(window: MeasurementWindow, prior: InformationState) -> Estimate:
    """The estimate at the first tick, where there is nothing but the prior."""
    status = Status.OK if len(window.rows()[0]) else Status.NO_DATA
    return Estimate(window.last, prior.mean.copy(), prior.covariance(), status, window.ages())
