"""Which of the autopilot's streams come more slowly than they were asked for, in words. Sans-I/O."""

from __future__ import annotations

from collections.abc import Iterable

from agent.mavlink.codec import mavlink
from agent.mavlink.stream_rates import StreamState
from estimators.integrity.finding import Finding, Gravity, What

NEEDED = frozenset({
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
    mavlink.MAVLINK_MSG_ID_RAW_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
})  # fmt: skip
"""Without which a tick has no acceleration. Of the others their own monitors say what is missing: fixes, heights."""
USELESS_SHARE = 0.3
"""Of the wanted rate; below it the ticks have gaps for certain. Above, the coverage of the IMU decides."""
AGAIN_S = 60.0
"""A stream that comes and goes is told of no more often."""


def slow_text(stream: StreamState) -> str:
    """``HIGHRES_IMU at 13 of 100 Hz``; of a stream that has been measured."""
    rate_hz = stream.rate_hz or 0.0
    return f"{message_name(stream.message_id)} at {rate_hz:.3g} of {stream.wanted_hz:g} Hz"


def message_name(message_id: int) -> str:
    """A message's name in the dialect, or its number."""
    known = mavlink.mavlink_map.get(message_id)
    return f"message {message_id}" if known is None else str(known.msgname)


def slow_findings(slow: Iterable[StreamState]) -> tuple[Finding, ...]:
    """A finding for each slow stream that is needed in every tick."""
    return tuple(
        Finding(
            What.SLOW_STREAM,
            Gravity.DEGRADED if (each.rate_hz or 0.0) < USELESS_SHARE * each.wanted_hz else Gravity.NOTED,
            value=each.rate_hz,
            limit=each.wanted_hz,
            detail=slow_text(each),
        )
        for each in slow
        if each.message_id in NEEDED
    )


class SlowStreamLog:
    """Says of each stream that is slow that it is, and again only if it was right in between."""

    def __init__(self) -> None:
        self._told_s: dict[int, float] = {}

    def lines(self, slow: Iterable[StreamState], now_s: float) -> list[str]:
        """What is to be logged now."""
        there = {each.message_id: each for each in slow}
        self._told_s = {
            message_id: told_s
            for message_id, told_s in self._told_s.items()
            if message_id in there or now_s - told_s < AGAIN_S
        }
        new = [each for message_id, each in there.items() if message_id not in self._told_s]
        self._told_s |= {each.message_id: now_s for each in new}
        return [f"autopilot sends {slow_text(each)}" for each in new]
