"""What a daemon says of itself fits into a packet, however many neighbours it has."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from agent.watch.diagnostics import diagnostics_of
from agent.watch.health import assess
from agent.watch.position_watch import PositionWatch, TickEvidence
from estimators.integrity.solution import Solution
from estimators.integrity.staleness import Ages
from transport.messages.report_body import Diagnostics, decode_diagnostics, encode_diagnostics
from transport.security.auth import UNSIGNED
from transport.security.sealing import Sealer

SILENT = assess(
    PositionWatch(1.0).observe(
        TickEvidence(
            Solution(None, 1.0, "waiting for fixes"),
            Ages(None, 0.0, dict.fromkeys(range(701, 1000), math.inf)),
            autopilot="searching",
        )
    )
)
NAMES = ("age_s", "clock_offset_s", "round_trip_s", "received", "lost", "heard_age_s", "restarts", "rejected")
LINK = dict.fromkeys(NAMES, 0.1234567890123)


@pytest.mark.parametrize(("count", "gauges", "told"), [(60, LINK, 60), (200, LINK, 55), (299, {"age_s": 0.5}, 256)])
def test_the_message_of_a_drone_with_very_many_neighbours_can_be_sent(
    count: int, gauges: dict[str, float], told: int
) -> None:
    # GIVEN a daemon with many counters, that hears none of very many neighbours
    health = SILENT
    counters = {f"something counted, number {i}": 123_456 for i in range(60)}
    neighbours = {str(701 + i): gauges for i in range(count)}
    # WHEN it says how it is
    message = diagnostics_of(1, health, counters, {"rss_mb": 100.0}, neighbours)
    # THEN the message can be sent, with as many neighbours as it holds, the first ones, and all else
    assert Sealer("test", 1, boot=1, signing=UNSIGNED).seal(message, t_ns=0)
    assert list(message.neighbours) == list(neighbours)[: len(message.neighbours)]
    assert min(count, told) <= len(message.neighbours) <= told + 10
    assert message.counters == counters
    assert message.reasons[-1].endswith("... and 291 more")


def test_what_is_known_of_targets_is_told() -> None:
    message = diagnostics_of(1, replace(SILENT, reasons=()), {}, {}, {}, "NOMINAL", {"101": "not observable"})
    assert message == Diagnostics(1, "init", integrity="NOMINAL", targets={"101": "not observable"})
    assert decode_diagnostics(encode_diagnostics(message)) == message


def test_a_reason_that_is_too_long_is_cut() -> None:
    health = replace(SILENT, reasons=("x" * 500,))
    message = diagnostics_of(1, health, {}, {}, {})
    assert message == Diagnostics(1, "init", ("x" * 128,))
