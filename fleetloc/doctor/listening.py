"""The autopilot's link opened and served for a while, as the daemon does, without radio, estimator and record."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from pathlib import Path

from agent.config.endpoints import parse_endpoint
from agent.config.tables import FleetConfig
from agent.errors import LinkError
from agent.inputs import Served
from agent.mavlink.link import create_link
from agent.onboard import SERVICE_PERIOD_S, OnboardAgent
from agent.outputs import ToAutopilot
from agent.radio.security import mavlink_signing
from estimators.factory import make_estimator
from transport.security.auth import Identity


@dataclass(frozen=True, slots=True)
class Listened:
    """What came of it: the agent that listened, or why the link could not be opened."""

    onboard: OnboardAgent
    bytes_read: int = 0
    unusable: str = ""


async def listen(config: FleetConfig, agent_id: int, base: Path, seconds: float) -> Listened:
    """Listen to an agent's autopilot, asking it for what the daemon asks for; keys are relative to ``base``."""
    unix_s = time.time()
    signing = mavlink_signing(config, agent_id, base, unix_s=unix_s)
    onboard = OnboardAgent(
        config, agent_id, make_estimator, Identity(), unix_s=unix_s, host_s=time.monotonic(), link_signing=signing
    )
    count = 0

    def on_data(data: bytes) -> bool:
        nonlocal count
        count += len(data)
        return onboard.on_mavlink(data, time.monotonic())

    link = create_link(parse_endpoint(config.agent(agent_id).mavlink), on_data)
    try:
        await link.open()
    except LinkError as error:
        return Listened(onboard, unusable=str(error))
    try:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            for output in onboard.take(Served(time.monotonic())):
                if isinstance(output, ToAutopilot):
                    for frame in output.frames:
                        link.send(frame)
            await asyncio.sleep(SERVICE_PERIOD_S)
    finally:
        await link.close()
    return Listened(onboard, count)
