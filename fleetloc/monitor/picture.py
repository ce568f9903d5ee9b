"""The picture of a fleet, built from what its drones send; sans-I/O.

Messages come in with ``now_s``, seconds of a monotonic clock, and a picture of any moment can be taken out. What
a drone said last stays shown, with its age: a drone that went silent is lost, not gone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from agent.config.tables import FleetConfig, TargetTable
from agent.fleet.far_field import moments, moved_on
from estimators.model.layout import Layout, block, position
from fleetloc.monitor.alarms import DroneFacts, alarms_of_drone, alarms_of_fleet
from fleetloc.monitor.links import LinkHistory, link_view, overdue_s
from fleetloc.monitor.monitor_table import monitor_table
from fleetloc.monitor.views import Alarm, Drone, Ellipse, Level, Link, Picture, SeenBy, Target, Tracks, Triple
from transport.messages.estimate_body import MAX_AGE_TICKS, FleetEstimate, Matrix
from transport.messages.far_body import FarReport, FarReports
from transport.messages.report_body import Diagnostics

SIGMAS = 3.0
STALE_AFTER_S = 1.0
"""An estimate older than this (or than three periods) is shown as stale."""
LOST_AFTER_S = 2.0
"""A drone silent for longer than this (or than six periods) is shown as lost; one that left, at once."""
TRACK_SPACING_S = 0.2
MAX_PLACED_SIGMA_M = 1000.0
"""A position known worse than this is none, and is not drawn."""
DIAGNOSTICS_STALE_S = 3.5
"""They come once a second; three missing ones in a row are a silence."""
FIX_NAMES = {0: "no GPS", 1: "no fix", 2: "2-D", 3: "3-D", 4: "DGPS", 5: "RTK float", 6: "RTK fixed"}
STATE_LEVELS: dict[str, Level] = {
    "ok": "ok",
    "degraded": "warning",
    "aligning": "info",
    "init": "info",
    "fault": "bad",
}
SEVERITY = ("bad", "warning", "info", "ok")


@dataclass(slots=True)
class _Heard:
    """The latest of one drone."""

    present: bool = False
    left_s: float | None = None
    """When its presence was withdrawn, if nothing came since."""
    estimate: FleetEstimate | None = None
    estimate_s: float = -np.inf
    diagnostics: Diagnostics | None = None
    diagnostics_s: float = -np.inf
    track: deque[tuple[float, Triple]] = field(default_factory=deque)

    @property
    def last_s(self) -> float:
        return max(self.estimate_s, self.diagnostics_s)

    @property
    def ever(self) -> bool:
        return self.present or self.left_s is not None or self.last_s > -np.inf


@dataclass(frozen=True, slots=True)
class _Reported:
    """A drone's own report, who passed it on, and when it was true, on the monitor's clock."""

    report: FarReport
    relay: int
    of_s: float


class FleetPicture:
    """Takes in what a fleet sends, gives its `Picture`."""

    def __init__(self, config: FleetConfig) -> None:
        monitor, period_s = monitor_table(config), config.fleet.period_s
        self._config = config
        self._track_s = monitor.track_s
        self._stale_after_s = max(STALE_AFTER_S, 3 * period_s)
        self._lost_after_s = max(LOST_AFTER_S, 6 * period_s)
        self._heard = {agent_id: _Heard() for agent_id in config.ids}
        self._far: dict[int, _Reported] = {}
        self._links: dict[tuple[int, int], LinkHistory] = {}
        self._since_unix_s: dict[tuple[int, str], float] = {}
        self._refused = LinkHistory()
        self._refusals: Mapping[str, int] = {}

    # --- in -------------------------------------------------------------------------------------------------

    def on_presence(self, agent_id: int, present: bool, now_s: float) -> None:
        """A drone showed itself, or its presence was withdrawn: it left, died, or its link to us broke."""
        heard = self._heard.get(agent_id)
        if heard is None:
            return  # of another roster: its packets are refused and counted
        heard.present = present
        heard.left_s = None if present else now_s

    def on_estimate(self, sender: int, estimate: FleetEstimate, now_s: float) -> None:
        """A drone's estimate of the fleet."""
        heard = self._heard[sender]
        heard.estimate, heard.estimate_s, heard.left_s = estimate, now_s, None
        if not _is_placed(estimate, sender):
            return
        if not heard.track or now_s - heard.track[-1][0] >= 0.9 * TRACK_SPACING_S:  # ticks jitter
            heard.track.append((now_s, _position(estimate, sender)))
        while heard.track and now_s - heard.track[0][0] > self._track_s:
            heard.track.popleft()

    def on_far_reports(self, sender: int, message: FarReports, now_s: float) -> None:
        """What a drone of a large fleet passes on of others: the newest report of each is kept."""
        for report in message.reports:
            known = self._far.get(report.agent)
            # a report of the future must not stand for good
            old = known is not None and now_s - known.of_s > self._config.fleet.absent_after_s
            if report.agent != sender and (known is None or old or report.tick > known.report.tick):
                age_s = (message.tick - report.tick) * self._config.fleet.period_s
                self._far[report.agent] = _Reported(report, sender, now_s - age_s)

    def on_diagnostics(self, diagnostics: Diagnostics, now_s: float) -> None:
        """What a drone says of itself."""
        receiver = diagnostics.agent_id
        heard = self._heard[receiver]
        heard.diagnostics, heard.diagnostics_s, heard.left_s = diagnostics, now_s, None
        for name, gauges in diagnostics.neighbours.items():
            if name.isdecimal() and int(name) in self._heard:
                history = self._links.setdefault((int(name), receiver), LinkHistory())
                history.add(now_s, int(gauges.get("received", 0)), int(gauges.get("lost", 0)))

    def on_refused(self, refusals: Mapping[str, int], now_s: float) -> None:
        """Packets that were refused so far, by reason."""
        self._refusals = dict(refusals)
        self._refused.add(now_s, 0, sum(refusals.values()))

    # --- out ------------------------------------------------------------------------------------------------

    def tracks(self) -> Tracks:
        """Where each drone said to have been."""
        points = {agent_id: [point for _, point in heard.track] for agent_id, heard in self._heard.items()}
        return Tracks(track_s=self._track_s, spacing_s=TRACK_SPACING_S, points=points)

    def at(self, now_s: float, unix_s: float) -> Picture:
        """The picture of a moment."""
        drones = tuple(self._drone(agent_id, now_s) for agent_id in self._heard)
        links = tuple(
            self._link(sender, receiver, now_s)
            for receiver in self._heard
            for sender in self._config.neighbours(receiver)
            if (sender, receiver) in self._links or self._config.fleet.edges is not None
        )
        return Picture(
            fleet=self._config.fleet.name,
            unix_s=unix_s,
            drones=drones,
            links=links,
            alarms=self._alarms(drones, now_s, unix_s),
            refused=dict(self._refusals),
            anchors=self._config.places_m,
            targets=tuple(self._target(target, now_s) for target in self._config.targets),
        )

    def _target(self, target: TargetTable, now_s: float) -> Target:
        seen = self._seen_by(target.id, now_s)
        estimate = None if seen is None else self._heard[seen.agent_id].estimate
        if seen is None or estimate is None:
            return Target(target_id=target.id, name=target.name)
        place = position(Layout(estimate.agents).slot(target.id))
        said = self._heard[seen.agent_id].diagnostics
        return Target(
            target_id=target.id,
            name=target.name,
            seen_by=seen,
            velocity_mps=_velocity(estimate, target.id),
            ellipse=ellipse_of(np.diag(estimate.variance[place])),
            state="" if said is None else said.targets.get(str(target.id), ""),
        )

    def _drone(self, agent_id: int, now_s: float) -> Drone:
        heard = self._heard[agent_id]
        status, level = self._status(heard, now_s)
        gauges = {} if heard.diagnostics is None else heard.diagnostics.gauges
        said_s = overdue_s(now_s - heard.diagnostics_s)
        fix = gauges.get("gps_fix_type")
        estimate = heard.estimate
        if estimate is not None and not _is_placed(estimate, agent_id):
            estimate = None
        return Drone(
            agent_id=agent_id,
            name=self._config.agent(agent_id).name,
            status=status,
            level=level,
            position_m=None if estimate is None else _position(estimate, agent_id),
            velocity_mps=None if estimate is None else _velocity(estimate, agent_id),
            ellipse=None if estimate is None else ellipse_of(estimate.own_covariance[:3, :3]),
            estimate_age_s=_age_s(heard.estimate_s, now_s),
            heard_age_s=_age_s(heard.last_s, now_s),
            gps="" if fix is None else FIX_NAMES.get(int(fix), f"fix type {int(fix)}"),
            gps_age_s=None if "gps_age_s" not in gauges else gauges["gps_age_s"] + said_s,
            tick_p99_s=gauges.get("tick_time_p99_s"),
            seen_by=self._seen_by(agent_id, now_s),
            integrity="" if heard.diagnostics is None else heard.diagnostics.integrity,
            protection_m=_protection_m(gauges),
        )

    def _status(self, heard: _Heard, now_s: float) -> tuple[str, Level]:
        if not heard.ever:
            return "unseen", "info"
        never_spoke = heard.last_s == -np.inf
        if heard.left_s is not None or (not never_spoke and now_s - heard.last_s > self._lost_after_s):
            return "lost", "bad"
        if never_spoke:
            return "there", "info"
        if heard.estimate is not None and now_s - heard.estimate_s > self._stale_after_s:
            return "stale", "warning"
        if heard.diagnostics is None:
            return "there", "info"
        state = heard.diagnostics.state
        return state, STATE_LEVELS.get(state, "warning")

    def _seen_by(self, agent_id: int, now_s: float) -> SeenBy | None:
        """What the drone that heard last of another body has of it, of those that are heard themselves."""
        views = []
        for other, heard in self._heard.items():
            estimate = heard.estimate
            if other == agent_id or estimate is None or agent_id not in estimate.agents:
                continue
            slot, since_s = Layout(estimate.agents).slot(agent_id), now_s - heard.estimate_s
            ticks = estimate.age_ticks[slot]
            sigma_m = float(np.sqrt(estimate.variance[position(slot)].sum()))
            silent = since_s > self._stale_after_s or heard.left_s is not None
            if silent or ticks >= MAX_AGE_TICKS or sigma_m > MAX_PLACED_SIGMA_M:
                continue
            age_s = ticks * self._config.fleet.period_s + since_s
            place = _position(estimate, agent_id)
            views.append(SeenBy(agent_id=other, position_m=place, sigma_m=sigma_m, age_s=age_s))
        if agent_id in self._far:
            views += self._reported(self._far[agent_id], now_s)
        return min(views, key=lambda view: (view.age_s, view.sigma_m), default=None)

    def _reported(self, far: _Reported, now_s: float) -> list[SeenBy]:
        """A drone as it reported itself, moved on to now; nothing of a report that its fleet has let go."""
        age_s = max(now_s - far.of_s, 0.0)
        if age_s > self._config.fleet.absent_after_s:
            return []
        mean, variance = moments(far.report)
        accel_variance = self._config.estimator.other_accel_variance
        mean, variance = moved_on(mean[None], variance[None], np.array([age_s]), accel_variance)
        north, east, down = mean[0, :3].tolist()
        sigma_m = float(np.sqrt(variance[0, :3].sum()))
        return [SeenBy(agent_id=far.relay, position_m=(north, east, down), sigma_m=sigma_m, age_s=age_s)]

    def _link(self, sender: int, receiver: int, now_s: float) -> Link:
        heard = self._heard[receiver]
        deaf = now_s - heard.diagnostics_s > DIAGNOSTICS_STALE_S or heard.left_s is not None
        gauges = None
        if heard.diagnostics is not None and not deaf:
            gauges = heard.diagnostics.neighbours.get(str(sender))
        history = self._links.get((sender, receiver), LinkHistory())
        timeout_s = self._config.transport.neighbour_timeout_s
        since_s = max(now_s - heard.diagnostics_s, 0.0)
        return link_view(sender, receiver, gauges, history.loss, since_s, timeout_s=timeout_s)

    def _alarms(self, drones: tuple[Drone, ...], now_s: float, unix_s: float) -> tuple[Alarm, ...]:
        found = []
        for drone in drones:
            heard = self._heard[drone.agent_id]
            fresh = heard.diagnostics if now_s - heard.diagnostics_s <= DIAGNOSTICS_STALE_S else None
            status = None if heard.estimate is None or drone.status in ("lost", "stale") else heard.estimate.status
            facts = DroneFacts(drone, fresh, status, left=heard.left_s is not None)
            found += [(drone.agent_id, *alarm) for alarm in alarms_of_drone(facts)]
        found += [(0, *alarm) for alarm in alarms_of_fleet(drones, self._refused.recent_lost(now_s), self._refusals)]
        known = {(agent_id, key) for agent_id, key, _, _ in found}
        self._since_unix_s = {which: when for which, when in self._since_unix_s.items() if which in known}
        alarms = [
            Alarm(
                agent_id=agent_id,
                level=level,
                text=text,
                since_unix_s=self._since_unix_s.setdefault((agent_id, key), unix_s),
            )
            for agent_id, key, level, text in found
        ]
        return tuple(sorted(alarms, key=lambda alarm: (SEVERITY.index(alarm.level), alarm.since_unix_s)))


def ellipse_of(covariance: Matrix) -> Ellipse:
    """The 3-sigma ellipse of a position covariance ``(3, 3)`` in NED m2."""
    variances, axes = np.linalg.eigh(covariance[:2, :2])
    minor, major = np.sqrt(np.maximum(variances, 0.0))
    north, east = axes[:, 1]
    return Ellipse(
        major_m=float(SIGMAS * major),
        minor_m=float(SIGMAS * minor),
        angle_rad=float(np.arctan2(east, north)),
        up_m=float(SIGMAS * np.sqrt(max(covariance[2, 2], 0.0))),
    )


def _protection_m(gauges: Mapping[str, float]) -> tuple[float, float] | None:
    """Horizontal and vertical; ``None`` where the position is as good as unknown."""
    level = gauges.get("protection_horizontal_m"), gauges.get("protection_vertical_m")
    if level[0] is None or level[1] is None or level[0] > MAX_PLACED_SIGMA_M:
        return None
    return level[0], level[1]


def _is_placed(estimate: FleetEstimate, agent_id: int) -> bool:
    """Whether an estimate says where its sender is: before the first fix it only says "somewhere"."""
    trace_m2 = float(np.trace(estimate.own_covariance[:3, :3]))
    return agent_id in estimate.agents and trace_m2 <= MAX_PLACED_SIGMA_M**2


def _age_s(when_s: float, now_s: float) -> float | None:
    return max(now_s - when_s, 0.0) if when_s > -np.inf else None


def _position(estimate: FleetEstimate, agent_id: int) -> Triple:
    north, east, down = (float(x) for x in estimate.mean[position(Layout(estimate.agents).slot(agent_id))])
    return north, east, down


def _velocity(estimate: FleetEstimate, agent_id: int) -> Triple:
    north, east, down = (float(x) for x in estimate.mean[block(Layout(estimate.agents).slot(agent_id))][3:])
    return north, east, down
