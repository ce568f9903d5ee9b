"""The parameters of an autopilot on which it depends whether it uses what it is given, and what they should be.

They are read (PARAM_REQUEST_READ), never set. Sources: the firmware's documentation of its parameters, and flights on
PX4 1.16 (SIH) and ArduCopter 4.7 (SITL).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from agent.feedback.feedback_table import FeedbackKind
from agent.mavlink.codec import Message, mavlink

ATTEMPTS, RETRY_S = 5, 1.0
ASK_EVERY_S = 0.1
"""One request at a time: a burst is lost on slow links."""
EXTERNAL_NAV, COMPASS, MAV_VISION, MAV_GPS = 6, 1, 1, 14


@dataclass(frozen=True, slots=True)
class Requirement:
    """One parameter: whether a value is right, what it should be, what for, and whether a change needs a reboot."""

    name: str
    holds: Callable[[float], bool]
    wanted: str
    why: str
    reboot: bool = False
    needed: bool = True
    """Whether nothing is used without; else it is used, but worse."""


def _is(value: float) -> Callable[[float], bool]:
    return lambda found: found == value


def _has_bit(bit: int) -> Callable[[float], bool]:
    return lambda found: bool(int(found) >> bit & 1)


_PX4_ODOMETRY = (
    Requirement("EKF2_EV_CTRL", _has_bit(0), "5 (bit 0: horizontal position, bit 2: velocity)", "else no position"),
    Requirement("EKF2_EV_QMIN", lambda v: v <= 30, "0", "else messages of a lower quality are left out"),
    Requirement(
        "EKF2_EV_NOISE_MD", _is(0), "0", "else its own noise counts, not the covariance sent", needed=False
    ),
    Requirement("EKF2_EV_DELAY", lambda v: v <= 50, "0", "the stamps are true already", reboot=True, needed=False),
    Requirement(
        "EKF2_DELAY_MAX", lambda v: v >= 300, "300 or more", "else estimates older than it are left out",
        reboot=True, needed=False,
    ),
)  # fmt: skip
_PX4_GLOBAL = (
    Requirement("EKF2_AGP0_ID", _is(1), "1", "the id in our messages"),
    Requirement("EKF2_AGP0_CTRL", _has_bit(0), "1 (bit 0: horizontal position)", "else no position"),
    Requirement("EKF2_AGP0_NOISE", lambda v: v <= 0.5, "0.3", "no error counts as smaller", needed=False),
    Requirement(
        "EKF2_AGP0_DELAY", lambda v: 100 <= v <= 250, "150", "it is stamped by its arrival",
        reboot=True, needed=False,
    ),
)  # fmt: skip
_ARDUPILOT_ODOMETRY = (
    Requirement("VISO_TYPE", _is(MAV_VISION), "1 (MAVLink)", "else the messages are not read", reboot=True),
    Requirement("EK3_SRC2_POSXY", _is(EXTERNAL_NAV), "6 (ExternalNav)", "else set 2 has no position", reboot=True),
    Requirement(
        "EK3_SRC2_VELXY", lambda v: v in (0, EXTERNAL_NAV), "6 (ExternalNav)", "GPS is gone then", reboot=True
    ),
    Requirement("EK3_SRC2_YAW", _is(COMPASS), "1 (compass)", "we send no yaw of our own", reboot=True),
    Requirement(
        "VISO_DELAY_MS", lambda v: 100 <= v <= 250, "150", "else the estimate counts as newer than it is",
        reboot=True, needed=False,
    ),
    Requirement("VISO_QUAL_MIN", lambda v: v <= 30, "0", "else messages of a lower quality are left out"),
)  # fmt: skip
_GPS_AUTO_SWITCH = Requirement(
    "GPS_AUTO_SWITCH", lambda v: v in (1, 4), "4 (the first receiver while it has a fix)", "else it never takes ours"
)


def requirements(flavour: str, kind: FeedbackKind, gps_id: int = 1) -> tuple[Requirement, ...]:
    """Of an autopilot (``px4``, ``ardupilot``) that is given the estimate as ``kind``; none where it cannot be."""
    if kind == "gps_input" and flavour == "ardupilot":
        name = f"GPS{gps_id + 1}_TYPE"
        receiver = Requirement(name, _is(MAV_GPS), f"{MAV_GPS} (MAVLink)", "else GPS_INPUT is not read", reboot=True)
        return (receiver, _GPS_AUTO_SWITCH) if gps_id else (receiver,)
    tables: dict[tuple[str, str], tuple[Requirement, ...]] = {
        ("px4", "odometry"): _PX4_ODOMETRY,
        ("px4", "global"): _PX4_GLOBAL,
        ("ardupilot", "odometry"): _ARDUPILOT_ODOMETRY,
    }
    return tables.get((flavour, kind), ())


def parameter_value(message: Message, flavour: str) -> float:
    """The value in a PARAM_VALUE: PX4 sends integers as the bytes of an int32, ArduPilot as numbers."""
    encoded = float(message.param_value)
    if flavour == "px4" and message.param_type != mavlink.MAV_PARAM_TYPE_REAL32:
        return float(struct.unpack("<i", struct.pack("<f", encoded))[0])
    return encoded


def parameter_name(message: Message) -> str:
    """The name in a PARAM_VALUE."""
    name = message.param_id
    text = name if isinstance(name, str) else name.decode("ascii", "replace")
    return text.rstrip("\0")


class ParameterReader:
    """Reads parameters by name; ``values`` are those that came, of whoever asked for them."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self._asked: dict[str, tuple[int, float]] = {}
        """How often each was asked for, and when last."""
        self._next_s = float("-inf")

    def reset(self) -> None:
        """Ask for all anew, as after a reboot."""
        self.values.clear()
        self._asked.clear()

    def on_value(self, message: Message, flavour: str) -> None:
        """A PARAM_VALUE; one that is no number says nothing."""
        value = parameter_value(message, flavour)
        if math.isfinite(value):
            self.values[parameter_name(message)] = value

    def due(self, wanted: tuple[Requirement, ...], now_s: float) -> str | None:
        """The parameter to ask for now; one that is never answered is not there in this firmware."""
        if now_s < self._next_s:
            return None
        for each in wanted:
            attempts, asked_s = self._asked.get(each.name, (0, float("-inf")))
            if each.name not in self.values and attempts < ATTEMPTS and now_s - asked_s >= RETRY_S:
                self._asked[each.name] = attempts + 1, now_s
                self._next_s = now_s + ASK_EVERY_S
                return each.name
        return None


def unmet(wanted: tuple[Requirement, ...], values: Mapping[str, float]) -> list[tuple[Requirement, float]]:
    """What was read and is not as it should be, what nothing works without first."""
    wrong = [(each, values[each.name]) for each in wanted if each.name in values]
    return sorted(((r, v) for r, v in wrong if not r.holds(v)), key=lambda pair: not pair[0].needed)
