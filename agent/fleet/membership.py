"""Who is part of the estimate: drones join where they are located, and are let go when nothing speaks of them.

The configuration lists who may come. A drone that is not located has no block, and what is measured of it waits: a
range linearised about a wrong place would make a wrong place certain. Located is who has fixes of late, or ranges
that leave one place only, or is well known to a neighbour. The agent's own block is always there; until it is
located the estimate says so (`Status.NOT_OBSERVABLE`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.fleet.fix_tracks import FixTracks
from agent.fleet.locating import RangeLocator
from agent.fleet.motions import Motions
from estimators.estimator import Estimate
from estimators.integrity.finding import Finding
from estimators.integrity.range_geometry import GeometryMonitor, RangeGeometry
from estimators.integrity.thresholds import HELD_SIGMA_M, RANGED_TICKS, TOLD_SIGMA_M
from estimators.model.gaussian import Prior, marginal_pair
from estimators.model.layout import STATES_PER_AGENT, block, position
from estimators.model.measurements import Vector
from estimators.model.unknown_motion import silence_sigma_m
from transport.messages.estimate_body import MAX_AGE_TICKS
from transport.messages.information_body import Information
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    AnchorRangeMeasurement,
    Measurement,
    OrientationMeasurement,
    RangeMeasurement,
)
from transport.messages.window_body import WindowStates

ATTEMPT_EVERY_S = 0.3
"""Places by ranges are sought this often: an attempt takes some milliseconds."""
INFORMED_SHARE = 0.25
"""A position this much surer than silence would have left it has been spoken of on the way."""


def is_absent(age_ticks: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
    """Which drones are no part of an estimate, by their ages in it."""
    return np.asarray(age_ticks >= MAX_AGE_TICKS)


def _pair(one: int, other: int) -> tuple[int, int]:
    """Two agents, in either order."""
    return (one, other) if one < other else (other, one)


class Membership:
    """The drones of the estimate and what is known of the others; ``members`` in the order of the configuration."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._config = config
        self._agent_id = agent_id
        self._period_s = config.fleet.period_s
        self._motions = Motions(config)
        self._tracks = FixTracks(config, self._motions)
        self._locator = RangeLocator(config, self._motions)
        self._geometry = GeometryMonitor()
        self._heard: dict[int, int] = {}
        self._sensed: set[int] = set()
        """Whose own fixes or ranges came, not only accelerations, which may travel farther."""
        self._ranged: dict[tuple[int, int], int] = {}
        """Tick of the last range, by the ids of its ends."""
        self._anchored: dict[tuple[int, int], int] = {}
        """Tick of the last range, by the ids of a drone and an anchor."""
        self._joined: dict[int, int] = {}
        self._held: dict[int, int] = {}
        """When the ranges to a drone that is silent itself last held it."""
        self._told: dict[int, tuple[int, Prior]] = {}
        self._sigma_m: dict[int, float] = {}
        self._places: dict[int, Vector] = {}
        self._targets = frozenset(config.kinds)
        self._attempt_ticks = max(round(ATTEMPT_EVERY_S / config.fleet.period_s), 1)
        self.members: tuple[int, ...] = ()
        self.own_located = False
        self.wanted: frozenset[int] | None = None
        """Who may be a member; ``None``: everybody (`agent.fleet.joint_choice`)."""

    @property
    def located(self) -> tuple[int, ...]:
        """The members whose measurements can be used."""
        return self.members if self.own_located else tuple(a for a in self.members if a != self._agent_id)

    @property
    def own_location(self) -> tuple[Finding, ...]:
        """Why the own ranges did not locate this drone, while it is not located."""
        return () if self.own_located else self._locator.findings.get(self._agent_id, ())

    # --- what comes in -------------------------------------------------------------------------------------

    def note(self, record: Measurement, tick: int) -> None:
        """A record, own or heard."""
        when = min(record.tick, tick)
        if when > self._heard.get(record.observer, -math.inf):
            self._heard[record.observer] = when
        if isinstance(record, AccelerationMeasurement):
            self._motions.note(record)
            return
        if isinstance(record, OrientationMeasurement):
            self._locator.note(record)
            return
        self._sensed.add(record.observer)
        if isinstance(record, RangeMeasurement):
            self._locator.note(record)
            pair = _pair(record.observer, record.other)
            if when > self._ranged.get(pair, -math.inf):
                self._ranged[pair] = when
            if record.other in self._targets and when > self._heard.get(record.other, -math.inf):
                self._heard[record.other] = when
        elif isinstance(record, AnchorRangeMeasurement):
            self._locator.note(record)
            self._note_anchor(record, when)
        else:
            self._tracks.note(record)

    def note_window(self, message: WindowStates) -> None:
        """A neighbour's window: drones that are not located here, as sure as such a word can be."""
        for agent in filter(self._is_news, message.agents):
            place, velocity = np.split(message.path[0, block(message.agents.index(agent))], 2)
            self._told[agent] = message.state_tick, self._tracks.prior(place, velocity)

    def _note_anchor(self, record: AnchorRangeMeasurement, when: int) -> None:
        """A range to an anchor: of those that are known, the nearest to where the record has it, less a lever arm."""
        known = self._config.anchors
        if known:
            nearest = min(known, key=lambda anchor: math.dist(anchor.position_m, record.anchor_m))
            at = record.observer, nearest.id
            self._anchored[at] = max(when, self._anchored.get(at, when))

    def note_pair(self, message: Information) -> None:
        """A neighbour's pair: what it knows well of drones that are not located here."""
        for agent in filter(self._is_news, message.agents):
            try:
                information, vector = marginal_pair(
                    (message.information, message.vector), [message.agents.index(agent)]
                )
                covariance = np.linalg.inv(information)
            except np.linalg.LinAlgError:
                continue  # the pair says nothing of this one
            sigma_m = float(np.sqrt(max(covariance.diagonal()[:3].max(), 0.0)))
            if sigma_m < TOLD_SIGMA_M:
                self._told[agent] = message.state_tick, self._tracks.prior(*np.split(covariance @ vector, 2))

    def _is_news(self, agent: int) -> bool:
        """Whether what a neighbour says of a drone may locate it."""
        known = agent in self.located or (agent in self._sensed and agent != self._agent_id)
        return not known and self.may_be_member(agent)

    def note_estimate(self, estimate: Estimate) -> None:
        """The latest estimate of the members."""
        variances = estimate.covariance.diagonal().reshape(-1, STATES_PER_AGENT)[:, :3]
        sigmas_m = np.sqrt(variances.max(axis=1)).tolist()
        self._sigma_m, known, located = dict(zip(self.members, sigmas_m, strict=True)), {}, self.located
        for slot, agent in enumerate(self.members):
            mean, at = estimate.mean[block(slot)], position(slot)
            self._places[agent] = mean[:3]
            if agent in located:
                known[agent] = mean, estimate.covariance[at, at]
        self._locator.note_places(estimate.tick, known)
        for agent in self.members:
            silent = estimate.tick - self._heard.get(agent, -math.inf) > RANGED_TICKS
            near = self._sigma_m[agent] < HELD_SIGMA_M
            if silent and near and not self._geometry.observe(self.geometry(agent, estimate.tick)):
                self._held[agent] = max(t for pair, t in self._ranged.items() if agent in pair)

    def usable(self, tick: int) -> tuple[int, ...]:
        """The located members but those that fell silent and that ranges do not hold.

        A few ranges to a drone that moves unseen confine it to a circle, which no Gaussian is like: they would make
        it certain of a place on it.
        """
        limit = self._config.transport.neighbour_timeout_s / self._period_s
        return tuple(agent for agent in self.located if self.silent_ticks(agent, tick) <= limit)

    def silent_ticks(self, agent: int, tick: int) -> int:
        """Ticks since a drone was heard or held; 0 for one that is known from neighbours' pairs alone."""
        if agent == self._agent_id or agent not in self._heard:
            return 0
        return max(tick - max(self._heard[agent], self._held.get(agent, 0)), 0)

    # --- who is in -----------------------------------------------------------------------------------------

    def newcomers(self, tick: int, at_tick: int) -> dict[int, Prior]:
        """Drones located since, with their priors at ``at_tick``: new ones, and those that had been lost sight of."""
        found: dict[int, Prior] = {}
        usable = self.usable(tick)
        for agent in self._config.bodies:
            if agent not in usable and self.may_be_member(agent):
                prior = self._place(agent, tick, at_tick)
                if prior is not None:
                    found[agent] = prior
        self._told = {}
        return found

    def gone(self, tick: int) -> tuple[int, ...]:
        """Members of which nothing is known any more but what silence has left, and who are not wanted any more."""
        others = (agent for agent in self.members if agent != self._agent_id)
        return tuple(agent for agent in others if not self.may_be_member(agent) or self._is_gone(agent, tick))

    def enter(self, joined: Iterable[int], left: Collection[int], tick: int) -> None:
        """Change the members; the own drone is one of them from the first on."""
        joined = set(joined)
        self.own_located |= self._agent_id in joined
        wanted = (set(self.members) | joined | {self._agent_id}) - set(left)
        self.members = tuple(agent for agent in self._config.bodies if agent in wanted)
        for agent in joined:
            self._joined[agent] = self._held[agent] = tick

    def return_to(self, members: tuple[int, ...], *, own_located: bool) -> None:
        """Undo a change that was not estimated with: who joined then has to be located again."""
        self.members, self.own_located = members, own_located

    def geometry(self, agent: int, tick: int) -> RangeGeometry:
        """A drone and the located drones that it is ranged to; only who is heard itself holds another."""
        if agent not in self._places:
            return RangeGeometry.of(np.zeros(3), np.empty((0, 3)), np.empty(0))
        near = [
            (self._places[other], float(tick - min(self._heard.get(other, -math.inf), when)))
            for other in self.located
            if other in self._places and (when := self._ranged.get(_pair(agent, other))) is not None
        ]
        near += [
            (np.array(anchor.position_m), float(tick - when))
            for anchor in self._config.anchors
            if (when := self._anchored.get((agent, anchor.id))) is not None
        ]
        places = np.array([place for place, _ in near]).reshape(-1, 3)
        return RangeGeometry.of(self._places[agent], places, np.array([age for _, age in near]))

    def distance_m(self, one: int, other: int) -> float | None:
        """Between two members in the latest estimate; ``None`` where one is none, or both are at one place."""
        if not {one, other} <= set(self.members) or not {one, other} <= self._places.keys():
            return None
        return float(np.linalg.norm(self._places[one] - self._places[other])) or None

    def may_be_member(self, agent: int) -> bool:
        """Whether an agent is wanted in the estimate."""
        return self.wanted is None or agent in self.wanted or agent in self._targets

    def _place(self, agent: int, tick: int, at_tick: int) -> Prior | None:
        heard = tick - self._heard.get(agent, -math.inf) <= RANGED_TICKS
        place = self._tracks.place(agent, at_tick) if heard else None
        if place is None and tick % self._attempt_ticks == 0:
            is_target = agent in self._targets
            locate = self._locator
            place = locate.place_target(agent, at_tick, tick) if is_target else locate.place(agent, at_tick)
        if place is None and agent in self._told:
            told_tick, (mean, covariance) = self._told[agent]
            moved = mean[:3] + (at_tick - told_tick) * self._period_s * mean[3:]
            place = np.concatenate((moved, mean[3:])), covariance
        return place

    def _is_gone(self, agent: int, tick: int) -> bool:
        since = max(self._heard.get(agent, 0), self._held.get(agent, 0), self._joined.get(agent, 0))
        silent_s = (tick - since) * self._period_s
        if silent_s <= self._config.fleet.absent_after_s:
            return False
        if agent in self._heard:
            return True
        # known from neighbours' pairs alone: as long as they keep it surer than silence would leave it
        variance = self._config.estimator.other_accel_variance
        return self._sigma_m.get(agent, 0.0) >= INFORMED_SHARE * silence_sigma_m(silent_s, variance, self._period_s)
