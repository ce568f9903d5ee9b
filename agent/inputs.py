"""Everything that comes into an agent from outside, as values: with the configuration they are its whole run.

Each is what one call of `agent.onboard.OnboardAgent` was given, at full precision. ``host_s`` is the host's
monotonic clock in s, ``unix_*`` its UTC clock.
"""

from __future__ import annotations

from typing import Protocol

import msgspec


class MavlinkIn(msgspec.Struct, frozen=True):
    """Bytes read from the autopilot's link; ``frames`` are the whole good frames that they completed."""

    host_s: float
    data: bytes
    frames: tuple[bytes, ...]


class Served(msgspec.Struct, frozen=True):
    """The autopilot's link was served: what was due then was sent."""

    host_s: float


class PacketIn(msgspec.Struct, frozen=True):
    """A neighbour's packet as it came, whatever then becomes of it.

    It arrived at ``arrived_s`` and was opened at ``host_s``: between them lie queues and the injected delay.
    """

    host_s: float
    unix_ns: int
    arrived_s: float
    key: str
    data: bytes


class UwbIn(msgspec.Struct, frozen=True):
    """A ``uwb-range/1`` frame of the own module, at its arrival."""

    host_s: float
    data: bytes


class Gone(msgspec.Struct, frozen=True):
    """A neighbour's liveliness token went."""

    host_s: float
    agent: int


class Due(msgspec.Struct, frozen=True):
    """The core was told to do what is due."""

    host_s: float


class HouseKept(msgspec.Struct, frozen=True):
    """Once a second: the clock was compared with UTC."""

    host_s: float
    unix_s: float


Input = MavlinkIn | Served | PacketIn | UwbIn | Gone | Due | HouseKept


class Journal(Protocol):
    """Takes down what comes in, in the order in which the agent takes it in; must be quick and never raise."""

    def note(self, event: Input, unix_s: float) -> None:
        """An input, just before the agent acts on it; ``unix_s`` for people: UTC as the fleet clock has it."""

    def note_sent(self, frames: list[bytes], unix_s: float) -> None:
        """Frames sent to the autopilot."""
