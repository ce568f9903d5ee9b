"""What an agent promises of positions, tick by tick: who is off, what is certain, protection levels, state. Sans-I/O.

It sees the rows before the estimator does, so that fixes of a receiver that is off never reach it, and the estimate
after it. The monitors are those of `estimators.integrity`: `exclusion`, `sets`, `protection`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from agent.config.integrity_table import IntegrityTable
from agent.config.tables import FleetConfig
from agent.watch.health import reason_of
from estimators.estimator import Estimate
from estimators.integrity.exclusion.baselines import SharedTick
from estimators.integrity.exclusion.naming import NamingMonitor
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.protection.levels import error_ellipse, protection_level, relative_covariance
from estimators.integrity.protection.statement import AlertLimits, Guaranteed, Statement, judged, undetectable
from estimators.integrity.protection.targets import TargetState, target_state
from estimators.integrity.sets.bank import BoundedTick, SensorBounds, SetBank
from estimators.model.layout import position
from estimators.model.measurements import Kind, RowTable, Vector

RECEIVER_KINDS = (Kind.POSITION, Kind.VELOCITY, Kind.SPEED)


class IntegrityWatch:
    """Of one drone; `statement` is that of the latest estimate."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        table, period_s = config.integrity, config.fleet.period_s
        self._agent_id, self._period_s = agent_id, period_s
        self._targets = tuple(target.id for target in config.targets)
        self._exclude = table.exclude
        self._limits = AlertLimits(table.alert_horizontal_m, table.alert_vertical_m)
        self._naming = NamingMonitor(agent_id, period_s)
        self._bank = SetBank(period_s, bounds_of(table, config.estimator.limits.vehicle.speed_mps))
        self._taken: SharedTick | None = None
        self._named: tuple[Finding, ...] = ()
        self._frozen = False
        self._frozen_at: Vector | None = None
        """``(3,)``: where the drone was when its receiver was first found frozen."""
        self.statement: Statement | None = None

    def take(self, tick: int, members: tuple[int, ...], rows: RowTable) -> RowTable:
        """The rows of a tick, by slot of ``members``, less those of receivers and ranges that are off."""
        self._named = self._naming.observe(SharedTick(tick, members, rows))
        kept = self._without_those_off(members, rows) if self._exclude else rows
        self._taken = SharedTick(tick, members, kept)  # nor are they a guarantee of anything
        return kept

    def _without_those_off(self, members: tuple[int, ...], rows: RowTable) -> RowTable:
        kept = np.ones(len(rows), np.bool_)
        off = [slot for slot, agent in enumerate(members) if agent in self._naming.named]
        if off:
            kept &= ~(np.isin(rows["kind"], RECEIVER_KINDS) & np.isin(rows["agent"], off))
        for pair in self._naming.ranges_off:
            slots = [members.index(agent) for agent in pair]
            kept &= ~((rows["kind"] == Kind.RANGE) & np.isin(rows["agent"], slots) & np.isin(rows["other"], slots))
        return rows if kept.all() else rows[kept]

    def note_frozen(self, *, frozen: bool) -> None:
        """Whether the own receiver repeats a fix that its own velocity contradicts; such fixes are no rows."""
        self._frozen = frozen
        if not frozen:
            self._frozen_at = None

    def observe(self, estimate: Estimate, present: tuple[int, ...]) -> tuple[Finding, ...]:
        """What is found with an estimate of those present, about ids, ``None`` for the own drone."""
        found: tuple[Finding, ...] = ()
        if self._taken is not None and self._taken.tick == estimate.tick and self._taken.agents == present:
            own, places = present.index(self._agent_id), estimate.mean.reshape(-1, 6)[:, :3]
            relative = {agent: places[slot] - places[own] for slot, agent in enumerate(present) if slot != own}
            tick = BoundedTick(estimate.tick, present, own, self._taken.rows, relative)
            found = (*self._named, *self._bank.observe(tick))
        if self._frozen:
            found = (Finding(What.RECEIVER_FROZEN, Gravity.DEGRADED, self._agent_id), *found)
        return tuple(replace(each, about=None) if each.about == self._agent_id else each for each in found)

    def state(self, estimate: Estimate, present: tuple[int, ...], findings: Iterable[Finding]) -> Statement:
        """The statement that follows from an estimate and all that was found."""
        own = present.index(self._agent_id)
        covariance = estimate.covariance
        mine = covariance[position(own), position(own)]
        level = protection_level(mine, self._naming.separation_m)
        state, why = judged(findings, level, self._limits)
        sets = self._bank.sets
        self.statement = Statement(
            state,
            why if isinstance(why, str) else reason_of(why),
            error_ellipse(mine),
            level,
            {
                agent: protection_level(relative_covariance(covariance, own, slot), np.zeros(3))
                for slot, agent in enumerate(present)
                if slot != own
            },
            {agent: Guaranteed(each.half_axes(), each.min_range()) for agent, each in sets.items()},
            self._off(estimate.mean[position(own)]),
            tuple(sorted(self._naming.ranges_off)),
            self._naming.unattributable_nats > 0.0,
            undetectable(self._naming.receivers),
            {target: self._target(target, estimate, present) for target in self._targets},
        )
        return self.statement

    def _target(self, target_id: int, estimate: Estimate, present: tuple[int, ...]) -> TargetState:
        if target_id not in present:
            return TargetState.NOT_FOUND
        slot = present.index(target_id)
        sigma_m = float(np.sqrt(estimate.covariance.diagonal()[position(slot)].max()))
        unseen_s = float(estimate.age_ticks[slot]) * self._period_s
        return target_state(sigma_m, unseen_s, observable=bool(estimate.observable[slot]))

    def _off(self, place_m: Vector) -> dict[int, float]:
        """Whose fixes are off, by how much; a frozen receiver by how far the drone has moved since."""
        off = {agent: float(np.linalg.norm(each.shift_m)) for agent, each in self._naming.named.items()}
        if self._frozen:
            self._frozen_at = place_m.copy() if self._frozen_at is None else self._frozen_at
            off.setdefault(self._agent_id, float(np.linalg.norm(place_m - self._frozen_at)))
        return off


def bounds_of(table: IntegrityTable, speed_mps: float | None) -> SensorBounds:
    """The hard bounds that a configuration states of sensors whose rows state none."""
    across = _bound(table.position_bound_m)
    up = across if table.height_bound_m is None else table.height_bound_m
    return SensorBounds(
        (across, across, up),
        _bound(table.velocity_bound_mps),
        _bound(table.range_bound_m),
        _bound(table.acceleration_bound_mps2),
        _bound(speed_mps),
    )


def _bound(value: float | None) -> float:
    return math.inf if value is None else value
