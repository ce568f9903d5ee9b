"""A fed drone whose neighbours or radio go wrong: the feed goes on rightly, or it is withheld and that is said."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.feedback.gatekeeper import FeedPhase
from tests.support.fed_flight import FedFlight, fed_fleet

LOST_S, END_S = 12.0, 20.0
NOTICED_S = 1.0
WRONG_S = 15.0

pytestmark = pytest.mark.slow


def fed_errors_m(flight: FedFlight) -> list[float]:
    """Horizontal errors of what was fed."""
    at_that_time = zip(flight.phases, flight.daemon_m, strict=True)
    return [float(np.hypot(*error[:2])) for phase, error in at_that_time if phase is FeedPhase.FEEDING]


def test_half_of_all_packets_may_be_lost() -> None:
    feedback = {"agree_s": 3.0}
    config = fed_fleet(outage_s=(LOST_S, END_S + 1.0), feedback=feedback, transport={"loss": 0.5})
    flight = FedFlight(config, END_S).fly()

    assert flight.share(FeedPhase.FEEDING, LOST_S + NOTICED_S, END_S) > 0.9
    assert max(fed_errors_m(flight)) < 3.0
    assert flight.autopilot.state.failsafe is not None
    assert flight.autopilot.state.failsafe.ordered == 0


@pytest.mark.parametrize(
    "fault",
    [
        {"kind": "gps_wrong", "agents": [3], "offset_m": [20.0, 0.0, 0.0]},
        {"kind": "member_wrong", "agents": [3], "offset_m": [3.0, -4.0, 0.0], "lies_about": "itself"},
    ],
    ids=["its receiver jumps", "it lies of itself"],
)
def test_a_neighbour_that_is_wrong_ends_the_feed_and_that_is_said(fault: dict[str, Any]) -> None:
    # three receivers are left, so that nobody can tell who is wrong
    sim = {"faults": [{**fault, "from_s": WRONG_S}]}
    config = fed_fleet(outage_s=(LOST_S, END_S + 1.0), feedback={"agree_s": 3.0}, sim=sim)
    flight = FedFlight(config, END_S).fly()

    assert flight.share(FeedPhase.FEEDING, LOST_S + NOTICED_S, WRONG_S) == 1.0
    assert max(fed_errors_m(flight)) < 3.0
    said = [at_s for reason, at_s in flight.said.items() if reason.startswith("autopilot not fed: ALERT")]
    assert WRONG_S < min(said) < WRONG_S + 2.0
    assert flight.phases[-1] is FeedPhase.WITHHELD
