"""Whose receiver is off: suspected, confirmed, named, and taken back.

A receiver is named when its odds (`receiver_faults`) are high and lead those of every other receiver and every pair
of ranges, at once where they are overwhelming, else twice in a row. From then on its fixes explain nothing: the
odds of the others are those without it. It is taken back when it has agreed with the others for a while. With fewer
than four receivers it can be seen that one is off, not which; and where all are off alike, nothing can be seen at
all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimators.integrity.exclusion.baselines import BIN_S, Baselines, Bin, SharedTick
from estimators.integrity.exclusion.receiver_faults import Odds, largest, odds
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import (
    AGREEING_NATS,
    AGREEING_S,
    FEWEST_RECEIVERS,
    LEADING_NATS,
    NAMED_NATS,
    OVERWHELMING_NATS,
)
from estimators.model.measurements import Vector

EPOCHS_BACK = (0, 4, 20, 60)
"""Bins that are looked at together: now, and 2, 10 and 30 s ago."""


@dataclass(frozen=True, slots=True)
class Named:
    """A receiver that is off."""

    since_tick: int
    odds_nats: float
    shift_m: Vector
    """``(3,)`` NED, of now."""
    agreeing_s: float = 0.0


class NamingMonitor:
    """Names receivers; ``own`` is whose place `separation_m` is of."""

    def __init__(self, own: int, period_s: float) -> None:
        self._own = own
        self._baselines = Baselines(period_s)
        self._bins: dict[int, Bin] = {}
        self._suspect: int | None = None
        self.named: dict[int, Named] = {}
        """By id."""
        self.unattributable_nats = 0.0
        """Odds of somebody being off where it cannot be told who; 0: nobody, or it can."""
        self.separation_m = np.zeros(3)
        """``(3,)``, per axis: how far the own place moves at most if one receiver that does not agree is left out."""
        self.receivers = 0
        """Receivers not named that are ranged to."""

    def observe(self, evidence: SharedTick) -> tuple[Finding, ...]:
        """A finding about each receiver that is off; one about nobody where it cannot be told whose."""
        for closed in self._baselines.take(evidence):
            oldest = closed.number - max(EPOCHS_BACK)
            self._bins = {number: each for number, each in self._bins.items() if number >= oldest}
            self._bins[closed.number] = closed
            self._look(closed, evidence.tick)
        self.named = {agent: each for agent, each in self.named.items() if agent in evidence.agents}
        found = [
            Finding(What.RECEIVER_OFF, Gravity.DEGRADED, agent, float(np.linalg.norm(each.shift_m)))
            for agent, each in sorted(self.named.items())
        ]
        if self.unattributable_nats:
            value = self.unattributable_nats
            found.append(Finding(What.SOMEBODY_OFF, Gravity.ALARM, value=value, limit=NAMED_NATS))
        return tuple(found)

    def _look(self, closed: Bin, tick: int) -> None:
        epochs = [self._bins[closed.number - back] for back in EPOCHS_BACK if closed.number - back in self._bins]
        now = odds(epochs, self.named, self._own)
        if not now.receivers:
            return
        self.receivers = len(now.receivers)
        moved = [np.abs(each) for agent, each in now.separations_m.items() if now.receivers[agent] > AGREEING_NATS]
        self.separation_m = np.asarray(np.max(moved, axis=0)) if moved else np.zeros(3)
        self._judge(now, tick)
        for agent in list(self.named):
            self._reconsider(agent, epochs)
        # what a receiver said before it was named, and while it is, says nothing of it once it is taken back
        self._bins = {number: each.without(self.named) for number, each in self._bins.items()}

    def _judge(self, now: Odds, tick: int) -> None:
        agent, lead = largest(now.receivers)
        assert agent is not None
        nats = now.receivers[agent]
        lead = min(lead, nats - max(now.pairs.values(), default=0.0))
        self.unattributable_nats = 0.0
        if nats <= NAMED_NATS:
            self._suspect = None
        elif self.receivers < FEWEST_RECEIVERS:
            self.unattributable_nats = nats
        elif lead <= LEADING_NATS:
            self._suspect = None
        elif nats > OVERWHELMING_NATS or agent == self._suspect:
            self.named[agent] = Named(tick, nats, now.shifts_m[agent])
            self._suspect = None
        else:
            self._suspect = agent

    def _reconsider(self, agent: int, epochs: list[Bin]) -> None:
        """Take a named receiver back once it agrees with those who are not named."""
        again = odds(epochs[:1], [each for each in self.named if each != agent])
        if agent not in again.receivers:
            return
        nats, held = again.receivers[agent], self.named[agent]
        agreeing_s = held.agreeing_s + BIN_S if nats < AGREEING_NATS else 0.0
        if agreeing_s > AGREEING_S:
            del self.named[agent]
        else:
            self.named[agent] = replace(held, odds_nats=nats, shift_m=again.shifts_m[agent], agreeing_s=agreeing_s)
