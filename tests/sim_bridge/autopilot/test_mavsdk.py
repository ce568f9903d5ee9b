"""The real MAVSDK client on real UDP: what it needs of an autopilot, the fake ones give."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest

from agent.config.endpoints import parse_endpoint
from sim_bridge.world.scenario import Interval, Scenario, Vehicle
from sim_bridge.world.simulation import Simulation
from sim_bridge.world.simulator import Simulator
from tests.support.ports import free_port

mavsdk = pytest.importorskip("mavsdk.asyncio", reason="the MAVSDK client is not installed: its tests are skipped")
from mavsdk import logging as mavsdk_logging  # noqa: E402
from mavsdk.asyncio.plugins.action import ActionAsync  # noqa: E402
from mavsdk.asyncio.plugins.param import ParamAsync  # noqa: E402
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync  # noqa: E402
from mavsdk.plugins.telemetry import TelemetryError  # noqa: E402

BOTH = pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
WAIT_S = 10.0
"""Bound of every wait for an event; nothing waits for a time to pass."""
RUN_S = 60.0


@asynccontextmanager
async def client_of(scenario: Scenario) -> AsyncIterator[tuple[Any, Any, Simulation]]:
    """A MAVSDK client, the systems' port served by a simulator in real time, and its simulation."""
    mavsdk_logging.log_subscribe(lambda *_arguments: True)
    port, stop = free_port(), asyncio.Event()
    simulation = Simulation(scenario, time.monotonic(), time.time() - time.monotonic())
    simulator = Simulator(simulation, lambda _observer, _payload: True)
    links = {agent: parse_endpoint(f"udpin://127.0.0.1:{port}") for agent in scenario.ids}
    station = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
    async with mavsdk.Mavsdk(station) as client:
        await client.add_any_connection(f"udpin://127.0.0.1:{port}")
        async with simulator.serve(links):
            running = asyncio.create_task(simulator.run(RUN_S, stop))
            try:
                yield client, simulator, simulation
            finally:
                stop.set()
                await running


async def take(stream: Any, count: int, wanted: Callable[[Any], bool] = lambda _item: True) -> list[Any]:
    """The first ``count`` wanted items of a subscription, within the bound."""

    async def collect() -> list[Any]:
        items: list[Any] = []
        async for item in stream:
            if wanted(item):
                items.append(item)
            if len(items) == count:
                break
        return items

    try:
        return await asyncio.wait_for(collect(), WAIT_S)
    finally:
        await stream.aclose()


def on_ground(flavour: Any) -> Vehicle:
    return Vehicle(1, flavour, 7, start_m=(3.0, -2.0, 0.0), on_ground=True)


@BOTH
async def test_it_connects_sets_rates_and_reads_the_sensors(make_scenario, flavour):
    async with client_of(make_scenario(on_ground(flavour))) as (client, _, simulation):
        system = await client.first_autopilot(timeout_s=WAIT_S)
        # it knows what it talks to
        assert await system.get_system_id() == 7
        assert (await system.autopilot_type()).name == {"px4": "PX4", "ardupilot": "ARDUPILOT"}[flavour]
        telemetry = TelemetryAsync(system)
        # rates: those of own streams accepted, others refused with the flavour's word
        await telemetry.set_rate_attitude_quaternion(50.0)
        await telemetry.set_rate_raw_gps(10.0)
        if flavour == "px4":
            await telemetry.set_rate_imu(100.0)
            samples = await take(telemetry.subscribe_imu(), 60)
            with pytest.raises(TelemetryError, match="UNKNOWN"):
                await telemetry.set_rate_raw_imu(50.0)
            rate_hz, unit_mps2 = 100.0, 1.0
        else:
            await telemetry.set_rate_raw_imu(50.0)
            samples = await take(telemetry.subscribe_raw_imu(), 60)
            with pytest.raises(TelemetryError, match="DENIED"):
                await telemetry.set_rate_imu(50.0)
            rate_hz, unit_mps2 = 50.0, 9.80665e-3
        # the last of them are at the rate asked for (the first ones may be from before)
        steps_us = np.diff([sample.timestamp_us for sample in samples[20:]])
        assert 1e6 / steps_us.mean() == pytest.approx(rate_hz, rel=0.05)
        down = [unit_mps2 * sample.acceleration_frd.down_m_s2 for sample in samples]
        assert np.mean(down) == pytest.approx(-simulation.scenario.gravity, abs=0.06)
        # raw GPS with true accuracies, at the place of the vehicle
        (fix,) = await take(telemetry.subscribe_raw_gps(), 1)
        frame = simulation.scenario.frame
        place = frame.ned(fix.latitude_deg, fix.longitude_deg, fix.absolute_altitude_m)
        np.testing.assert_allclose(place, (3.0, -2.0, 0.0), atol=0.17)
        assert fix.horizontal_uncertainty_m == pytest.approx(0.087, abs=1e-3)
        assert fix.altitude_ellipsoid_m - fix.absolute_altitude_m == pytest.approx(40.0, abs=2e-3)
        # a level attitude
        (attitude,) = await take(telemetry.subscribe_attitude_quaternion(), 1)
        assert (attitude.w, attitude.x, attitude.y, attitude.z) == pytest.approx((1.0, 0.0, 0.0, 0.0))
        origin = await telemetry.get_gps_global_origin()
        assert origin.latitude_deg == pytest.approx(fix.latitude_deg, abs=5e-6)
        await ParamAsync(system).set_param_int("EKF2_EV_CTRL" if flavour == "px4" else "VISO_TYPE", 3)
        assert await ParamAsync(system).get_param_int("EKF2_EV_CTRL" if flavour == "px4" else "VISO_TYPE") == 3


@BOTH
async def test_it_sees_a_reboot(make_scenario, flavour):
    async with client_of(make_scenario(on_ground(flavour))) as (client, _, _simulation):
        system = await client.first_autopilot(timeout_s=WAIT_S)
        telemetry = TelemetryAsync(system)
        await telemetry.set_rate_attitude_quaternion(50.0)
        before = await take(telemetry.subscribe_attitude_quaternion(), 20)
        await ActionAsync(system).reboot()
        if flavour == "ardupilot":  # its streams are off after a boot; asking is repeated until it answers
            await telemetry.set_rate_attitude_quaternion(50.0)
        after = await take(
            telemetry.subscribe_attitude_quaternion(),
            1,
            wanted=lambda sample: sample.timestamp_us < before[-1].timestamp_us,
        )
        assert after[0].timestamp_us < before[-1].timestamp_us


@BOTH
async def test_it_sees_the_heartbeat_go_and_come_back(make_scenario, flavour):
    # GIVEN a link that is dead from 1.2 s to 5.4 s
    scenario = make_scenario(on_ground(flavour), silences=(Interval(1, 1.2, 5.4),))
    async with client_of(scenario) as (client, _, simulation):
        system = await client.first_autopilot(timeout_s=WAIT_S)
        changes = system.is_connected_state()
        gone, back = await take(changes, 2)
        assert (gone, back) == (False, True)
        assert simulation.world.time_s >= 5.4


async def test_one_port_serves_a_whole_fleet(make_scenario):
    fleet = tuple(Vehicle(agent, "px4", agent) for agent in (1, 2, 3))
    async with client_of(make_scenario(*fleet)) as (client, _, _simulation):
        seen: set[int] = set()

        async def all_seen() -> None:
            async for _ in client.on_new_system():
                seen.update([await system.get_system_id() for system in await client.get_systems()])
                if seen == {1, 2, 3}:
                    return

        seen.update([await system.get_system_id() for system in await client.get_systems()])
        if seen != {1, 2, 3}:
            await asyncio.wait_for(all_seen(), WAIT_S)
        assert seen == {1, 2, 3}


async def test_it_loses_the_fix_when_gps_is_cut(make_scenario):
    scenario = make_scenario(on_ground("px4"), gps_outages=(Interval(1, 1.0, 1e9),))
    async with client_of(scenario) as (client, _, _simulation):
        telemetry = TelemetryAsync(await client.first_autopilot(timeout_s=WAIT_S))
        (info,) = await take(telemetry.subscribe_gps_info(), 1, wanted=lambda info: info.fix_type.value == 0)
        assert info.fix_type.name == "NO_GPS"
