"""A driver and a monitor of the public API on real sessions."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

import fleetloc
from agent.config.tables import SensorsTable
from agent.radio.security import agent_session
from agent.sensing.detections import DetectionAdapter
from agent.uwb.adapter import UwbAdapter
from fleetloc import Detection, FleetObserver, UwbDriver, UwbRange
from tests.fleetloc.monitor.test_monitor_live import fleet_file
from tests.support.beacon import beacons
from transport.link.session import Handlers, open_session
from transport.link.streams import Stream

PATIENCE_S = 60.0


@pytest.fixture
def config_file(tmp_path: Path) -> Path:
    return fleet_file(tmp_path, 'mode = "unsigned"')


async def test_ranges_of_a_driver_reach_the_daemon_of_its_drone(config_file: Path) -> None:
    """GIVEN a session that listens as drone 1's daemon does WHEN a driver publishes THEN it has the ranges."""
    config = fleetloc.load_config(config_file)
    frames: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()
    handlers = Handlers(lambda key, payload, _arrived_s: frames.put_nowait((key, payload)))
    settings = agent_session(config, 1, config_file.parent)
    daemon = await open_session(settings, config.fleet.name, 1, config.ids, handlers)
    daemon.subscribe(1, (Stream.UWB,))
    try:
        async with UwbDriver(config_file, 1) as driver:
            async with asyncio.timeout(PATIENCE_S):
                while frames.empty():
                    assert driver.publish([UwbRange(2, 12.5, 0.2), UwbRange(3, 7.0)])
                    await asyncio.sleep(0.05)
            key, frame = frames.get_nowait()
            assert key == driver.key == "cl/v1/watched/agent/001/uwb"
    finally:
        await daemon.close()
    taken_s = json.loads(frame)["t"] * 1e-9
    samples = UwbAdapter(1, (2, 3), SensorsTable()).receive(frame, now_s=100.0, host_s=taken_s, unix_s=1.8e9)
    assert [(sample.target, sample.range_m) for sample in samples] == [(2, 12.5), (3, 7.0)]


async def test_detections_of_a_camera_go_the_same_way(config_file: Path) -> None:
    config = fleetloc.load_config(config_file)
    frames: asyncio.Queue[bytes] = asyncio.Queue()
    handlers = Handlers(lambda _key, payload, _arrived_s: frames.put_nowait(payload))
    settings = agent_session(config, 1, config_file.parent)
    daemon = await open_session(settings, config.fleet.name, 1, config.ids, handlers)
    daemon.subscribe(1, (Stream.UWB,))
    seen = Detection(101, (0.6, 0.0, 0.8), 0.01, 50.0, 2.0)
    try:
        async with UwbDriver(config_file, 1) as driver:
            async with asyncio.timeout(PATIENCE_S):
                while frames.empty():
                    assert driver.publish_detections([seen], clock="none", axes="ned")
                    await asyncio.sleep(0.05)
    finally:
        await daemon.close()
    (sample,) = DetectionAdapter(1, {101}).receive(frames.get_nowait(), now_s=100.0, host_s=5.0, unix_s=1.8e9)
    assert (sample.target, sample.direction, sample.distance_m) == (101, (0.6, 0.0, 0.8), 50.0)


async def test_a_driver_says_what_is_wrong(config_file: Path) -> None:
    with pytest.raises(fleetloc.ConfigError, match=r"agents: expected the id of a drone .* 1, 2, 3, found 7"):
        UwbDriver(config_file, 7)
    driver = UwbDriver(config_file, 1)
    with pytest.raises(RuntimeError, match="async with"):
        driver.publish([UwbRange(2, 1.0)])
    async with driver:
        with pytest.raises(fleetloc.EncodeError):
            driver.publish([UwbRange(2, float("nan"))])
        assert driver.frames == 0, "what makes no frame takes no number"


async def test_an_observer_hears_estimates_and_health_of_all_drones(config_file: Path) -> None:
    heard: dict[int, set[type]] = {}
    with beacons(config_file, (1, 2, 3)):
        async with FleetObserver(config_file) as fleet, asyncio.timeout(PATIENCE_S):
            async for message in fleet:
                heard.setdefault(message.agent_id, set()).add(type(message.message))
                if len(heard) == 3 and all(len(kinds) == 2 for kinds in heard.values()):
                    break
            assert fleet.present == {1, 2, 3}
    assert set(heard) == {1, 2, 3}
    assert heard[1] == {fleetloc.FleetEstimate, fleetloc.Diagnostics}


async def test_what_is_not_taken_goes_and_is_counted(config_file: Path) -> None:
    with beacons(config_file, (1,)):
        async with FleetObserver(config_file, most_waiting=2) as fleet, asyncio.timeout(PATIENCE_S):
            while not fleet.dropped:
                await asyncio.sleep(0.05)
            first, second = await anext(fleet), await anext(fleet)
    assert first.received_s <= second.received_s
