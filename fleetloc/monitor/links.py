"""What a receiver's reports say of its links: loss of the last seconds out of counters since the start; sans-I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from fleetloc.monitor.views import Level, Link

LOSS_WINDOW_S = 10.0
REPORT_PERIOD_S = 1.0
LOSS_WARNING = 0.3
"""From here on a link is shown as a bad one; the estimators get on with more."""


class LinkHistory:
    """Counters of received and lost packets over the last ``LOSS_WINDOW_S``."""

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int, int]] = deque()

    def add(self, now_s: float, received: int, lost: int) -> None:
        """Note the counters; ones that went back belong to a receiver that has started anew."""
        if self._counts and received < self._counts[-1][1]:
            self._counts.clear()
        self._counts.append((now_s, received, lost))
        while len(self._counts) > 2 and now_s - self._counts[1][0] >= LOSS_WINDOW_S:
            self._counts.popleft()

    @property
    def loss(self) -> float | None:
        """Share of the packets of the window that were lost; ``None`` if there were none."""
        if len(self._counts) < 2:
            return None
        (_, received_0, lost_0), (_, received_1, lost_1) = self._counts[0], self._counts[-1]
        received, lost = received_1 - received_0, max(lost_1 - lost_0, 0)  # a late packet is no longer lost
        return lost / (received + lost) if received + lost else None

    def recent_lost(self, now_s: float) -> int:
        """How many were lost in the window that ends now."""
        recent = [lost for when_s, _, lost in self._counts if now_s - when_s <= LOSS_WINDOW_S]
        return max(recent[-1] - recent[0], 0) if recent else 0


def overdue_s(since_s: float) -> float:
    """How much older than reported a figure has to be taken for: reports come once a second."""
    return max(since_s - REPORT_PERIOD_S, 0.0)


def link_view(
    sender: int,
    receiver: int,
    gauges: Mapping[str, float] | None,
    loss: float | None,
    since_s: float,
    *,
    timeout_s: float,
) -> Link:
    """A link as its receiver reported it ``since_s`` ago; ``gauges`` is ``None`` if it says nothing of it."""
    if gauges is None:
        return Link(sender=sender, receiver=receiver, level="info", age_s=None)
    reported_s = gauges.get("heard_age_s", gauges.get("age_s"))
    age_s = None if reported_s is None else reported_s + overdue_s(since_s)
    level: Level = "ok"
    if reported_s is None or reported_s > timeout_s:
        level = "bad"
    elif loss is not None and loss >= LOSS_WARNING:
        level = "warning"
    return Link(
        sender=sender,
        receiver=receiver,
        level=level,
        age_s=age_s,
        loss=loss,
        rejected=int(gauges.get("rejected", 0)),
        round_trip_s=gauges.get("round_trip_s"),
        clock_offset_s=gauges.get("clock_offset_s"),
    )
