"""Flies a scripted mission with the MAVSDK client: arm, take off, waypoints, land; every drone at the same time.

The client knows nothing of us: it talks to the autopilots through the bridge's client ports as any ground station
would. Health flags are not waited for, since ArduPilot streams none of them by itself: arming is simply tried again
until it is allowed.

Requests are made with callbacks, not with the client's blocking calls: MAVSDK 4.1 sometimes answers a request twice,
on which its own blocking wrapper aborts the process ("promise already satisfied") or waits for ever.
"""

from __future__ import annotations

import asyncio
import functools
import math
import time
from collections.abc import Callable
from typing import Any

from agent.config.tables import FleetConfig
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Triple
from sim_bridge.sitl.mission import DroneMission, Mission
from sim_bridge.sitl.setup import LOCAL_HOST, vehicle_links
from sim_bridge.world import geodesy

CONNECT_TIMEOUT_S = 20.0
POLL_S = 0.2
RETRY_S = 2.0
PATIENCE_S = 10.0
"""Refusals and silence of what ought to be accepted are put up with for this long."""
REQUEST_TIMEOUT_S = 15.0
LIFTOFF_S, LIFTOFF_M = 4.0, 0.5
DISARM_S = 3.0
"""Autopilots disarm by themselves after landing; one that did not by then is told to."""
TELEMETRY_HZ = 5.0
KNOWN_AUTOPILOTS = ("PX4", "ARDUPILOT")
Say = Callable[[str], None]


class MissionFailed(Exception):
    """The mission was broken off; the message names the drone, what it was to do and what it answered."""

    exit_code = 1


class ClientMissing(OSError):
    """The MAVSDK client is not installed."""


def require_client() -> None:
    """Raises `ClientMissing` if the MAVSDK client is not installed."""
    try:
        import mavsdk  # noqa: F401
    except ImportError as error:
        raise ClientMissing(
            "a mission cannot be flown: mavsdk is not installed (pip install 'fleetloc[sitl]')"
        ) from error


class Pilot:
    """One drone's flight."""

    def __init__(self, system: Any, mission: Mission, drone: DroneMission, frame: FleetFrame, say: Say) -> None:
        from mavsdk.plugins.action import Action
        from mavsdk.plugins.telemetry import Telemetry

        self.name = f"drone {drone.agent}"
        self._action, self._telemetry = Action(system), Telemetry(system)
        self._system, self._mission, self._drone, self._frame, self._say = system, mission, drone, frame, say
        self.airborne = False

    async def arm_and_climb(self) -> None:
        """Arm as soon as the autopilot lets us, take off, reach the height; raises `MissionFailed`."""
        await self._until_accepted("position rate", PATIENCE_S, self._telemetry.set_rate_position_async, TELEMETRY_HZ)
        await self._until_accepted(
            "landed state rate", PATIENCE_S, self._telemetry.set_rate_landed_state_async, TELEMETRY_HZ
        )
        await self._until_accepted("arm", self._mission.ready_timeout_s, self._action.arm_async)
        self._say(f"{self.name}: armed")
        await self._do("take-off height", self._action.set_takeoff_altitude_async, self._mission.takeoff_m)
        await self._take_off()
        wanted_m = self._mission.takeoff_m - self._mission.reached_m
        await self._wait(f"climb to {self._mission.takeoff_m:g} m", self._mission.climb_timeout_s,
                         lambda: self._higher_than(wanted_m))  # fmt: skip
        self._say(f"{self.name}: at height")

    async def _take_off(self) -> None:
        """A command that the client sent again since its answer was late is refused by who is climbing already."""
        self.airborne = True
        try:
            await self._do("take off", self._action.takeoff_async)
        except MissionFailed:
            deadline_s = time.monotonic() + LIFTOFF_S
            while not self._higher_than(LIFTOFF_M):
                if time.monotonic() > deadline_s:
                    raise
                await asyncio.sleep(POLL_S)

    async def fly_way(self) -> None:
        """One waypoint after the other; raises `MissionFailed`."""
        if self._mission.speed_mps is not None:
            await self._do("speed", self._action.set_current_speed_async, self._mission.speed_mps)
        for number, point_m in enumerate(self._drone.waypoints_m, 1):
            lat_deg, lon_deg, height_m = self._frame.geodetic(point_m)
            alt_msl_m = geodesy.msl_m(self._frame, height_m)
            what = f"waypoint {number} of {len(self._drone.waypoints_m)}"
            await self._until_accepted(
                what, PATIENCE_S, self._action.goto_location_async, lat_deg, lon_deg, alt_msl_m, math.nan
            )
            await self._wait(what, self._mission.leg_timeout_s, functools.partial(self._near, point_m))
            self._say(f"{self.name}: {what}")
            await asyncio.sleep(self._drone.hold_s)

    async def land(self) -> None:
        """Land where it is and wait for the ground; raises `MissionFailed`."""
        await self._until_accepted("land", PATIENCE_S, self._action.land_async)
        await self._wait("land", self._mission.land_timeout_s, self.on_ground)
        self.airborne = False
        self._say(f"{self.name}: landed")
        deadline_s = time.monotonic() + DISARM_S
        while self._telemetry.armed():
            if time.monotonic() > deadline_s:
                await self._do("disarm", self._action.disarm_async)
                return
            await asyncio.sleep(POLL_S)

    # --- what the autopilot says ----------------------------------------------------------------------------

    def _position_m(self) -> Triple | None:
        """NED in the fleet frame by the autopilot's own estimate; ``None`` before it has one."""
        place = self._telemetry.position()
        numbers = (place.latitude_deg, place.longitude_deg, place.absolute_altitude_m)
        if not all(map(math.isfinite, numbers)):
            return None
        return self._frame.ned(*numbers[:2], geodesy.from_msl_m(self._frame, numbers[2]))

    def _near(self, point_m: Triple) -> bool:
        position_m = self._position_m()
        return position_m is not None and math.dist(position_m, point_m) <= self._mission.reached_m

    def _higher_than(self, height_m: float) -> bool:
        place = self._telemetry.position()
        return bool(place.relative_altitude_m >= height_m)  # false for NaN

    def on_ground(self) -> bool:
        """Whether it says that it stands on the ground."""
        return bool(self._telemetry.landed_state().name == "ON_GROUND")

    # --- doing and waiting ----------------------------------------------------------------------------------

    async def _do(self, what: str, request: Callable[..., None], *arguments: float) -> None:
        """Make a request, whose last argument is its callback, and wait for the first answer."""
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[Any] = loop.create_future()

        def settle(result: Any) -> None:
            if not answer.done():
                answer.set_result(result)

        # the client calls back on a thread of its own
        request(*arguments, lambda result, _user: loop.call_soon_threadsafe(settle, result))
        try:
            result = await asyncio.wait_for(answer, REQUEST_TIMEOUT_S)
        except TimeoutError as error:
            raise MissionFailed(f"{self.name}: {what}: no answer within {REQUEST_TIMEOUT_S:g} s") from error
        if result.name != "SUCCESS":
            raise MissionFailed(f"{self.name}: {what}: refused with {result.name}")

    async def _until_accepted(
        self, what: str, timeout_s: float, request: Callable[..., None], *arguments: float
    ) -> None:
        """Make a request again and again until it is accepted."""
        deadline_s = time.monotonic() + timeout_s
        told = ""
        while True:
            try:
                await self._do(what, request, *arguments)
            except MissionFailed as error:
                if time.monotonic() > deadline_s:
                    raise MissionFailed(f"{error} for {timeout_s:g} s") from error
                if str(error) != told:
                    told = str(error)
                    self._say(f"{told}; trying again")
                await asyncio.sleep(RETRY_S)
            else:
                return

    async def _wait(self, what: str, timeout_s: float, done: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + timeout_s
        while not done():
            if time.monotonic() > deadline_s:
                where = self._position_m()
                place = "nowhere known" if where is None else f"at ({', '.join(f'{axis:.1f}' for axis in where)}) m"
                raise MissionFailed(f"{self.name}: {what}: expected within {timeout_s:g} s, found it {place}")
            if not self._system.is_connected():
                raise MissionFailed(f"{self.name}: {what}: the autopilot's heartbeat is lost")
            await asyncio.sleep(POLL_S)


async def fly_mission(config: FleetConfig, mission: Mission, say: Say) -> None:
    """Fly the whole mission; raises `MissionFailed` after having told every drone in the air to land."""
    require_client()
    from mavsdk import ComponentType, Configuration, Mavsdk
    from mavsdk import logging as client_logging

    client_logging.log_subscribe(lambda *_arguments: True)  # it would print on our stdout
    station = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    with Mavsdk(station) as client:
        pilots = await _connect(client, config, mission, say)
        try:
            await _all(pilot.arm_and_climb() for pilot in pilots)
            await _all(pilot.fly_way() for pilot in pilots)
            await _all(pilot.land() for pilot in pilots)
        except MissionFailed:
            await _come_down(pilots, say)
            raise


async def _connect(client: Any, config: FleetConfig, mission: Mission, say: Say) -> list[Pilot]:
    links, frame = vehicle_links(config), FleetFrame.of(config)
    for drone in mission.drones:
        client.add_any_connection(f"udpout://{LOCAL_HOST}:{links[drone.agent].client_port}")
    wanted = {config.system_id(drone.agent): drone for drone in mission.drones}
    systems: dict[int, Any] = {}
    deadline_s = time.monotonic() + CONNECT_TIMEOUT_S
    while len(systems) < len(wanted):
        for system in client.get_systems():
            system_id = system.get_system_id()
            # what a take-off means depends on the autopilot: to one that is not known yet MAVSDK says a height above
            # the sea where PX4 expects none
            known = system.autopilot_type().name in KNOWN_AUTOPILOTS
            if system_id in wanted and system_id not in systems and system.has_autopilot() and known:
                systems[system_id] = system
        if time.monotonic() > deadline_s:
            missing = [str(drone.agent) for system_id, drone in wanted.items() if system_id not in systems]
            raise MissionFailed(
                f"drone {', '.join(missing)}: expected its autopilot on the bridge within {CONNECT_TIMEOUT_S:g} s"
            )
        await asyncio.sleep(POLL_S)
    return [Pilot(systems[system_id], mission, drone, frame, say) for system_id, drone in wanted.items()]


async def _all(flights: Any) -> None:
    """All at once; the first failure ends the others and is raised."""
    tasks = [asyncio.ensure_future(flight) for flight in flights]
    try:
        await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _come_down(pilots: list[Pilot], say: Say) -> None:
    flying = [pilot for pilot in pilots if pilot.airborne and not pilot.on_ground()]
    for failed in await asyncio.gather(*(pilot.land() for pilot in flying), return_exceptions=True):
        if isinstance(failed, BaseException):
            say(f"after the mission was broken off: {failed}")
