"""Who wants to know what a daemon does: metrics, watchdogs, health queries and records hang on here."""

from __future__ import annotations

from dataclasses import dataclass, field

from agent.outputs import EstimateReady
from agent.watch.health import Health


@dataclass(frozen=True, slots=True)
class DaemonState:
    """A daemon's state at fleet time ``now_s``; counters and gauges by name as in `agent.diagnostics`."""

    agent_id: int
    now_s: float
    health: Health
    counters: dict[str, int]
    gauges: dict[str, float]
    neighbours: dict[str, dict[str, float]]
    """Gauges of each neighbour's link, by its id as text."""
    targets: dict[str, str] = field(default_factory=dict)
    """What is known of each target (`estimators.integrity.protection.targets`), by its id as text."""

    def as_dict(self) -> dict[str, object]:
        """As it is written beside a record."""
        return {
            "agent": self.agent_id,
            "state": str(self.health.state),
            "reasons": list(self.health.reasons),
            "counters": self.counters,
            "gauges": self.gauges,
            "neighbours": self.neighbours,
            "targets": self.targets,
        }


class Observer:
    """What a daemon tells; override what is of interest.

    Called on the daemon's loop between two ticks, so it has to be quick. What it raises is counted as a fault of
    the program and keeps neither the daemon nor other observers from going on.
    """

    async def open(self) -> None:
        """The daemon begins; an `agent.errors.AgentError` keeps it from beginning."""

    def on_estimate(self, ready: EstimateReady, published_s: float, tick_time_s: float) -> None:
        """An estimate is out, at fleet time ``published_s`` after ``tick_time_s`` of computing."""

    def on_second(self, state: DaemonState) -> None:
        """Called once a second."""

    async def close(self, state: DaemonState) -> None:
        """The daemon ends, perhaps before it could `open`; nothing comes after."""
