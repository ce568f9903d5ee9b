"""Between the estimate and the autopilot: what is fed, what is withheld and why, and when a reset is announced.

::

    CHECKING --agreed with the autopilot's own position by GPS--> READY --its GPS is lost--> FEEDING
        ^                                                           ^                         |   ^
        |                                                           '---GPS back and agrees---'   |
        '--reboot, restart, another origin-- (any)             WITHHELD <--not good any more--'   |
                                                                    '---good for long enough------'

Nothing is fed that was not checked, by an estimate that is not good, or while the autopilot's GPS is: with both it is
worse off than with either. Sans-I/O: one offer per estimate comes in, a verdict comes out.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from agent.feedback.feedback_table import FeedbackTable
from agent.feedback.handover import Handover
from estimators.integrity.protection.levels import ProtectionLevel
from estimators.model.measurements import Vector

AGREE_HORIZONTAL_M, AGREE_VERTICAL_M = 3.0, 5.0
"""How far the estimate is from the autopilot's own position at most, on average over the time of agreement: its
receiver may wander by a metre per axis, which the fleet averages out. A wrong origin or frame makes more of it."""
STRAY_M = 4.5
"""How far at most at one instant: an autopilot's position lags by a quarter of a second."""
RETURNED_M = 3.0
"""How far fixes that are back are from the estimate at most, or its protection level where that is larger."""
FARTHEST_ORIGIN_M = 10_000.0
"""Axes of two places further apart are not parallel enough, and no fleet is that large: something is wrong."""
STALE_S = 0.5
"""An estimate older than this is not fed, and after so long without one the feed has stopped."""
STEP_WINDOW_S = 1.0
REMEMBERED_S = 30.0
"""A receiver that is found to be off may have pulled the autopilot away from the estimate for so long already."""


class FeedPhase(StrEnum):
    """Where the feed is."""

    CHECKING = "checking"
    READY = "ready"
    """Prepared and checked: it begins when the autopilot's GPS is lost."""
    FEEDING = "feeding"
    WITHHELD = "withheld"
    """The autopilot's GPS is lost, and nothing is fed."""


@dataclass(frozen=True, slots=True)
class Offer:
    """An estimate that could be fed, and what is known of the autopilot at its instant; positions in the fleet frame.

    ``t_s`` is fleet time of the estimate, ``now_s`` that of the offer. ``bad``: why the estimate is not good, empty
    if it is. ``autopilot``: why its link or origin cannot be used, empty if they can. ``own_m``: the autopilot's own
    position then. ``gps_lost``: whether no fix comes; ``fix_off_m``: how far the latest fix is from the estimate.
    ``counts_on_gps``: whether the autopilot still counts on fixes that have ended (see `agent.feedback.handover`).
    ``gps_off``: whether its receiver is known to be off, so that its own position says nothing; ``gps_unused``:
    whether the autopilot knows that too and leaves its fixes out.
    """

    t_s: float
    now_s: float
    position_m: Vector
    velocity_mps: Vector
    level: ProtectionLevel
    bad: str
    autopilot: str
    origin_m: Vector | None
    own_m: Vector | None
    gps_lost: bool
    fix_off_m: float | None
    gps_off: bool = False
    gps_unused: bool = False
    counts_on_gps: bool = False

    @property
    def without_gps(self) -> bool:
        """Whether nothing but a feed holds the autopilot's position."""
        return self.gps_lost or self.gps_unused


@dataclass(frozen=True, slots=True)
class FeedVerdict:
    """``feed``: whether this estimate is given to the autopilot. ``reason``: why nothing is."""

    phase: FeedPhase
    feed: bool
    reset_counter: int
    reason: str = ""
    gps_off_m: float | None = None
    """How far the autopilot's GPS, which is back, is from the estimate that it contradicts."""
    shift_m: Vector = field(default_factory=lambda: np.zeros(3))
    """To be added to the position ``(3,)`` NED, so that a feed begins where the autopilot believes to be."""
    shift_rate_mps: Vector = field(default_factory=lambda: np.zeros(3))
    """To be added to the velocity ``(3,)``: how fast that shrinks."""


class Gatekeeper:
    """One drone's. It is asked once per estimate, in order; `forget` begins anew."""

    def __init__(self, table: FeedbackTable, *, standby: bool = False) -> None:
        """``standby``: whether what is ready is sent too, to an autopilot that leaves it unused until it is told."""
        self._table = table
        self._standby = standby
        self.phase = FeedPhase.CHECKING
        self.resets = 1
        """Counter that goes with what is fed; not zero, so that a decoder that fills fields up is seen."""
        self._checked = False
        self._held_s = -math.inf
        """When it agreed last."""
        self._good_since_s: float | None = None
        self._apart: deque[tuple[float, Vector]] = deque()
        """Estimate less the autopilot's own position, while its GPS was good."""
        self._last: Offer | None = None
        self._steps: deque[tuple[float, Vector]] = deque()
        """Corrections of the position within the last second."""
        self._last_fed_s = -math.inf
        self._handover = Handover()
        self._gps_agrees_since_s: float | None = None
        self._why = "not checked yet"

    def forget(self, why: str) -> None:
        """What was checked no longer holds: the autopilot was rebooted, its origin is another one, we restarted."""
        self.phase, self._checked, self._why = FeedPhase.CHECKING, False, why
        self._good_since_s = self._gps_agrees_since_s = None
        self._last = None
        self._held_s = -math.inf
        self._apart.clear()
        self._steps.clear()

    def judge(self, offer: Offer) -> FeedVerdict:
        """What becomes of an estimate."""
        bad = self._why_bad(offer)
        if self.phase is FeedPhase.FEEDING:
            self._steps.append((offer.t_s, self._led(offer)))
        jump = self._jumped(offer) if not bad else False
        self._good_since_s = None if bad else (offer.now_s if self._good_since_s is None else self._good_since_s)
        waits = self.phase in (FeedPhase.FEEDING, FeedPhase.WITHHELD)  # then it would be compared with itself
        if offer.gps_off and not waits:
            self._checked = offer.now_s - self._held_s <= REMEMBERED_S
        elif not (offer.without_gps or bad or waits):
            self._compare(offer)
        gps_off_m = self._returned_gps(offer, bad)
        fed_before = self.phase is FeedPhase.FEEDING
        feed = self._step(offer, bad)
        if not (fed_before and feed):
            self._hand_over(offer)
        if feed and (jump or self._last_fed_s < offer.now_s - STALE_S):
            self.resets = (self.resets + 1) % 256
            self._steps.clear()
        if feed:
            self._last_fed_s = offer.now_s
        why = "" if feed else self._why
        handover = self._handover
        return FeedVerdict(self.phase, feed, self.resets, why, gps_off_m, handover.shift_m, handover.rate_mps)

    # --- is it good? --------------------------------------------------------------------------------------------

    def _why_bad(self, offer: Offer) -> str:
        """Why an estimate must not be fed, empty if it may; one that moved further than it said is not believed."""
        table, last = self._table, self._last
        self._last = offer
        if offer.autopilot:
            return offer.autopilot
        if offer.bad:
            return offer.bad
        if not (np.isfinite(offer.position_m).all() and np.isfinite(offer.velocity_mps).all()):
            return "estimate is not finite"
        if offer.now_s - offer.t_s > STALE_S:
            return f"estimate {offer.now_s - offer.t_s:.1f} s old"
        for axis, level_m, limit_m in (
            ("horizontal", offer.level.horizontal_m, table.max_horizontal_m),
            ("vertical", offer.level.vertical_m, table.max_vertical_m),
        ):
            if not level_m <= limit_m:
                return f"{axis} protection level {level_m:.1f} m above {limit_m:g} m"
        if offer.origin_m is None:
            return "its origin is not known"
        if float(np.linalg.norm(offer.origin_m)) > FARTHEST_ORIGIN_M:
            return f"its origin is {float(np.linalg.norm(offer.origin_m)) / 1e3:.0f} km from the fleet's"
        if last is not None and offer.t_s - last.t_s > STALE_S:
            return f"no estimate for {offer.t_s - last.t_s:.1f} s"
        if last is not None:
            moved_m = float(np.linalg.norm(_correction(last, offer)[:2]))
            if moved_m > max(last.level.horizontal_m, table.max_step_m):
                return f"estimate moved by {moved_m:.1f} m, further than it said"
            self._steps.append((offer.t_s, _correction(last, offer)))
        return ""

    def _jumped(self, offer: Offer) -> bool:
        """Whether the position was corrected by more than is allowed without announcing it."""
        while self._steps and offer.t_s - self._steps[0][0] >= STEP_WINDOW_S:
            self._steps.popleft()
        total = sum((step for _, step in self._steps), np.zeros(3))
        return float(np.linalg.norm(total)) > self._table.max_step_m

    def _compare(self, offer: Offer) -> None:
        """Hold the estimate against the autopilot's own position by GPS."""
        if offer.own_m is None:
            self._uncheck("its own position is not known")
            return
        apart = offer.position_m - offer.own_m
        self._apart.append((offer.now_s, apart))
        while offer.now_s - self._apart[0][0] > self._table.agree_s:
            self._apart.popleft()
        mean = np.mean([each for _, each in self._apart], axis=0)
        horizontal_m, vertical_m = float(np.hypot(mean[0], mean[1])), abs(float(mean[2]))
        now_m = float(np.hypot(apart[0], apart[1]))
        if now_m > STRAY_M or horizontal_m > AGREE_HORIZONTAL_M:
            self._uncheck(f"estimate {max(now_m, horizontal_m):.1f} m from its own position by GPS: origin or frame")
        elif vertical_m > AGREE_VERTICAL_M:
            self._uncheck(f"estimate {vertical_m:.1f} m above or below its own position: heights")
        elif self._covers(self._apart):
            self._checked = True
            self._held_s = offer.now_s
        elif not self._checked:
            self._why = "not checked yet"

    def _covers(self, apart: deque[tuple[float, Vector]]) -> bool:
        """Whether so much of the time of agreement has been compared, but for an estimate or two."""
        return apart[-1][0] - apart[0][0] >= self._table.agree_s - STALE_S

    def _uncheck(self, why: str) -> None:
        self._checked, self._why = False, why

    # --- what follows -------------------------------------------------------------------------------------------

    def _returned_gps(self, offer: Offer, bad: str) -> float | None:
        """Whether a GPS that is back agrees with a good estimate: since when, or by how far it does not."""
        if offer.gps_lost or offer.fix_off_m is None or bad:
            self._gps_agrees_since_s = None
            return None
        limit_m = max(RETURNED_M, offer.level.horizontal_m)
        if offer.fix_off_m > limit_m:
            self._gps_agrees_since_s = None
            return offer.fix_off_m
        if self._gps_agrees_since_s is None:
            self._gps_agrees_since_s = offer.now_s
        return None

    def _led(self, offer: Offer) -> Vector:
        """How the difference to what is fed changes with an estimate, ``(3,)``."""
        if offer.counts_on_gps and offer.own_m is not None:
            return self._handover.follow(offer.position_m - offer.own_m, offer.t_s)
        return self._handover.go_on(offer.t_s)

    def _hand_over(self, offer: Offer) -> None:
        """The first position that is fed is the autopilot's own; what is ready is held there."""
        if self.phase is FeedPhase.FEEDING:
            apart_m = None if offer.own_m is None else offer.position_m - offer.own_m
        else:
            apart_m = np.mean([each for _, each in self._apart], axis=0) if self._apart else None
        self._handover.begin(apart_m, offer.t_s)

    def _step(self, offer: Offer, bad: str) -> bool:
        """Go on by one estimate; whether it is fed."""
        waits_for_gps = self.phase in (FeedPhase.FEEDING, FeedPhase.WITHHELD)
        since_s = self._gps_agrees_since_s
        # without a feed there is nothing to hand back
        held_s = 0.0 if self.phase is FeedPhase.WITHHELD else self._table.agree_s
        gps_is_back = since_s is not None and offer.now_s - since_s >= held_s
        if not offer.without_gps and (not waits_for_gps or gps_is_back):
            self.phase = FeedPhase.READY if self._checked and not bad else FeedPhase.CHECKING
            self._why = bad or ("" if self._checked else self._why)
            return self._standby and self.phase is FeedPhase.READY
        self.phase = FeedPhase.WITHHELD
        if not self._checked:
            self._why = f"not checked before its GPS was lost ({self._why})" if not waits_for_gps else self._why
            return False
        good_s = 0.0 if self._good_since_s is None else offer.now_s - self._good_since_s
        if bad or good_s < self._table.agree_s:
            self._why = bad or f"good for less than {self._table.agree_s:g} s"
            return False
        self.phase = FeedPhase.FEEDING
        return True


def _correction(last: Offer, offer: Offer) -> Vector:
    """How far the position is from where the last one and the velocities have it, ``(3,)``."""
    elapsed_s = offer.t_s - last.t_s
    moved = 0.5 * elapsed_s * (last.velocity_mps + offer.velocity_mps)
    return np.asarray(offer.position_m - last.position_m - moved)
