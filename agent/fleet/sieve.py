"""What is left out before the estimator sees it, because it cannot be: held against the last good estimate."""

from __future__ import annotations

from collections import Counter

import numpy as np

from estimators.estimator import Estimate
from estimators.integrity.finding import Finding
from estimators.integrity.plausibility import PlausibilityMonitor, Presented
from estimators.integrity.thresholds import IMPOSSIBLE_MPS2
from estimators.model.layout import STATES_PER_AGENT, block
from estimators.model.measurements import InputTable, RowTable, Vector


class Sieve:
    """Of one agent; ``counters`` is where it counts what it leaves out, by who measured it."""

    def __init__(self, agent_id: int, period_s: float, counters: Counter[str]) -> None:
        self._monitor = PlausibilityMonitor(agent_id, period_s)
        self._counters = counters
        self._tick = 0
        self._believed: dict[int, tuple[Vector, Vector]] = {}
        self.findings: tuple[Finding, ...] = ()
        """About agents, by id, of the latest tick."""

    def note(self, estimate: Estimate, members: tuple[int, ...]) -> None:
        """The estimate that measurements are held against from now on."""
        sigma = np.sqrt(estimate.covariance.diagonal())
        self._tick = estimate.tick
        self._believed = {a: (estimate.mean[block(slot)], sigma[block(slot)]) for slot, a in enumerate(members)}

    def forget(self) -> None:
        """There is no such estimate any more."""
        self._believed, self.findings = {}, ()
        self._monitor.forget()

    def passed(
        self, tick: int, members: tuple[int, ...], rows: RowTable, inputs: InputTable
    ) -> tuple[RowTable, InputTable]:
        """What of a tick's rows and inputs, by slot of ``members``, can be."""
        nothing = np.full(STATES_PER_AGENT, np.nan), np.zeros(STATES_PER_AGENT)
        believed = [self._believed.get(agent, nothing) for agent in members]
        mean, sigma = (np.concatenate(each) for each in zip(*believed, strict=True))
        self.findings = self._monitor.observe(Presented(tick, members, rows, self._tick, mean, sigma))
        refused = self._monitor.refused
        for slot in rows["observer"][refused].tolist():
            self._counters[f"impossible rows of {members[slot]}"] += 1
        pushed = np.abs(inputs["accel"]).max(axis=1, initial=0.0) > IMPOSSIBLE_MPS2
        for slot in inputs["agent"][pushed].tolist():
            self._counters[f"impossible accelerations of {members[slot]}"] += 1
        return (rows[~refused] if refused.any() else rows), (inputs[~pushed] if pushed.any() else inputs)

    def shut_out(self) -> tuple[int, ...]:
        """Agents whose fixes have been refused, one and all, for some seconds."""
        return self._monitor.shut_out()
