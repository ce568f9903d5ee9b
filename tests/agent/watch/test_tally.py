"""What a drone's health said over a flight, counted."""

from __future__ import annotations

from agent.watch.health import assess
from agent.watch.tally import DOUBTS, REFUSALS, HealthTally
from estimators.integrity.finding import Finding, Gravity, What


def test_alarms_doubts_refusals_and_the_rest_are_counted_with_their_times() -> None:
    tally = HealthTally()
    off = [Finding(What.RECEIVER_OFF, Gravity.DEGRADED, about, value=5.0, detail="fixes") for about in (2, 3)]
    ticks = [
        (),
        (Finding(What.NO_FIX, Gravity.DEGRADED), Finding(What.AMBIGUOUS, Gravity.ALARM)),
        (Finding(What.AMBIGUOUS, Gravity.ALARM), off[0]),
        tuple(off),
        (Finding(What.LATENCY, Gravity.NOTED),),
    ]
    for number, findings in enumerate(ticks):
        tally.add(assess(findings), 100.0 + number)
    assert tally.figures(90.0) == {
        "alarm": {"ticks": 2, "first_s": 11.0, "last_s": 12.0, "about": []},
        "doubts": {"ambiguous": {"ticks": 2, "first_s": 11.0, "last_s": 12.0, "about": []}},
        "refusals": {"receiver_off": {"ticks": 2, "first_s": 12.0, "last_s": 13.0, "about": [2, 3]}},
        "other": {"no_fix": {"ticks": 1, "first_s": 11.0, "last_s": 11.0, "about": []}},
    }


def test_what_was_never_said_has_no_time() -> None:
    assert HealthTally().figures(90.0)["alarm"] == {"ticks": 0, "first_s": None, "last_s": None, "about": []}


def test_nothing_is_a_doubt_and_a_refusal() -> None:
    assert not DOUBTS & REFUSALS
