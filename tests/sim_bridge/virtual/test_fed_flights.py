"""A drone without GPS whose autopilot is given the estimate, in virtual time: bytes to and from fake autopilots."""

from __future__ import annotations

import numpy as np
import pytest

from agent.feedback.gatekeeper import FeedPhase
from tests.support.fed_flight import FedFlight, fed_fleet

LOST_S, BACK_S, END_S = 10.0, 15.0, 18.0


@pytest.fixture(scope="module", params=["px4", "ardupilot"])
def flight(request: pytest.FixtureRequest) -> FedFlight:
    """GPS is lost for five seconds."""
    feedback = {"agree_s": 2.0, "switch_source": True}
    config = fed_fleet(request.param, outage_s=(LOST_S, BACK_S), feedback=feedback)
    return FedFlight(config, END_S).fly()


def test_the_feed_begins_at_the_loss_and_ends_when_gps_is_back(flight: FedFlight) -> None:
    assert flight.share(FeedPhase.READY, LOST_S - 1.0, LOST_S) == 1.0
    assert flight.share(FeedPhase.FEEDING, LOST_S + 1.5, BACK_S) == 1.0
    assert flight.phases[-1] is FeedPhase.READY


def test_the_autopilot_follows_the_daemon(flight: FedFlight) -> None:
    autopilot = flight.between(LOST_S + 2.0, BACK_S, flight.autopilot_m)
    daemon = flight.between(LOST_S + 2.0, BACK_S, flight.daemon_m)

    assert autopilot.max() < daemon.max() + 1.0
    assert np.sqrt(np.mean(autopilot**2)) < 1.5


def test_nothing_is_said_against_it(flight: FedFlight) -> None:
    told = [reason for reason, at_s in flight.said.items() if "autopilot" in reason and at_s > 5.0]

    assert told == []
    assert flight.autopilot.state.feed.rejected == {}
