"""Whether a place found by ranges alone is taken, and why not."""

from __future__ import annotations

import pytest

from estimators.integrity.finding import Gravity, What
from estimators.integrity.range_location import RangeLocation, RangeLocationMonitor
from estimators.integrity.thresholds import HELD_SIGMA_M


@pytest.mark.parametrize(
    ("evidence", "expected"),
    [
        (RangeLocation(True, 0, 0.3), []),
        (RangeLocation(True, 0, HELD_SIGMA_M), []),
        (RangeLocation(True, 0, 1.001 * HELD_SIGMA_M), [(What.UNCERTAIN, Gravity.NOTED)]),
        (RangeLocation(True, 2, 0.3), [(What.AMBIGUOUS, Gravity.ALARM)]),
        (RangeLocation(True, 1, 99.0), [(What.AMBIGUOUS, Gravity.ALARM), (What.UNCERTAIN, Gravity.NOTED)]),
        (RangeLocation(False, 3, 0.3), [(What.CONTRADICTORY, Gravity.NOTED)]),
    ],
)
def test_only_a_place_that_fits_alone_and_is_sure_is_taken(
    evidence: RangeLocation, expected: list[tuple[What, Gravity]]
) -> None:
    found = RangeLocationMonitor().observe(evidence)
    assert [(finding.what, finding.gravity) for finding in found] == expected


def test_the_number_of_other_places_is_told() -> None:
    (finding,) = RangeLocationMonitor().observe(RangeLocation(True, 2, 0.3))
    assert (finding.value, finding.limit) == (2, 0)
