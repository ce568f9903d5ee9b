"""Flight logs kept from earlier versions: they open, and what they replay to has not changed unnoticed."""

from __future__ import annotations

from pathlib import Path

import pytest

from estimators.factory import make_estimator
from sim_bridge.replay.flight_log_replay import replay_flight_log

RECORDS = Path(__file__).parents[2] / "data" / "records"
PRESENT = "two_places"
"""Name of the logs that the present estimator flew."""
KEPT = sorted(RECORDS.glob("*.mcap"))
OLDER = [path for path in KEPT if not path.stem.startswith(PRESENT)]
OTHER_SOLVER_M = 0.01
"""How far the present solver may be from those of earlier versions; it is within 0.2 mm."""


def test_there_are_kept_records() -> None:
    assert len(OLDER) >= 2


@pytest.mark.parametrize("path", OLDER, ids=[path.stem for path in OLDER])
def test_an_older_record_opens_and_replays_to_its_own_estimates(path: Path) -> None:
    [replay] = replay_flight_log([path], None, make_estimator)

    assert replay.complete
    assert replay.compared > 50
    assert replay.only_recorded == 0
    assert replay.contradicted == 0
    assert replay.max_mean_difference < OTHER_SOLVER_M
    assert replay.max_sigma_difference < OTHER_SOLVER_M


@pytest.mark.parametrize("path", sorted(set(KEPT) - set(OLDER)), ids=lambda path: path.stem)
def test_a_present_record_replays_bit_by_bit(path: Path) -> None:
    [replay] = replay_flight_log([path], None, make_estimator)

    assert replay.complete
    assert replay.compared > 50
    assert replay.max_mean_difference == 0.0
    assert replay.max_sigma_difference == 0.0
