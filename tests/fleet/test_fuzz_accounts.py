"""The fuzz run's accounts: what a busy machine may shift between counters, and what it may not."""

from __future__ import annotations

import pytest

from tests.fleet.fuzz_verdict import settle_aged


def accounts(refused: int, unusable: int, strangers: int) -> dict[str, dict[str, int]]:
    """Of 308 range frames to be refused, 40 that cannot be and 30 of strangers: what was counted."""
    return {
        "rejected uwb": {"expected": 308, "found": refused},
        "uwb unusable": {"expected": 40, "found": unusable},
        "skipped uwb not a neighbour": {"expected": 30, "found": strangers},
    }


@pytest.mark.parametrize(
    ("refused", "unusable", "strangers", "stale", "own", "sound"),
    [
        (308, 40, 30, 9, 0, True),
        (313, 37, 28, 14, 0, True),
        (313, 37, 28, 4, 0, False),  # not refused for their age
        (313, 40, 30, 14, 0, False),  # five more than were sent
        (313, 40, 30, 14, 5, True),  # they came from the own module
        (314, 40, 30, 14, 5, False),
        (313, 37, 30, 14, 2, True),  # three of the hostile ones and two others
        (313, 40, 30, 4, 5, False),
        (308, 37, 30, 9, 9, False),  # three are gone
        (307, 41, 30, 9, 9, False),
        (303, 40, 30, 9, 9, False),
    ],
)
def test_only_frames_that_grew_stale_are_settled(
    refused: int, unusable: int, strangers: int, stale: int, own: int, sound: bool
) -> None:
    counted = accounts(refused, unusable, strangers)
    said = settle_aged(counted, stale, own)
    assert (said == []) == sound
    assert all(counts["found"] == counts["expected"] for counts in counted.values()) == sound
