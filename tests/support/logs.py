"""Builders of small flight logs, byte by byte, and the truth beside the recorded cuts."""

from __future__ import annotations

import gzip
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import SensorsTable
from agent.mavlink.codec import Encoder, Message, mavlink
from agent.sensing.frames import FleetFrame
from sim_bridge.replay.logs import open_log
from sim_bridge.replay.logs.events import LogError, LogEvent, LogSource

LOGS = Path(__file__).parents[1] / "data" / "logs"
UNIX_S = 1_795_000_000.0
LAT_DEG, LON_DEG, ALT_M = 47.0, 8.0, 400.0
FRAME = FleetFrame(LAT_DEG, LON_DEG, ALT_M, msl=True)


def read(path: Path, frame: FleetFrame | None = FRAME) -> tuple[LogSource, list[LogEvent]]:
    """A log and all its events."""
    source = open_log(path, frame=frame, sensors=SensorsTable())
    return source, list(source.events())


def check_refusal(error: LogError, path: Path) -> None:
    """A refusal is one line that names the file."""
    assert "\n" not in str(error)
    assert str(path) in str(error)


# --- MAVLink ---------------------------------------------------------------------------------------------------


def record(unix_s: float, frame: bytes) -> bytes:
    """One record of a tlog."""
    return struct.pack(">Q", round(unix_s * 1e6)) + frame


def heartbeat(autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA) -> Message:
    """Of a quadrotor."""
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, autopilot, 0, 0, 4, 3)


def imu(boot_s: float, north: float = 0.0) -> Message:
    """HIGHRES_IMU at rest, but for the first axis."""
    return mavlink.MAVLink_highres_imu_message(
        round(boot_s * 1e6), north, 0.0, -9.8, 0.01, 0.02, 0.03, 0, 0, 0, 0, 0, 0, 0, 0x3F
    )


def attitude(boot_s: float) -> Message:
    """ATTITUDE_QUATERNION, level."""
    return mavlink.MAVLink_attitude_quaternion_message(round(boot_s * 1e3), 1, 0, 0, 0, 0, 0, 0)


def gps(boot_s: float, north_e7: int = 0) -> Message:
    """GPS_RAW_INT at the origin, or north of it."""
    return mavlink.MAVLink_gps_raw_int_message(
        round(boot_s * 1e6), 3, 470_000_000 + north_e7, 80_000_000, 400_000, 80, 120, 0, 0, 12, h_acc=500, v_acc=900
    )


@dataclass
class Flight:
    """A vehicle that sends 20 Hz of IMU and attitude, 5 Hz of GPS, 1 Hz of heartbeats."""

    system_id: int = 1
    boot_at_s: float = -100.0
    """Log time of its boot."""
    drift: float = 0.0
    """What log time gains on its boot clock per second."""
    latency_s: float = 0.0

    def records(self, from_s: float, to_s: float) -> list[tuple[float, bytes]]:
        """Log time of arrival and frame, for a span of log time."""
        encoder = Encoder(self.system_id, 1)
        made = []
        for step in range(round(from_s * 20), round(to_s * 20)):
            t_s = step / 20
            boot_s = (t_s - self.boot_at_s) / (1.0 + self.drift)
            messages = [imu(boot_s), attitude(boot_s)]
            if step % 4 == 0:
                messages.append(gps(boot_s, step))
            if step % 20 == 0:
                messages.append(heartbeat())
            made += [(t_s + self.latency_s, encoder.encode(message)) for message in messages]
        return made


def tlog(records: list[tuple[float, bytes]], unix_s: float = UNIX_S) -> bytes:
    """Records of log time and frame, in their order."""
    return b"".join(record(unix_s + t_s, frame) for t_s, frame in records)


# --- dataflash -------------------------------------------------------------------------------------------------

_PACKED = {each: each for each in "QBfIHd"} | {"L": "i", "e": "i", "c": "h", "C": "H", "N": "16s"}


def fmt(kind: int, name: str, characters: str, labels: str) -> bytes:
    """An FMT record."""
    length = struct.calcsize("<" + "".join(_PACKED[each] for each in characters)) + 3
    described = struct.pack("<BB4s16s64s", kind, length, name.encode(), characters.encode(), labels.encode())
    return b"\xa3\x95\x80" + described


FMT_OF_FMT = b"\xa3\x95\x80" + struct.pack(
    "<BB4s16s64s", 0x80, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns"
)


def entry(kind: int, characters: str, *values: float | bytes) -> bytes:
    """A record of a kind described before; values as stored."""
    return b"\xa3\x95" + bytes((kind,)) + struct.pack("<" + "".join(_PACKED[each] for each in characters), *values)


# --- recorded cuts ---------------------------------------------------------------------------------------------


@dataclass
class Truth:
    """A truth file: columns north east down, velocity, quaternion, by autopilot and Unix time."""

    frame: FleetFrame
    boot_s: NDArray[np.float64]
    unix_s: NDArray[np.float64]
    values: NDArray[np.float64]

    def at(self, times_s: NDArray[np.float64], clock_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values at times of a clock (``boot_s`` or ``unix_s``); NaN outside."""
        columns = [np.interp(times_s, clock_s, column, np.nan, np.nan) for column in self.values.T]
        return np.stack(columns, axis=1)


def load_truth(name: str) -> Truth:
    """The truth beside a cut."""
    with gzip.open(LOGS / f"{name}_truth.csv.gz", "rt") as file:
        words = file.readline().replace(";", " ").split()
        numbers = np.loadtxt(file, delimiter=",", skiprows=1)
    lat, lon, alt = (float(words[words.index(key) + 1]) for key in ("lat", "lon", "alt"))
    return Truth(FleetFrame(lat, lon, alt, msl=True), numbers[:, 0], numbers[:, 1], numbers[:, 2:])
