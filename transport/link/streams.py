"""Streams and key expressions: ``cl/v1/{fleet}/agent/{id:03d}/{stream}``.

Tick and round are in the packet header, never in the key: every key costs declarations on all peers.
"""

from __future__ import annotations

import re
from enum import StrEnum
from functools import lru_cache

from transport.errors import SettingsError

PREFIX = "cl/v1"
MIN_AGENT_ID, MAX_AGENT_ID = 1, 999
KEYS_KNOWN_AGAIN = 512
"""How many keys are known again once they were parsed: packets come under the same few."""

_FLEET_NAME = re.compile(r"[a-z0-9_-]{1,32}")
_KEY = re.compile(rf"{PREFIX}/([a-z0-9_-]{{1,32}})/agent/([0-9]{{3}})/([a-z]+)")


class Stream(StrEnum):
    """Last chunk of an agent's key expressions."""

    MEAS = "meas"
    """Measurement records, every tick."""
    INFO = "info"
    """Consensus information, every round."""
    EST = "est"
    """The agent's estimate of the fleet, every tick."""
    FAR = "far"
    """Of fleets too large for one joint state: what drones report of themselves, passed on hop by hop at 1 Hz."""
    UWB = "uwb"
    """Ranges from a UWB driver process to the agent of the same id (``uwb-range/1``, no packet header)."""
    ALIVE = "alive"
    """Liveliness token."""
    CLOCK = "clock"
    """Queryable for the clock offset."""
    AGREE = "agree"
    """What the agent shares with the fleet, at 1 Hz while somebody's packets say that they share something else."""
    DIAG = "diag"
    """Health and counters, once a second."""


def check_fleet_name(fleet: str) -> str:
    """The name itself; raises `SettingsError` unless it is 1 to 32 of ``a-z 0-9 _ -``."""
    if not _FLEET_NAME.fullmatch(fleet):
        raise SettingsError(f"fleet name {fleet!r}: expected 1 to 32 characters of a-z, 0-9, '_' and '-'")
    return fleet


def check_agent_id(agent_id: int) -> int:
    """The id itself; raises `SettingsError` unless it is an integer from 1 to 999."""
    if isinstance(agent_id, bool) or not isinstance(agent_id, int) or not 1 <= agent_id <= MAX_AGENT_ID:
        raise SettingsError(f"agent id {agent_id!r}: expected an integer from 1 to {MAX_AGENT_ID}")
    return agent_id


def agent_name(fleet: str, agent_id: int) -> str:
    """Common name of an agent's certificate, which access control goes by."""
    return f"{check_fleet_name(fleet)}.agent.{check_agent_id(agent_id):03d}"


def observer_name(fleet: str) -> str:
    """Common name of the certificate of those who only listen."""
    return f"{check_fleet_name(fleet)}.observer"


def key_expression(fleet: str, agent_id: int, stream: Stream) -> str:
    """Key of one stream of one agent; raises `SettingsError` for a bad fleet name or id."""
    return f"{PREFIX}/{check_fleet_name(fleet)}/agent/{check_agent_id(agent_id):03d}/{stream.value}"


def self_contained(key: str) -> str:
    """A key expression that matches the key, and that Zenoh declares in one message.

    A literal key it declares in two: once per link a number for the key, then the subscription by that number. If a
    datagram link loses the first, all that follows on that key is thrown away there. Keys that begin with a wildcard
    go without a number.
    """
    return "*" + key.removeprefix(PREFIX.partition("/")[0])


def presence_pattern(fleet: str) -> str:
    """Key expression that matches the liveliness tokens of the whole fleet."""
    return f"{PREFIX}/{check_fleet_name(fleet)}/agent/*/{Stream.ALIVE.value}"


@lru_cache(KEYS_KNOWN_AGAIN)
def parse_key(key: str) -> tuple[str, int, Stream] | None:
    """Fleet, agent id and stream of a key; ``None`` if it is not one of ours."""
    match = _KEY.fullmatch(key)
    if match is None or match[3] not in Stream.__members__.values() or int(match[2]) < MIN_AGENT_ID:
        return None
    return match[1], int(match[2]), Stream(match[3])
