"""The shell of ``fleetloc ros2``: hears the fleet as an observer does, publishes to the robot's own ROS router."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from agent.config.tables import FleetConfig
from fleetloc.errors import EnvironmentFault, InputError
from fleetloc.monitor.listener import FleetListener
from fleetloc.ros2.odometry import (
    attachment,
    encode_odometry,
    gid_of,
    node_token,
    odometry_of,
    publisher_token,
    topic_key,
)
from transport.messages.estimate_body import FleetEstimate
from transport.security.opening import Received

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
NODE = "fleetloc"
FIRST_ENTITY = 10
MAX_DOMAIN = 232


@dataclass(frozen=True, slots=True)
class Ros2Settings:
    """Where and how to publish; raises `InputError` for what ROS would not take.

    ``namespace`` has a place for the id, ``{id}``; the topic is ``{namespace}/odom``.
    """

    router: str = "tcp/127.0.0.1:7447"
    domain: int = 0
    namespace: str = "uav{id}"
    frame_id: str = "map"

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= MAX_DOMAIN:
            raise InputError("--domain", "", f"a ROS domain from 0 to {MAX_DOMAIN}", str(self.domain))
        if "{id}" not in self.namespace or not re.fullmatch(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", self.of(1)):
            raise InputError("--namespace", "", "a ROS name with {id} in it, such as uav{id}", repr(self.namespace))
        if not re.fullmatch(r"(tcp|tls|udp|quic)/.+:\d{1,5}", self.router):
            raise InputError("--router", "", "a Zenoh endpoint such as tcp/127.0.0.1:7447", repr(self.router))

    def of(self, agent_id: int) -> str:
        """The namespace of an agent."""
        return self.namespace.replace("{id}", str(agent_id))


class Ros2Publisher:
    """Publishes the drones' odometry to a router; ``sent`` counts messages, ``failed`` those Zenoh did not take."""

    def __init__(self, config: FleetConfig, settings: Ros2Settings) -> None:
        """Connect as a client and show node and topics; blocks. Raises `EnvironmentFault` if nobody is there."""
        self._config, self._settings = config, settings
        self.sent = self.failed = 0
        table = {
            "mode": "client",
            "connect": {"endpoints": [settings.router]},
            "scouting": {"multicast": {"enabled": False}},
        }
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(table)))
        except zenoh.ZError as error:
            raise EnvironmentFault(f"router {settings.router}: no rmw_zenohd reached") from error
        session_id = str(self._session.info.zid())
        tokens = [node_token(settings.domain, session_id, NODE)]
        self._publishers: dict[int, tuple[zenoh.Publisher, bytes]] = {}
        self._numbers = dict.fromkeys(config.ids, 0)
        for entity, agent_id in enumerate(config.ids, FIRST_ENTITY):
            topic = f"{settings.of(agent_id)}/odom"
            token = publisher_token(settings.domain, session_id, entity, NODE, topic)
            tokens.append(token)
            publisher = self._session.declare_publisher(
                topic_key(settings.domain, topic),
                congestion_control=zenoh.CongestionControl.DROP,
                reliability=zenoh.Reliability.BEST_EFFORT,
            )
            self._publishers[agent_id] = (publisher, gid_of(token))
        self._tokens: list[Any] = [self._session.liveliness().declare_token(token) for token in tokens]

    def on_message(self, received: Received) -> None:
        """Publish an estimate; everything else is passed over."""
        estimate, sender = received.message, received.sender
        if isinstance(estimate, FleetEstimate) and sender in estimate.agents:
            self.publish(sender, estimate, time.time_ns())

    def publish(self, agent_id: int, estimate: FleetEstimate, unix_ns: int) -> None:
        """Publish what a drone says of itself, sent at ``unix_ns``."""
        fleet = self._config.fleet
        stamp_ns = round((fleet.epoch_unix_s + estimate.tick * fleet.period_s) * 1e9)
        child = f"{self._settings.of(agent_id)}/estimate"
        frames = {"frame_id": self._settings.frame_id, "child_frame_id": child}
        message = odometry_of(estimate, agent_id, stamp_ns=stamp_ns, **frames)
        publisher, gid = self._publishers[agent_id]
        self._numbers[agent_id] += 1
        try:
            publisher.put(encode_odometry(message), attachment=attachment(self._numbers[agent_id], unix_ns, gid))
            self.sent += 1
        except zenoh.ZError:
            self.failed += 1

    def close(self) -> None:
        """Withdraw everything; blocks."""
        for token in self._tokens:
            token.undeclare()
        self._session.close()  # type: ignore[no-untyped-call]


async def run(
    config: FleetConfig,
    base: Path,
    settings: Ros2Settings,
    *,
    endpoints: Sequence[str] = (),
    duration_s: float | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Publish until SIGTERM or SIGINT, or for so long."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in STOP_SIGNALS:
        loop.add_signal_handler(number, stop.set)
    publisher = await asyncio.to_thread(Ros2Publisher, config, settings)
    try:
        listener = FleetListener(config, base, publisher.on_message, lambda *_: None, endpoints)
        await listener.open()
        say(f"publishing /{settings.namespace}/odom to {settings.router}")
        try:
            await asyncio.wait_for(stop.wait(), duration_s)
        except TimeoutError:
            say(f"{publisher.sent} messages published")
        finally:
            await listener.close()
    finally:
        await asyncio.to_thread(publisher.close)
        for number in STOP_SIGNALS:
            loop.remove_signal_handler(number)
