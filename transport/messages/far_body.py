"""Far-field bodies: where drones beyond the sender's joint state are, each as that drone itself reports it.

Every drone of a large fleet reports its own state once a second, and everybody passes each report on once, hop by
hop. A report names its owner and the tick that it is of, so that whoever gets it knows how old it is. Wire form of a
report, 35 bytes, little endian::

    agent u16 | age u16 | status u8 | position f32 x3 | velocity f16 x3 |
    position sigmas f16 x3 | velocity sigmas f16 x3

``age`` is the packet's tick minus the report's. Sigmas are rounded up: a report never claims more than was known.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import MAX_AGENT_ID, MIN_AGENT_ID
from transport.messages.estimate_body import MAX_STATUS
from transport.messages.half_floats import LARGEST_HALF, half_up
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES
from transport.messages.measurement_body import MAX_POSITION_M, MAX_SPEED_MPS, Triple

_REPORT = struct.Struct("<HHB3f9e")
REPORT_BYTES = _REPORT.size
MAX_REPORTS = MAX_DATAGRAM_BODY_BYTES // REPORT_BYTES
"""As many as fit into one datagram."""
MAX_AGE_TICKS = 0xFFFF


@dataclass(frozen=True, slots=True)
class FarReport:
    """A drone's own state at ``tick``: NED m and m/s, 1-sigma per axis; ``status`` as in an estimate."""

    agent: int
    tick: int
    status: int
    position_m: Triple
    velocity_mps: Triple
    position_sigma_m: Triple
    velocity_sigma_mps: Triple


@dataclass(frozen=True, slots=True)
class FarReports:
    """Body of a far-field packet: the newest reports that its sender has and has not passed on yet."""

    tick: int
    reports: tuple[FarReport, ...]


def encode_far_reports(message: FarReports) -> bytes:
    """Body of a far-field packet; raises `EncodeError` for what is no report: NaN, a sigma of 0, a tick to come."""
    agents = [report.agent for report in message.reports]
    if not 1 <= len(agents) <= MAX_REPORTS or len(set(agents)) != len(agents):
        raise EncodeError(f"far reports of agents {agents}: expected 1 to {MAX_REPORTS} distinct ones")
    return b"".join(_encode_report(report, message.tick) for report in message.reports)


def _encode_report(report: FarReport, tick: int) -> bytes:
    age = tick - report.tick
    numbers_fit = (
        MIN_AGENT_ID <= report.agent <= MAX_AGENT_ID
        and 0 <= age <= MAX_AGE_TICKS
        and report.tick >= 0
        and 0 <= report.status <= MAX_STATUS
        and all(abs(value) <= MAX_POSITION_M for value in report.position_m)
        and all(abs(value) <= MAX_SPEED_MPS for value in report.velocity_mps)
        and all(0.0 < sigma <= LARGEST_HALF for sigma in (*report.position_sigma_m, *report.velocity_sigma_mps))
    )
    if not numbers_fit:
        raise EncodeError(f"{report} in a packet of tick {tick}: a number is out of range")
    sigmas = map(half_up, (*report.position_sigma_m, *report.velocity_sigma_mps))
    return _REPORT.pack(report.agent, age, report.status, *report.position_m, *report.velocity_mps, *sigmas)


def decode_far_reports(body: bytes, *, tick: int, count: int, roster: AbstractSet[int]) -> FarReports:
    """The reports of a body; the header says ``tick`` and ``count``. Raises `Rejected` unless all are good."""
    if not 1 <= count <= MAX_REPORTS or len(body) != count * REPORT_BYTES:
        raise Rejected(Reason.WRONG_DIMENSION, f"{len(body)} bytes for {count} far reports")
    reports = tuple(_report_from(fields, tick) for fields in _REPORT.iter_unpack(body))
    agents = {report.agent for report in reports}
    if len(agents) != count or not agents <= roster:
        raise Rejected(Reason.UNKNOWN_AGENT, f"far reports of agents {sorted(agents)}")
    return FarReports(tick, reports)


def _report_from(fields: tuple[float, ...], tick: int) -> FarReport:
    agent, age, status = (int(field) for field in fields[:3])
    position, velocity, sigmas = fields[3:6], fields[6:9], fields[9:15]
    if not all(map(math.isfinite, fields)):
        raise Rejected(Reason.NOT_FINITE, f"far report of agent {agent}")
    if (
        tick < age
        or status > MAX_STATUS
        or max(map(abs, position)) > MAX_POSITION_M
        or max(map(abs, velocity)) > MAX_SPEED_MPS
        or min(sigmas) <= 0.0
    ):
        raise Rejected(Reason.OUT_OF_RANGE, f"far report of agent {agent}")
    return FarReport(
        agent, tick - age, status, _triple(position), _triple(velocity), _triple(sigmas[:3]), _triple(sigmas[3:])
    )


def _triple(values: tuple[float, ...]) -> Triple:
    return values[0], values[1], values[2]
