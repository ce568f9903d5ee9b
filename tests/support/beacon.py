"""Processes that say on the radio what a drone would, without a drone: ``python -m tests.support.beacon CONFIG ID``.

They fly circles, report themselves well, and know where everybody is; a real session, keys and packets.
"""

from __future__ import annotations

import asyncio
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from agent.radio.radio import Listener, Radio
from transport.messages.estimate_body import FleetEstimate
from transport.messages.report_body import Diagnostics
from transport.security.sealing import Sealer

ROOT = Path(__file__).parents[2]
FIXES = 3.0


def fleet_estimate(config: FleetConfig, t_s: float, *, own: int, radius_m: float = 8.0) -> FleetEstimate:
    """Everybody on circles, known to 0.2 m along the north-east diagonal and 0.1 m across."""
    n = len(config.ids)
    mean = np.zeros((n, 6))
    for slot in range(n):
        phase = 2 * math.pi * (slot / n + t_s / 30.0)
        mean[slot, :3] = (radius_m * math.cos(phase), radius_m * math.sin(phase), -5.0 - 2.0 * slot)
        mean[slot, 3:5] = (-math.sin(phase), math.cos(phase))
    covariance = np.diag([0.025, 0.025, 0.04, 0.01, 0.01, 0.01])
    covariance[0, 1] = covariance[1, 0] = 0.015  # variances along the diagonals 0.04 and 0.01 m2
    variance = np.tile(covariance.diagonal(), n)
    tick = round(t_s / config.fleet.period_s)
    return FleetEstimate(tick, 0, config.ids, mean.ravel(), variance, (0,) * n, covariance)


def diagnostics(config: FleetConfig, agent_id: int, *, seconds: int) -> Diagnostics:
    """A drone that is well, hears everybody ten times a second and loses one packet in ten."""
    received = {"received": 9.0 * seconds, "lost": 1.0 * seconds, "late": 0.0, "rejected": 0.0, "heard_age_s": 0.05}
    gauges = {"gps_fix_type": FIXES, "gps_age_s": 0.1, "tick_time_p99_s": 0.004}
    neighbours = {str(other): received | {"round_trip_s": 0.002} for other in config.neighbours(agent_id)}
    return Diagnostics(agent_id, "ok", (), {"ticks": 10 * seconds}, gauges, neighbours)


async def _fly(config_file: Path, agent_id: int) -> None:
    config = load_config(config_file)
    listener = Listener(lambda *_: None, lambda *_: None, lambda *_: None, lambda *_: None, lambda *_: None)
    radio = Radio(config, agent_id, config_file.parent, listener)
    sealer = Sealer(config.fleet.name, agent_id, boot=radio.identity.boot, signing=radio.identity.signing)
    await radio.open()
    for count in range(100_000):
        t_s = time.time() - config.fleet.epoch_unix_s  # the common clock: all beacons have everybody at one place
        radio.send(sealer.seal(fleet_estimate(config, t_s, own=agent_id), t_ns=time.time_ns()))
        if count % 10 == 0:
            said = diagnostics(config, agent_id, seconds=1 + count // 10)
            radio.send(sealer.seal(said, t_ns=time.time_ns()))
        await asyncio.sleep(config.fleet.period_s)


@contextmanager
def beacons(config_file: Path, ids: tuple[int, ...]) -> Iterator[dict[int, subprocess.Popen[bytes]]]:
    """A process for each id; all are gone at the end."""
    command = [sys.executable, "-m", "tests.support.beacon", str(config_file)]
    running = {one: subprocess.Popen([*command, str(one)], cwd=ROOT) for one in ids}
    try:
        yield running
    finally:
        for process in running.values():
            process.kill()
            process.wait(30)


if __name__ == "__main__":
    asyncio.run(_fly(Path(sys.argv[1]), int(sys.argv[2])))
