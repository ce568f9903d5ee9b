"""Tracking over links that hold and delay packets without saying so: Fu, Bi and Gao 2017, corrected.

For comparison with the fleet's own estimators (`fleetloc bench fusion`); docs/results.md says what was wrong
in print. One target with state x = [p (3), v (3)], NED m and m/s, is measured by L agents,

    x_{k+1} = Phi x_k + Gam w_k,      z^i_k = p_k + v^i_k,

and the leader gets of agent i, not knowing which,

    y^i_k = z^i_k  with probability a1_i,   z^i_{k-1}  with a2_i,   y^i_{k-1}  otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from scipy.optimize import minimize_scalar

from estimators.model.measurements import Matrix, Vector

AXES = 3
STATES = 2 * AXES


@dataclass(frozen=True)
class TargetModel:
    """Constant velocity with white acceleration; every agent measures the position.

    ``accel_variance`` in (m/s2)^2 and ``position_variance`` in m^2, per axis.
    """

    period_s: float
    accel_variance: float
    position_variance: float
    transition: Matrix = field(init=False)
    """Phi, ``(6, 6)``."""
    process: Matrix = field(init=False)
    """Gam Q Gam', ``(6, 6)``."""

    def __post_init__(self) -> None:
        identity, period_s = np.eye(AXES), self.period_s
        transition = np.block([[identity, period_s * identity], [np.zeros((AXES, AXES)), identity]])
        gain = np.vstack([period_s**2 / 2 * identity, period_s * identity])
        object.__setattr__(self, "transition", transition)
        object.__setattr__(self, "process", self.accel_variance * gain @ gain.T)

    @property
    def measured(self) -> Matrix:
        """H of one agent, ``(3, 6)``."""
        return np.eye(AXES, STATES)

    @property
    def noise(self) -> Matrix:
        """R of one agent, ``(3, 3)``."""
        return self.position_variance * np.eye(AXES)

    def predict(self, mean: Vector, covariance: Matrix, steps: int = 1) -> tuple[Vector, Matrix]:
        """Mean and covariance ``steps`` periods later."""
        for _ in range(steps):
            mean = self.transition @ mean
            covariance = self.transition @ covariance @ self.transition.T + self.process
        return mean, covariance


def update(
    mean: Vector, covariance: Matrix, innovation: Vector, measured: Matrix, noise: Matrix
) -> tuple[Vector, Matrix]:
    """The Kalman update."""
    spread = measured @ covariance @ measured.T + noise
    gain = np.linalg.solve(spread, measured @ covariance).T
    return mean + gain @ innovation, covariance - gain @ spread @ gain.T


# --- the channel's second moment ---------------------------------------------------------------------------


def second_moment(moment: Matrix, measured: Matrix, on_time: Vector, late: Vector) -> Matrix:
    """What the unknown channel adds to the covariance of y: E[dH q dH'], exact.

    ``moment`` q = E[X X'] ``(n + 2 m, n + 2 m)`` of X = [x; z_{k-1}; y_{k-1}], ``measured`` the stacked H ``(m, n)``,
    ``on_time`` and ``late`` a1 and a2 per agent ``(L,)``, m/L rows each. The outcomes exclude each other, hence
    the covariance -a1 a2 and the cross terms that (10) and (12) lack; F1 and F2 contain -I, since what is not
    delivered is held.
    """
    rows, states = measured.shape
    identity, zero = np.eye(rows), np.zeros((rows, rows))
    held_from_now = np.hstack([measured, zero, -identity])  # F1
    held_from_then = np.hstack([np.zeros((rows, states)), identity, -identity])  # F2
    same = np.kron(np.eye(len(on_time)), np.ones((rows // len(on_time),) * 2))  # an agent's rows share one draw
    spread = np.repeat(on_time * (1 - on_time), rows // len(on_time))[:, None] * same
    spread_late = np.repeat(late * (1 - late), rows // len(on_time))[:, None] * same
    exclusive = np.repeat(-on_time * late, rows // len(on_time))[:, None] * same
    cross = exclusive * (held_from_now @ moment @ held_from_then.T)
    return np.asarray(
        spread * (held_from_now @ moment @ held_from_now.T)
        + spread_late * (held_from_then @ moment @ held_from_then.T)
        + cross
        + cross.T
    )


class CentralFilter:
    """The leader's linear minimum-variance filter of all y, without time stamps (spec of the corrected (8)-(21)).

    ``conditional`` takes for q the second moment about the present estimate instead of the one about the start:
    bounded, independent of the start's statistics, better, and as consistent. `predicted` X and its covariance
    are of [x; z_{k-1}; y_{k-1}], ``(6 + 6 L,)``.
    """

    def __init__(
        self, model: TargetModel, on_time: Vector, late: Vector, mean: Vector, covariance: Matrix,
        *, conditional: bool = True,
    ) -> None:  # fmt: skip
        agents = len(on_time)
        rows = AXES * agents
        self._on_time, self._late, self._conditional = on_time, late, conditional
        self._measured = np.tile(model.measured, (agents, 1))
        self._rows = rows
        a1, a2 = (np.diag(np.repeat(share, AXES)) for share in (on_time, late))
        zero = np.zeros((rows, rows))
        self._arrived = np.hstack([a1 @ self._measured, a2, np.eye(rows) - a1 - a2])  # Hb
        before = np.zeros((STATES, rows))
        self._step = np.vstack(
            [
                np.hstack([model.transition, before, before]),
                np.hstack([self._measured, zero, zero]),
                self._arrived,
            ]
        )
        noise = model.position_variance * np.eye(rows)
        self._arrived_noise = noise @ a1
        self._process = np.zeros_like(self._step)
        self._process[:STATES, :STATES] = model.process
        then, now = slice(STATES, STATES + rows), slice(STATES + rows, None)
        self._process[then, then] = noise
        self._process[then, now] = self._process[now, then] = noise @ a1
        self._process[now, now] = noise @ a1  # not a1 R a1: an indicator is its own square
        self._correlation = np.vstack([np.zeros((STATES, rows)), noise @ a1, noise @ a1])
        first = self._measured @ mean
        self.predicted = np.concatenate([mean, first, first])
        self.predicted_covariance = np.zeros_like(self._step)
        self.predicted_covariance[:STATES, :STATES] = covariance
        self._moment = np.outer(self.predicted, self.predicted) + self.predicted_covariance

    def step(self, received: Matrix) -> tuple[Vector, Matrix]:
        """Take in y_k ``(L, 3)``; the target's filtered mean ``(6,)`` and covariance ``(6, 6)``."""
        X, P = self.predicted, self.predicted_covariance
        if self._conditional:
            self._moment = np.outer(X, X) + P
        channel = np.zeros_like(P)
        added = second_moment(self._moment, self._measured, self._on_time, self._late)
        channel[-self._rows :, -self._rows :] = added
        spread = self._arrived @ P @ self._arrived.T + added + self._arrived_noise
        innovation = received.ravel() - self._arrived @ X
        crossed = P @ self._arrived.T
        gain = np.linalg.solve(spread, crossed.T).T
        mean, covariance = X + gain @ innovation, P - gain @ spread @ gain.T
        # y_k is correlated with the noise of X_{k+1}, whose last block it is: a predictor, not filter then predict
        held = channel[:, -self._rows :]
        predictor = np.linalg.solve(spread, (self._step @ crossed + held + self._correlation).T).T
        self.predicted = self._step @ X + predictor @ innovation
        P = self._step @ P @ self._step.T + channel + self._process - predictor @ spread @ predictor.T
        self.predicted_covariance = (P + P.T) / 2
        self._moment = self._step @ self._moment @ self._step.T + channel + self._process
        return mean[:STATES], covariance[:STATES, :STATES]


class StampedFilter:
    """What time stamps are worth: late measurements are put where they belong (one period back).

    The state is [x_k; x_{k-1}]; a measurement that came on time is not used again when it is repeated late.
    """

    def __init__(self, model: TargetModel, agents: int, mean: Vector, covariance: Matrix, *, use_late: bool = True):
        self._model, self._use_late = model, use_late
        self._mean = np.concatenate([mean, mean])
        self._covariance = np.tile(covariance, (2, 2))
        self._had = np.ones(agents, dtype=bool)  # nothing was measured before the start
        self._begun = False

    def step(self, now: Matrix, before: Matrix, outcome: Sequence[int]) -> tuple[Vector, Matrix]:
        """Take in what arrived: of agent i ``now[i]`` if outcome 1, ``before[i]`` if 2, nothing if 0."""
        if self._begun:
            self._predict()
        self._begun = True
        had = np.zeros_like(self._had)
        for agent, kind in enumerate(outcome):
            if kind == 1:
                self._update(now[agent], 0)
                had[agent] = True
            elif kind == 2 and self._use_late and not self._had[agent]:
                self._update(before[agent], 1)
        self._had = had
        return self._mean[:STATES], self._covariance[:STATES, :STATES]

    def _predict(self) -> None:
        lag = np.zeros((2 * STATES, 2 * STATES))
        lag[:STATES, :STATES], lag[STATES:, :STATES] = self._model.transition, np.eye(STATES)
        self._mean = lag @ self._mean
        self._covariance = lag @ self._covariance @ lag.T
        self._covariance[:STATES, :STATES] += self._model.process

    def _update(self, measured: Vector, age: int) -> None:
        rows = np.zeros((AXES, 2 * STATES))
        rows[:, age * STATES : age * STATES + AXES] = np.eye(AXES)
        innovation = measured - rows @ self._mean
        self._mean, self._covariance = update(self._mean, self._covariance, innovation, rows, self._model.noise)


# --- the distributed scheme --------------------------------------------------------------------------------


class Rule(StrEnum):
    """How two estimates become one."""

    TRACE = "trace"
    """(30): weights by 1/tr P, covariance as if they were independent (which they are not)."""
    SAFE = "safe"
    """The same mean; sum of a_i P_i, an upper bound whatever their correlation."""
    INTERSECTION = "intersection"
    """Covariance intersection, weight by the least trace, 1/2 where both are equal."""
    INTERSECTION_GRID = "intersection_grid"
    """The same with weights in steps of 0.01, the first of the least: where both are equal rounding decides. As the
    reference figures were made."""


@dataclass(frozen=True, slots=True)
class SentEstimate:
    """A follower's estimate with the step it is of: without the stamp it could not be carried on."""

    step: int
    mean: Vector
    covariance: Matrix


class LocalFilter:
    """One agent's Kalman filter of its own measurements; the first step does not predict."""

    def __init__(self, model: TargetModel, mean: Vector, covariance: Matrix) -> None:
        self.model, self.mean, self.covariance = model, mean, covariance
        self._begun = False

    def step(self, measured: Vector) -> tuple[Vector, Matrix]:
        """Predict (from the second step on) and take in a position ``(3,)``."""
        if self._begun:
            self.mean, self.covariance = self.model.predict(self.mean, self.covariance)
        self._begun = True
        innovation = measured - self.mean[:AXES]
        self.mean, self.covariance = update(
            self.mean, self.covariance, innovation, self.model.measured, self.model.noise
        )
        return self.mean, self.covariance


class AgeCompensation:
    """The newest packet of a follower, carried to the present with its process noise ((22), for any age).

    Before anything came it is the common start, which is of step 0.
    """

    def __init__(self, model: TargetModel, mean: Vector, covariance: Matrix) -> None:
        self._model = model
        self.newest = SentEstimate(0, mean, covariance)
        self._heard = False

    def take(self, packet: SentEstimate) -> None:
        """A packet came; an older one than the newest says nothing new."""
        if not self._heard or packet.step > self.newest.step:
            self.newest, self._heard = packet, True

    def at(self, step: int) -> tuple[Vector, Matrix]:
        """Mean and covariance at a step."""
        return self._model.predict(self.newest.mean, self.newest.covariance, step - self.newest.step)


def combine(
    first: tuple[Vector, Matrix], second: tuple[Vector, Matrix], rule: Rule
) -> tuple[Vector, Matrix]:
    """Two estimates of one state as one."""
    (x1, P1), (x2, P2) = first, second
    if rule in (Rule.INTERSECTION, Rule.INTERSECTION_GRID):
        return _intersect(first, second, _least_trace_weight(P1, P2, on_grid=rule is Rule.INTERSECTION_GRID))
    weight = np.trace(P2) / (np.trace(P1) + np.trace(P2))
    mean = weight * x1 + (1 - weight) * x2
    if rule is Rule.SAFE:
        return mean, weight * P1 + (1 - weight) * P2
    return mean, weight**2 * P1 + (1 - weight) ** 2 * P2


def _intersect(first: tuple[Vector, Matrix], second: tuple[Vector, Matrix], weight: float) -> tuple[Vector, Matrix]:
    (x1, P1), (x2, P2) = first, second
    I1, I2 = weight * np.linalg.inv(P1), (1 - weight) * np.linalg.inv(P2)
    covariance = np.linalg.inv(I1 + I2)
    return covariance @ (I1 @ x1 + I2 @ x2), covariance


def _least_trace_weight(P1: Matrix, P2: Matrix, *, on_grid: bool) -> float:
    """Weight of the first."""
    I1, I2 = np.linalg.inv(P1), np.linalg.inv(P2)

    def trace(weight: float) -> float:
        return float(np.trace(np.linalg.inv(weight * I1 + (1 - weight) * I2)))

    if on_grid:
        grid: list[float] = np.linspace(0.0, 1.0, 101).tolist()
        return min(grid, key=trace)
    if np.allclose(P1, P2, rtol=1e-9, atol=0.0):
        return 0.5
    inside = float(minimize_scalar(trace, bounds=(0.0, 1.0), method="bounded").x)
    return min((0.0, 1.0, inside), key=trace)


class LeaderFusion:
    """The leader's own filter joined with a follower's compensated estimate at every step.

    ``feedback`` (31) restarts the own filter from the result: with rule (30) it counts common information twice.
    """

    def __init__(
        self, model: TargetModel, mean: Vector, covariance: Matrix, rule: Rule, *, feedback: bool
    ) -> None:
        self.own = LocalFilter(model, mean, covariance)
        """Filter of the own measurements; with feedback it goes on from what was fused."""
        self._follower = AgeCompensation(model, mean, covariance)
        self._rule, self._feedback = rule, feedback
        self._step = -1

    def step(self, measured: Vector, packet: SentEstimate | None) -> tuple[Vector, Matrix]:
        """Take in the own position ``(3,)`` and what came of the follower; the joint estimate."""
        self._step += 1
        own = self.own.step(measured)
        if packet is not None:
            self._follower.take(packet)
        mean, covariance = combine(own, self._follower.at(self._step), self._rule)
        if self._feedback:
            self.own.mean, self.own.covariance = mean, covariance
        return mean, covariance
