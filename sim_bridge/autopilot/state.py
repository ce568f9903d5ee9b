"""What a fake autopilot knows of itself, and the vehicle it is bolted to."""

from __future__ import annotations

import math
import struct
from typing import Protocol

from agent.sensing.frames import FleetFrame
from sim_bridge.autopilot.external_feed import ExternalFeed
from sim_bridge.autopilot.failsafe import EstimatorFailsafe
from sim_bridge.autopilot.feed_clock import FeedClock
from sim_bridge.autopilot.flavours import Flavour, FlightMode, Parameter
from sim_bridge.autopilot.fusing import FIGURES, FusingNavigation
from sim_bridge.autopilot.global_feed import GlobalFeed
from sim_bridge.autopilot.navigation import Navigation
from sim_bridge.autopilot.streams import StreamTable
from sim_bridge.autopilot.truth_messages import TrueState
from sim_bridge.world import geodesy
from sim_bridge.world.quaternions import Array
from sim_bridge.world.sensors import SensedAttitude, SensedImu


class AutopilotVehicle(Protocol):
    """Sensors and actuators of one vehicle, as its autopilot sees them; positions NED in the fleet frame."""

    @property
    def landed(self) -> bool:
        """On the ground and at rest."""
        ...

    def imu(self) -> SensedImu:
        """A new sample."""
        ...

    def attitude(self) -> SensedAttitude:
        """The present attitude."""
        ...

    def true_state(self) -> TrueState:
        """What the simulator behind the autopilot knows."""
        ...

    def follow_path(self) -> None:
        """Fly the scenario's path."""
        ...

    def hold(self) -> None:
        """Stay where it is."""
        ...

    def go_to(self, position_m: tuple[float, float, float]) -> None:
        """Fly to a point and stay."""
        ...

    def climb(self, height_m: float) -> None:
        """Take off, this high above the ground."""
        ...

    def land(self) -> None:
        """Descend and rest."""
        ...


class CrystalClock:
    """Time since boot as the autopilot's crystal counts it."""

    def __init__(self, boot_s: float, skew_ppm: float = 0.0, quantum_us: int = 1) -> None:
        """``boot_s``: the moment of boot on the clock of ``now``."""
        self.boot_s = boot_s
        self._rate = 1.0 + 1e-6 * skew_ppm
        self._quantum_us = quantum_us

    def us(self, now: float) -> int:
        """Microseconds since boot, never negative."""
        # the small addend keeps a time that is a whole number of microseconds from being rounded down
        count = math.floor((now - self.boot_s) * self._rate * 1e6 + 1e-3)
        return max(count - count % self._quantum_us, 0)

    def ms(self, now: float) -> int:
        """Milliseconds since boot, modulo 2^32."""
        return self.us(now) // 1000 % (1 << 32)

    def ns(self, now: float) -> int:
        """Nanoseconds since boot, for TIMESYNC."""
        return max(round((now - self.boot_s) * self._rate * 1e9), 0)


class ParameterTable:
    """The parameters of one autopilot and their encoding on the wire."""

    def __init__(self, flavour: Flavour, system_id: int) -> None:
        self._bytewise = flavour.integers_bytewise
        self._values = dict(flavour.parameters)
        for name in ("MAV_SYS_ID", "SYSID_THISMAV"):
            if name in self._values:
                self._values[name] = Parameter(system_id)

    def __len__(self) -> int:
        return len(self._values)

    def value(self, name: str) -> float:
        """The value of a parameter; raises `KeyError` for an unknown one."""
        return self._values[name].value

    def names(self) -> list[str]:
        """Names in order of index."""
        return sorted(self._values)

    def encoded(self, name: str) -> tuple[float, bool]:
        """The float on the wire and whether the parameter is an integer."""
        parameter = self._values[name]
        if parameter.integer and self._bytewise:
            return float(struct.unpack("<f", struct.pack("<i", int(parameter.value)))[0]), True
        return parameter.value, parameter.integer

    def store(self, name: str, encoded: float) -> bool:
        """Set a parameter from the float on the wire; false for an unknown name or an impossible value."""
        known = self._values.get(name)
        if known is None:
            return False
        value = encoded
        if known.integer and self._bytewise:
            value = struct.unpack("<i", struct.pack("<f", encoded))[0]
        if not math.isfinite(value):
            return False
        self._values[name] = Parameter(round(value) if known.integer else value, known.integer)
        return True


class AutopilotState:
    """Everything that an autopilot's commands read and change; a reboot makes a new one."""

    def __init__(
        self,
        flavour: Flavour,
        frame: FleetFrame,
        clock: CrystalClock,
        parameters: ParameterTable,
        streams: StreamTable,
        *,
        airborne: bool,
        fusing: bool = False,
    ) -> None:
        """``fusing``: whether it navigates by a filter with the firmware's figures, and lands without positions."""
        self.flavour = flavour
        self.frame = frame
        self.clock = clock
        self.parameters = parameters
        self.streams = streams
        oldest_s = parameters.value("EKF2_DELAY_MAX") * 1e-3 if flavour.name == "px4" else math.inf
        self.navigation = FusingNavigation(flavour.name, oldest_s) if fusing else Navigation()
        self.failsafe = EstimatorFailsafe(FIGURES[flavour.name]) if fusing else None
        self.feed_clock = FeedClock(flavour.name, parameters.value)
        self.feed = ExternalFeed(flavour, parameters.value)
        self.global_feed = GlobalFeed(flavour.name, parameters.value, self.fleet_ned)
        self.armed = airborne
        self.mode = FlightMode.MISSION if airborne else FlightMode.HOLD
        self.home_m: Array | None = None
        self.reboot_asked = False
        self.hears_of_spoofing = False
        """Whether it is a firmware that can be told that its receiver is spoofed."""

    def geodetic(self, position_m: Array) -> tuple[float, float, float]:
        """Latitude and longitude in deg and MSL height in m of a point in the fleet frame."""
        north, east, down = (float(axis) for axis in position_m)
        lat_deg, lon_deg, height_m = self.frame.geodetic((north, east, down))
        return lat_deg, lon_deg, geodesy.msl_m(self.frame, height_m)

    def fleet_ned(self, lat_deg: float, lon_deg: float, alt_msl_m: float) -> tuple[float, float, float]:
        """The point in the fleet frame at latitude, longitude and MSL height."""
        return self.frame.ned(lat_deg, lon_deg, geodesy.from_msl_m(self.frame, alt_msl_m))

    def down_of_msl(self, alt_msl_m: float) -> float:
        """How far below the fleet's origin a height above mean sea level is."""
        return self.frame.alt_m - geodesy.from_msl_m(self.frame, alt_msl_m)
