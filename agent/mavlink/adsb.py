"""The neighbours and targets on a ground station's map: one ADSB_VEHICLE each, once a second.

They go to a ground station (or the router before it) on a link of their own, never to an autopilot, which would
evade its own fleet. The id is made of our own range (0xF00000 and the agent's id), the callsign names it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from agent.config.endpoints import parse_endpoint
from agent.config.tables import FleetConfig
from agent.mavlink.codec import Encoder, Message, mavlink
from agent.mavlink.link import create_link
from agent.mavlink.signing import LinkSigning
from agent.outputs import EstimateReady
from agent.sensing.frames import FleetFrame
from agent.watch.observers import DaemonState, Observer
from estimators.estimator import Estimate

ICAO_BASE = 0xF00000
EMITTER_UAV = 14
GEOMETRIC_ALTITUDE = 1
PERIOD_S = 1.0
MAX_AGE_S = 255.0
MAX_SIGMA_M = 20.0
"""A neighbour that is known no better than this (largest axis, 1-sigma) is not shown."""
MIN_HEADING_SPEED_MPS = 0.3
"""Slower, the course over ground is mostly noise and is not given."""


def traffic(
    estimate: Estimate, config: FleetConfig, agent_id: int, frame: FleetFrame, *, since_s: float = 0.0
) -> Iterator[Message]:
    """One message for each neighbour and target that an estimate, ``since_s`` old, knows well enough."""
    sigma_m = estimate.covariance.diagonal() ** 0.5
    for slot, other in enumerate(config.bodies):
        age_s = float(estimate.age_ticks[slot]) * config.fleet.period_s + since_s
        known = max(sigma_m[6 * slot : 6 * slot + 3]) <= MAX_SIGMA_M
        if other == agent_id or not known or age_s > MAX_AGE_S:
            continue
        state = tuple(float(value) for value in estimate.mean[6 * slot : 6 * slot + 6])
        yield _vehicle(other, state, age_s, frame)


def _vehicle(agent_id: int, state: tuple[float, ...], age_s: float, frame: FleetFrame) -> Message:
    north_m, east_m, down_m, v_north, v_east, v_down = state
    lat_deg, lon_deg, height_m = frame.geodetic((north_m, east_m, down_m))
    flags = (
        mavlink.ADSB_FLAGS_VALID_COORDS
        | mavlink.ADSB_FLAGS_VALID_ALTITUDE
        | mavlink.ADSB_FLAGS_VALID_VELOCITY
        | mavlink.ADSB_FLAGS_VALID_CALLSIGN
        | mavlink.ADSB_FLAGS_VERTICAL_VELOCITY_VALID
    )
    speed_mps, heading_cdeg = math.hypot(v_north, v_east), 0
    if speed_mps >= MIN_HEADING_SPEED_MPS:
        flags |= mavlink.ADSB_FLAGS_VALID_HEADING
        heading_cdeg = round(math.degrees(math.atan2(v_east, v_north)) * 100) % 36_000
    return mavlink.MAVLink_adsb_vehicle_message(
        ICAO_address=ICAO_BASE | agent_id,
        lat=round(lat_deg * 1e7),
        lon=round(lon_deg * 1e7),
        altitude_type=GEOMETRIC_ALTITUDE,
        altitude=_bounded(height_m * 1e3, 31),
        heading=heading_cdeg,
        hor_velocity=min(round(speed_mps * 100), 0xFFFF),
        ver_velocity=_bounded(-v_down * 100, 15),
        callsign=f"COOP-{agent_id:03d}".encode(),
        emitter_type=EMITTER_UAV,
        tslc=round(age_s),
        flags=flags,
        squawk=0,
    )


def _bounded(value: float, bits: int) -> int:
    """Rounded, within a signed field of 1 + ``bits`` bits."""
    limit = 1 << bits
    return max(min(round(value), limit - 1), -limit)


class AdsbReporter(Observer):
    """Sends the neighbours to ``config.adsb.address``, which is given; ``sent`` counts messages.

    ``signing`` where the link is to be signed.
    """

    def __init__(self, config: FleetConfig, agent_id: int, signing: LinkSigning | None = None) -> None:
        self._link = create_link(parse_endpoint(config.adsb.address or ""), _is_mavlink)
        self._encoder = Encoder(config.system_id(agent_id), config.mavlink.component_id, signing)
        self._signing = signing
        self._config = config
        self._agent_id = agent_id
        self._frame = FleetFrame.of(config)
        self._next_s = float("-inf")
        self.sent = 0

    async def open(self) -> None:
        """Open the link; raises `LinkError`."""
        await self._link.open()

    def on_estimate(self, ready: EstimateReady, published_s: float, tick_time_s: float) -> None:
        if not self._next_s - PERIOD_S <= published_s < self._next_s:  # a clock set back sends
            self._next_s = published_s + PERIOD_S
            self._send(ready, published_s)

    def _send(self, ready: EstimateReady, published_s: float) -> None:
        if self._signing is not None:
            self._signing.unix_s = published_s + self._config.fleet.epoch_unix_s
        since_s = max(published_s - ready.t_s, 0.0)
        for message in traffic(ready.estimate, self._config, self._agent_id, self._frame, since_s=since_s):
            self._link.send(self._encoder.encode(message))
            self.sent += 1

    async def close(self, state: DaemonState) -> None:
        await self._link.close()


def _is_mavlink(data: bytes) -> bool:
    """Whether a station shows itself, for links that answer whoever does."""
    return data[:1] in (b"\xfd", b"\xfe")
