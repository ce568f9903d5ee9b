"""Flight logs kept from earlier versions: they open, and what they replay to has not changed unnoticed."""

from __future__ import annotations

from pathlib import Path

import pytest

from estimators.factory import make_estimator
from sim_bridge.replay.flight_log_replay import replay_flight_log

RECORDS = Path(__file__).parents[2] / "data" / "records"
KEPT = sorted(RECORDS.glob("*.mcap"))


def test_there_are_kept_records() -> None:
    assert len(KEPT) >= 2


@pytest.mark.parametrize("path", KEPT, ids=[path.stem for path in KEPT])
def test_a_kept_record_replays_to_its_own_estimates(path: Path) -> None:
    [replay] = replay_flight_log([path], None, make_estimator)

    assert replay.complete
    assert replay.compared > 50
    assert replay.only_recorded == 0
    assert replay.different == 0
