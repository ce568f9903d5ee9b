"""What a replay leaves out on request: GPS of one drone for a while."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from sim_bridge.replay.errors import ReplayError

OPTION = "--drop-gps"
SPELLING = "ID, ID:FROM,TO, ID:FROM, or ID:,TO with seconds from the start (negative: from the end)"


@dataclass(frozen=True, slots=True)
class ReplaySpan:
    """A part of a replay in seconds from its start, negative from its end; ``None`` is open."""

    from_s: float | None = None
    to_s: float | None = None

    def resolved(self, start_s: float, end_s: float) -> tuple[float, float]:
        """The window in fleet time; open ends are infinite."""
        return _resolved(self.from_s, start_s, end_s, -math.inf), _resolved(self.to_s, start_s, end_s, math.inf)


def _resolved(value: float | None, start_s: float, end_s: float, open_s: float) -> float:
    if value is None:
        return open_s
    return (end_s if value < 0.0 or math.copysign(1.0, value) < 0.0 else start_s) + value


@dataclass(frozen=True, slots=True)
class GpsDrop:
    """One agent without fixes for a while."""

    agent_id: int
    window: ReplaySpan

    @classmethod
    def parsed(cls, text: str) -> GpsDrop:
        """``2``, ``2:30,60``, ``2:-90,``; raises `ReplayError`."""
        match = re.fullmatch(r"\s*(\d+)\s*(?::([^,]*)(?:,([^,]*))?)?", text)
        if match is None:
            raise ReplayError(OPTION, SPELLING, repr(text))
        bounds = [_bound(text, part) for part in match.groups()[1:]]
        return cls(int(match.group(1)), ReplaySpan(*bounds))


def _bound(text: str, part: str | None) -> float | None:
    if part is None or not part.strip():
        return None
    try:
        value = float(part)
    except ValueError as error:
        raise ReplayError(OPTION, SPELLING, repr(text)) from error
    if not math.isfinite(value):
        raise ReplayError(OPTION, SPELLING, repr(text))
    return value


class GpsDrops:
    """All of them, in fleet time."""

    def __init__(
        self,
        drops: list[GpsDrop],
        ids: tuple[int, ...],
        start_s: float,
        end_s: float,
        part_s: tuple[float, float] = (-math.inf, math.inf),
    ) -> None:
        """``ids`` of the drones with a log; windows count from ``start_s`` and to ``end_s``, ``part_s`` is replayed.

        Raises `ReplayError` for another drone, and for a window without length in that part.
        """
        self.windows: dict[int, list[tuple[float, float]]] = {}
        for drop in drops:
            if drop.agent_id not in ids:
                expected = f"a drone with a log ({', '.join(map(str, ids))})"
                raise ReplayError(OPTION, expected, str(drop.agent_id))
            asked_s = drop.window.resolved(start_s, end_s)
            first_s = part_s[0] if math.isfinite(part_s[0]) else start_s
            last_s = part_s[1] if math.isfinite(part_s[1]) else end_s
            from_s, to_s = max(asked_s[0], first_s), min(asked_s[1], last_s)
            if not from_s < to_s:
                expected = f"a part of what is replayed, {first_s - start_s:.1f} to {last_s - start_s:.1f} s"
                raise ReplayError(OPTION, expected, f"{asked_s[0] - start_s:.1f} to {asked_s[1] - start_s:.1f} s")
            self.windows.setdefault(drop.agent_id, []).append((from_s, to_s))

    def holds(self, agent_id: int, t_s: float) -> bool:
        """Whether an agent's fix of that fleet time is left out."""
        return any(from_s <= t_s <= to_s for from_s, to_s in self.windows.get(agent_id, ()))
