"""Neighbours as traffic: fields and units of ADSB_VEHICLE, who is left out, and the link they go on."""

from __future__ import annotations

import asyncio
import math
import socket

import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.mavlink.adsb import AdsbReporter, traffic
from agent.mavlink.codec import Decoder, Encoder, Message
from agent.mavlink.signing import LinkSigning
from agent.outputs import EstimateReady
from agent.sensing.frames import FleetFrame
from agent.watch.health import Health, State
from agent.watch.observers import DaemonState
from estimators.estimator import Estimate, Status

ENDED = DaemonState(1, 0.0, Health(State.OK, ()), {}, {}, {})


def fleet(address: str = "udpout:127.0.0.1:14550") -> FleetConfig:
    document = {
        "fleet": {"name": "seen", "origin": {"lat_deg": 47.4, "lon_deg": 8.5, "alt_m": 500.0}},
        "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{24550 + i}"} for i in (1, 2, 3)],
        "adsb": {"address": address},
    }
    return config_from(document, "test")


def estimate(state: tuple[float, ...], *, sigma_m: float = 0.5, age_ticks: int = 0) -> Estimate:
    """Drone 2 in ``state``, everybody else at rest at the origin."""
    mean = np.zeros(18)
    mean[6:12] = state
    covariance = np.eye(18) * 0.01
    covariance[6:9, 6:9] = np.eye(3) * sigma_m**2
    return Estimate(7, mean, covariance, Status.OK, np.array([0, age_ticks, 0]))


def sent(of: Estimate) -> dict[int, Message]:
    config = fleet()
    decoder, encoder = Decoder(datagrams=True), Encoder(1, 197)
    messages = traffic(of, config, 1, FleetFrame.of(config))
    decoded = [decoder.feed(encoder.encode(message))[0] for message in messages]
    return {message.ICAO_address: message for message in decoded}


def test_a_neighbour_is_where_it_is_and_flies_where_it_flies() -> None:
    # 100 m north, 50 m east, 30 m up; north-east at 5 m/s, climbing at 1 m/s
    found = sent(estimate((100.0, 50.0, -30.0, 3.0, 4.0, -1.0)))
    assert set(found) == {0xF00002, 0xF00003}  # not ourselves
    message = found[0xF00002]
    lat, lon, alt = pymap3d.ned2geodetic(100.0, 50.0, -30.0, 47.4, 8.5, 500.0)
    assert (message.lat, message.lon) == (round(lat * 1e7), round(lon * 1e7))
    assert message.altitude == pytest.approx(alt * 1e3, abs=1)
    assert message.altitude == pytest.approx(530_000, abs=10)
    assert message.heading == pytest.approx(math.degrees(math.atan2(4, 3)) * 100, abs=1)
    assert (message.hor_velocity, message.ver_velocity) == (500, 100)
    assert (message.callsign, message.emitter_type, message.altitude_type) == ("COOP-002", 14, 1)
    assert message.flags == 1 | 2 | 4 | 8 | 16 | 128


def test_a_hovering_neighbour_has_no_heading() -> None:
    assert not sent(estimate((0.0, 0.0, -5.0, 0.1, 0.1, 0.0)))[0xF00002].flags & 4


def test_a_neighbour_that_is_badly_known_or_long_unheard_is_left_out() -> None:
    still = (0.0, 0.0, -5.0, 0.0, 0.0, 0.0)
    assert set(sent(estimate(still, sigma_m=25.0))) == {0xF00003}
    assert set(sent(estimate(still, age_ticks=2600))) == {0xF00003}
    assert sent(estimate(still, age_ticks=42))[0xF00002].tslc == 4


@given(st.tuples(*[st.floats(-1e5, 1e5)] * 3, *[st.floats(-1e3, 1e3)] * 3))
def test_whatever_is_estimated_fits_its_field(state: tuple[float, ...]) -> None:
    assert 0 <= sent(estimate(state))[0xF00002].heading < 36_000


async def test_neighbours_go_out_once_a_second_signed_where_asked_for() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.setblocking(False)
        port = station.getsockname()[1]
        reporter = AdsbReporter(fleet(f"udpout:127.0.0.1:{port}"), 1, LinkSigning(b"k" * 32, unix_s=0.0, link_id=1))
        await reporter.open()
        still = estimate((0.0, 0.0, -5.0, 0.0, 0.0, 0.0))
        for tick in range(15):  # 1.5 s of estimates
            reporter.on_estimate(EstimateReady(still, 100.0 + 0.1 * tick, 0.0, True), 100.1 + 0.1 * tick, 0.01)
        loop = asyncio.get_running_loop()
        frames = [await asyncio.wait_for(loop.sock_recv(station, 2048), 10.0) for _ in range(4)]
        await reporter.close(ENDED)
        with pytest.raises(BlockingIOError):
            station.recv(2048)
    assert reporter.sent == 4
    verifier = LinkSigning(b"k" * 32, unix_s=fleet().fleet.epoch_unix_s + 100.0)
    decoder = Decoder(datagrams=True, signing=verifier)
    assert [decoder.feed(frame)[0].ICAO_address for frame in frames] == [0xF00002, 0xF00003] * 2
