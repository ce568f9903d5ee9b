"""Whose fixes or ranges are off: suspected, confirmed, named, and taken back.

Something is named when its odds (`fault_odds`) are high, and lead those of everything else. What it has done to the
filter of slow errors is taken out then, and from then on it explains nothing. It is taken back when it has agreed
with the others for a while. With fewer than four receivers it can be seen that one is off, not which; and where all
are off alike, nothing can be seen at all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from estimators.integrity.exclusion.baselines import BIN_S, Baselines, Bin, Pair, Ranging, SharedTick
from estimators.integrity.exclusion.fault_odds import RANGES_STEP_M, STEP_M, FaultOdds, LikelyFault, Odds
from estimators.integrity.exclusion.jumps import JUMPED_SQUARE, jump
from estimators.integrity.exclusion.slow_errors import Fresh, SlowErrors
from estimators.integrity.exclusion.spoiled_ranges import SpoiledRanges
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import (
    AGREEING_NATS,
    AGREEING_S,
    AGREEING_SCATTER,
    FEWEST_RECEIVERS,
    LEADING_NATS,
    NAMED_NATS,
    RANGES_AGE_S,
    SCATTERED,
    SCATTERED_S,
)
from estimators.model.measurements import Matrix, Vector

LONGEST_GAP_BINS = 480
"""After so long without anything to be held against anything, the slow errors are begun anew."""

BINS_KEPT = 40
"""Of a fault that is so young all is begun again from before it, without whom it is of."""
BINS_BEFORE = 4
"""So many before its likeliest begin."""
BINS_JUDGED = 12
"""The last of them tell of the others again: two may have gone wrong at once."""


@dataclass(frozen=True, slots=True)
class Named:
    """Something that is off."""

    since_tick: int
    odds_nats: float
    shift_m: Vector
    """Of now: ``(3,)`` NED of a receiver, ``(1,)`` of ranges."""
    agreeing_s: float = 0.0


class NamingMonitor:
    """Names receivers and ranges; ``own`` is whose place `separation_m` is of."""

    def __init__(self, own: int, period_s: float) -> None:
        self._own = own
        self._baselines = Baselines(period_s)
        self._slow = SlowErrors()
        self._odds = FaultOdds(AGREEING_NATS)
        self._spoiled = SpoiledRanges()
        self._before: deque[tuple[Bin, Vector, Matrix]] = deque(maxlen=BINS_KEPT)
        """The last bins, and what was known before each."""
        self._jumped_nats: dict[int, float] = {}
        """Odds of each receiver having jumped, since what is new is so large."""
        self._last: int | None = None
        """The last bin taken in."""
        self.named: dict[int, Named] = {}
        """Receivers that are off, by id."""
        self.ranges_off: dict[Pair, Named] = {}
        """Ranges that are off."""
        self._somebody: Named | None = None
        """Somebody, it cannot be told who."""
        self.separation_m: Vector = np.zeros(3)
        """``(3,)``, per axis: how far the own place moves at most if a receiver or ranges that do not agree are left
        out."""
        self.receivers = 0
        """Receivers not named that are ranged to."""

    @property
    def unattributable_nats(self) -> float:
        """Odds of somebody being off where it cannot be told who; 0: nobody, or it can.

        While they begin to agree again, those from which on they do not.
        """
        return 0.0 if self._somebody is None else max(self._somebody.odds_nats, AGREEING_NATS)

    def observe(self, evidence: SharedTick) -> tuple[Finding, ...]:
        """A finding about each receiver and pair that is off; one about nobody where it is not told whose."""
        if set(evidence.agents) != set(self._slow.agents):
            self._keep(evidence.agents)
        for closed in self._baselines.take(evidence):
            self._look(closed, evidence.tick)
        return tuple(self._findings())

    def _findings(self) -> Iterator[Finding]:
        for agent, each in sorted(self.named.items()):
            yield Finding(What.RECEIVER_OFF, Gravity.DEGRADED, agent, float(np.linalg.norm(each.shift_m)))
        for pair, each in sorted(self.ranges_off.items()):
            detail = f"ranges between {pair[0]} and {pair[1]}"
            yield Finding(What.RANGES_OFF, Gravity.DEGRADED, pair[0], float(each.shift_m[0]), detail=detail)
        if self.unattributable_nats:
            yield Finding(What.SOMEBODY_OFF, Gravity.ALARM, value=self.unattributable_nats, limit=NAMED_NATS)

    def _keep(self, agents: tuple[int, ...]) -> None:
        self._slow.keep(agents)
        self._restart_odds()
        self._before.clear()
        self._somebody = None
        self.named = {agent: each for agent, each in self.named.items() if agent in agents}
        self.ranges_off = {pair: each for pair, each in self.ranges_off.items() if set(pair) <= set(agents)}

    def _look(self, closed: Bin, tick: int) -> None:
        self._pass_by(closed.number)
        self._before.append((closed, self._slow.state, self._slow.covariance.copy()))
        self._find_spoiled(closed, tick)
        there = [pair for pair in closed.pairs if all(agent in closed.fix_variance_m2 for agent in pair)]
        chosen = self._chosen(closed)
        if chosen:
            self.receivers = len({agent for pair in chosen for agent in pair})
            if self._somebody is not None and self.receivers < FEWEST_RECEIVERS:
                self._reconsider_somebody(self._somebody, closed, chosen)
            else:
                fresh, now = self._learn(closed, chosen)
                self._note_jumps(fresh, now)
                self.separation_m = self._separation(now)
                self._judge(now, tick)
        for agent in list(self.named):
            mine = sorted(pair for pair in there if agent in pair and not self._is_doubted(pair, but=agent))
            self._reconsider_receiver(agent, closed, mine)
        for pair in list(self.ranges_off):
            if pair in there and not any(agent in self.named for agent in pair):
                self._reconsider_ranges(pair, closed)
            elif pair in closed.pairs:
                self._reconsider_unheld(pair, closed.pairs[pair].ranging)
            elif pair in closed.unheld:
                self._reconsider_unheld(pair, closed.unheld[pair])

    def _learn(self, made: Bin, chosen: list[Pair]) -> tuple[Fresh, Odds]:
        """What is new in a bin, learnt from, and the odds of faults after it."""
        fresh = self._slow.fresh(made, chosen)
        spoiled = self._spoiled.take(fresh, AGREEING_NATS)
        # nothing is learnt from ranges that look spoiled: it would hide that they are
        speaks = self._spoiled.speaks_nats > AGREEING_NATS
        gain = np.zeros_like(fresh.rows.T) if speaks else self._slow.take(fresh)
        now = self._odds.take(made.number, self._slow, fresh, gain)
        for pairs, fault in spoiled.items():
            if pairs not in now.ranges or now.ranges[pairs].nats < fault.nats:
                now.ranges[pairs] = fault
        return fresh, now

    def _find_spoiled(self, closed: Bin, tick: int) -> None:
        """Ranges that repeat, scatter as without a line of sight, or differ by end are off, whatever their mean is.

        Where nearly all scatter it is what they claim that is wrong. What stands before half of a drone's neighbours
        stands before the others, too: for them less is enough.
        """
        scatters = [each.ranging.scatter for each in closed.pairs.values()]
        usual = max(float(np.quantile(scatters or [1.0], 0.25)), 1.0)
        known = [(pair, each) for pair, each in closed.pairs.items() if not self._is_doubted(pair)]
        hidden = {agent for agent in self._slow.agents if self._is_hidden(agent, closed)}
        limits = {pair: usual * (AGREEING_SCATTER if hidden & set(pair) else SCATTERED) for pair, _ in known}
        found = {pair: each.residual_m for pair, each in known if each.ranging.is_spoiled(limits[pair])}
        unheld = [pair for pair, each in closed.unheld.items() if each.impossible and pair not in self.ranges_off]
        for pair, residual_m in (found | dict.fromkeys(unheld, 0.0)).items():
            self.ranges_off[pair] = Named(tick, NAMED_NATS, np.array([residual_m]))
        if found and not self._begin_again(SCATTERED_S, but_last=True):
            self._restart_odds()

    def _is_hidden(self, agent: int, closed: Bin) -> bool:
        """Whether the ranges to half of a drone's neighbours are off, and to more than one."""
        of_agent = [pair for pair in closed.pairs if agent in pair]
        off = sum(pair in self.ranges_off for pair in of_agent)
        return off >= max(2.0, 0.5 * len(of_agent))

    def _note_jumps(self, fresh: Fresh, now: Odds) -> None:
        """While what is new is so large: the odds of jumps, of all such bins in a row, where they are better."""
        if fresh.square < JUMPED_SQUARE:
            self._jumped_nats = {}
            return
        for agent in {agent for pair in fresh.pairs for agent in pair}:
            found = jump(fresh, agent)
            if found is None:
                continue
            nats = self._jumped_nats[agent] = self._jumped_nats.get(agent, 0.0) + found.nats
            if agent not in now.receivers or now.receivers[agent].nats < nats:
                now.receivers[agent] = replace(found, nats=nats)

    def _restart_odds(self) -> None:
        self._odds.restart(self._slow)
        self._spoiled.restart()

    def _pass_by(self, number: int) -> None:
        passed = 1 if self._last is None else number - self._last
        if not 0 < passed <= LONGEST_GAP_BINS:
            self._slow.forget(range(len(self._slow.state)))
            self._restart_odds()
            self._before.clear()
        else:
            self._slow.pass_by(passed)
            self._odds.pass_by(self._slow, passed)
        self._last = number

    def _is_doubted(self, pair: Pair, but: int | None = None) -> bool:
        """Whether what is left over of a pair is of ranges that are off, or of a receiver besides one."""
        return pair in self.ranges_off or any(agent in self.named for agent in pair if agent != but)

    def _judge(self, now: Odds, tick: int) -> None:
        self._somebody = None
        ranked: list[tuple[int | tuple[Pair, ...], LikelyFault]] = [*now.receivers.items(), *now.ranges.items()]
        if not ranked:
            return
        whose, fault = max(ranked, key=lambda entry: entry[1].nats)
        if fault.nats <= NAMED_NATS:
            return
        if self.receivers < FEWEST_RECEIVERS:
            self._somebody = Named(tick, fault.nats, fault.shift_m)
            self._go_back(fault)
            return
        rival_nats = max((each.nats for other, each in ranked if not _holds(other, whose)), default=0.0)
        if fault.nats - rival_nats > LEADING_NATS:
            self._name(whose, fault, tick)

    def _name(self, whose: int | tuple[Pair, ...], fault: LikelyFault, tick: int) -> None:
        if not isinstance(whose, int) and fault.age_s < RANGES_AGE_S:
            return
        if isinstance(whose, int):
            self.named[whose] = Named(tick, fault.nats, fault.shift_m)
        else:
            shifts = fault.shift_m * ((1.0, -1.0) if len(whose) == 2 else np.ones(len(whose)))
            for pair, shift in zip(whose, shifts, strict=True):
                self.ranges_off[pair] = Named(tick, fault.nats, np.array([shift]))
        self._jumped_nats = {}
        self._unlearn(fault)
        if isinstance(whose, int):
            self._slow.forget(self._slow.of_agent(whose))

    def _unlearn(self, fault: LikelyFault) -> None:
        """What a fault has taught: begin again from before it; of an old one, which is small, take out its effect."""
        if not self._begin_again(fault.age_s):
            self._slow.correct(fault.effect, fault.error, fault.covariance)
            self._restart_odds()

    def _go_back(self, fault: LikelyFault) -> None:
        """Know what was known before a fault of nobody knows whom, lest it be learnt."""
        back = round(fault.age_s / BIN_S) + BINS_BEFORE
        if back > len(self._before):
            self._slow.correct(fault.effect, fault.error, fault.covariance)
        else:
            _, self._slow.state, self._slow.covariance = self._before[-back]
            self._slow.pass_by(self._before[-1][0].number - self._before[-back][0].number)
        self._jumped_nats = {}
        self._restart_odds()

    def _begin_again(self, age_s: float, *, but_last: bool = False) -> bool:
        """Learn again from what was a while ago on, without who is off; false where that is not kept.

        ``but_last``: the last bin has not been learnt from yet.
        """
        back = round(age_s / BIN_S) + BINS_BEFORE
        if back > len(self._before):
            return False
        again = list(self._before)[-back:]
        _, self._slow.state, self._slow.covariance = again[0]
        self._restart_odds()
        for at, (made, _, _) in enumerate(again):
            passed = made.number - again[at - 1][0].number if at else 0
            self._slow.pass_by(passed)
            self._odds.pass_by(self._slow, passed)
            chosen = [] if but_last and at == len(again) - 1 else self._chosen(made)
            if chosen and len(again) - at > BINS_JUDGED:
                self._slow.take(self._slow.fresh(made, chosen))
            elif chosen:
                self._learn(made, chosen)
        return True

    def _chosen(self, made: Bin) -> list[Pair]:
        """The pairs of nobody who is off."""
        known = made.fix_variance_m2
        return sorted(pair for pair in made.pairs if set(pair) <= known.keys() and not self._is_doubted(pair))

    def _separation(self, now: Odds) -> Vector:
        """How far the own place moves if somebody who does not agree is left out."""
        if self._own not in self._slow.agents:
            return np.zeros(3)
        own = list(self._slow.of_agent(self._own))
        moved: list[Vector] = [np.zeros(3)]
        for agent, each in now.receivers.items():
            shift = each.shift_m if agent == self._own else 0.0
            moved.append(np.abs(each.effect[own] @ each.error - shift))
        for each in now.ranges.values():
            moved.append(np.abs(each.effect[own] @ each.error))
        return np.asarray(np.max(moved, axis=0))

    def _reconsider_receiver(self, agent: int, closed: Bin, mine: list[Pair]) -> None:
        """Take a named receiver back once it agrees with those who are not named."""
        if not mine:
            return
        fresh = self._slow.fresh(closed, mine)
        columns = fresh.whiten @ (fresh.sign(agent)[:, None] * fresh.directions)
        again = _again(self.named[agent], *_alone(fresh.value, columns, np.square(STEP_M)))
        if again is None:
            del self.named[agent]
            self._slow.forget(self._slow.of_agent(agent))
        else:
            self.named[agent] = again

    def _reconsider_somebody(self, held: Named, closed: Bin, chosen: list[Pair]) -> None:
        """That somebody is off stands until all agree with what was known before."""
        fresh = self._slow.fresh(closed, chosen)
        found = {}
        for agent in sorted({agent for pair in chosen for agent in pair}):
            columns = fresh.whiten @ (fresh.sign(agent)[:, None] * fresh.directions)
            found[agent] = _alone(fresh.value, columns, np.square(STEP_M))
        nats = max(each for each, _ in found.values())
        self.separation_m = np.abs(found[self._own][1]) if self._own in found else np.zeros(3)
        self._somebody = _again(held, nats, held.shift_m)
        if self._somebody is None:
            self.separation_m = np.zeros(3)
            self._restart_odds()

    def _reconsider_ranges(self, pair: Pair, closed: Bin) -> None:
        """The same of ranges."""
        fresh = self._slow.fresh(closed, [pair])
        nats, shift_m = _alone(fresh.value, fresh.whiten, np.square([RANGES_STEP_M]))
        spoiled = closed.pairs[pair].ranging.is_spoiled(AGREEING_SCATTER)
        self._keep_ranges(pair, NAMED_NATS if spoiled else nats, shift_m)

    def _reconsider_unheld(self, pair: Pair, ranging: Ranging) -> None:
        """Ranges to a drone without fixes that count: they are taken back if nothing in themselves speaks against it,
        as that drone has nothing else, and whoever uses them weighs them by what else is known."""
        spoiled = ranging.is_spoiled(AGREEING_SCATTER)
        self._keep_ranges(pair, NAMED_NATS if spoiled else 0.0, self.ranges_off[pair].shift_m)

    def _keep_ranges(self, pair: Pair, nats: float, shift_m: Vector) -> None:
        """As they are after another bin, or no longer off."""
        again = _again(self.ranges_off[pair], nats, shift_m)
        if again is None:
            del self.ranges_off[pair]
        else:
            self.ranges_off[pair] = again


def _holds(other: int | tuple[Pair, ...], whose: int | tuple[Pair, ...]) -> bool:
    """Whether somebody's being off holds that of somebody else, so that it explains no less and is no rival."""
    if isinstance(other, int) or isinstance(whose, int):
        return other == whose
    return set(whose) <= set(other)


def _again(held: Named, nats: float, shift_m: Vector) -> Named | None:
    """What is held of somebody who is off after another bin; ``None``: it has agreed for long enough."""
    agreeing_s = held.agreeing_s + BIN_S if nats < AGREEING_NATS else 0.0
    if agreeing_s > AGREEING_S:
        return None
    return replace(held, odds_nats=nats, shift_m=shift_m, agreeing_s=agreeing_s)


def _alone(fresh: Vector, columns: Matrix, variance: Vector) -> tuple[float, Vector]:
    """Odds, nats, of an error along whitened columns ``(m, k)``, of a prior ``variance`` ``(k,)``, against none in
    one bin alone; and that error, its mean."""
    projected = columns.T @ fresh
    information = columns.T @ columns + np.diag(1.0 / variance)
    error = np.asarray(np.linalg.solve(information, projected), np.float64)
    size = float(np.linalg.slogdet(information * variance)[1])
    return 0.5 * float(projected @ error) - 0.5 * size, error
