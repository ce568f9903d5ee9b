"""Measurement bodies: compact records of what sensors said in the last ticks, what matters most first.

A packet carries the records of several ticks, own and relayed, so that one packet repairs the loss of
earlier ones; every record names the agent whose sensor it is. Wire form of a record, little endian::

    kind u8 | observer u16 | age u8 | [offset_s f32] | [other u16] | [anchor f32 x3] | values f32 |
    sigmas f16 | [half widths f16]

``age`` is the packet's tick minus the record's. Sigmas and half widths are rounded up, never down, so the
receiver never trusts a sensor more than its owner does; a half width beyond float16 becomes "no bound".
"""

from __future__ import annotations

import math
import struct
from collections.abc import Collection
from dataclasses import dataclass
from enum import IntEnum

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import MAX_AGENT_ID, MIN_AGENT_ID
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES

Triple = tuple[float, float, float]
NO_BOUND: Triple = (math.inf, math.inf, math.inf)

MAX_AGE_TICKS = 255
MAX_OFFSET_S = 10.0
MAX_POSITION_M = 1e6
MAX_SPEED_MPS = 1e4
MAX_RANGE_M = 1e5
MAX_ACCEL_MPS2 = 1e4


class MeasurementKind(IntEnum):
    """First byte of a record on the wire."""

    POSITION = 1
    VELOCITY = 2
    SPEED = 3
    RANGE = 4
    ANCHOR_RANGE = 5
    ACCELERATION = 6


@dataclass(frozen=True, slots=True)
class PositionMeasurement:
    """A position fix of ``observer``: NED m, variances m2 and hard bounds m per axis (inf = none).

    ``offset_s`` is the instant of the measurement minus the time of ``tick``, here and below.
    """

    observer: int
    tick: int
    position_m: Triple
    variance_m2: Triple
    half_width_m: Triple = NO_BOUND
    offset_s: float = 0.0


@dataclass(frozen=True, slots=True)
class VelocityMeasurement:
    """A velocity of ``observer``: NED m/s, variances (m/s)2 and hard bounds m/s per axis (inf = none)."""

    observer: int
    tick: int
    velocity_mps: Triple
    variance_m2ps2: Triple
    half_width_mps: Triple = NO_BOUND
    offset_s: float = 0.0


@dataclass(frozen=True, slots=True)
class SpeedMeasurement:
    """The norm of ``observer``'s velocity as measured, m/s (noise can make it negative)."""

    observer: int
    tick: int
    speed_mps: float
    variance_m2ps2: float
    half_width_mps: float = math.inf
    offset_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RangeMeasurement:
    """The range from ``observer`` to agent ``other`` as measured, m."""

    observer: int
    tick: int
    other: int
    range_m: float
    variance_m2: float
    half_width_m: float = math.inf
    offset_s: float = 0.0


@dataclass(frozen=True, slots=True)
class AnchorRangeMeasurement:
    """The range from ``observer`` to a fixed anchor at ``anchor_m`` (NED m) as measured, m."""

    observer: int
    tick: int
    anchor_m: Triple
    range_m: float
    variance_m2: float
    half_width_m: float = math.inf
    offset_s: float = 0.0


@dataclass(frozen=True, slots=True)
class AccelerationMeasurement:
    """The acceleration of ``observer`` averaged over ``tick`` to ``tick + 1``: NED m/s2, gravity removed."""

    observer: int
    tick: int
    accel_mps2: Triple
    variance_m2ps4: Triple


Measurement = (
    PositionMeasurement
    | VelocityMeasurement
    | SpeedMeasurement
    | RangeMeasurement
    | AnchorRangeMeasurement
    | AccelerationMeasurement
)

_KIND_OF = {
    PositionMeasurement: MeasurementKind.POSITION,
    VelocityMeasurement: MeasurementKind.VELOCITY,
    SpeedMeasurement: MeasurementKind.SPEED,
    RangeMeasurement: MeasurementKind.RANGE,
    AnchorRangeMeasurement: MeasurementKind.ANCHOR_RANGE,
    AccelerationMeasurement: MeasurementKind.ACCELERATION,
}
_LAYOUT: dict[int, struct.Struct] = {
    MeasurementKind.POSITION: struct.Struct("<BHBf3f3e3e"),
    MeasurementKind.VELOCITY: struct.Struct("<BHBf3f3e3e"),
    MeasurementKind.SPEED: struct.Struct("<BHBffee"),
    MeasurementKind.RANGE: struct.Struct("<BHBfHfee"),
    MeasurementKind.ANCHOR_RANGE: struct.Struct("<BHBf3ffee"),
    MeasurementKind.ACCELERATION: struct.Struct("<BHB3f3e"),
}
_SINGLE, _SINGLES = struct.Struct("<f"), struct.Struct("<3f")
_HALF, _HALF_BITS = struct.Struct("<e"), struct.Struct("<H")
RECORD_BYTES = {kind: layout.size for kind, layout in _LAYOUT.items()}


@dataclass(frozen=True, slots=True)
class Measurements:
    """Body of a measurement packet: the records an agent tells at ``tick``, what matters most first.

    ``exchange`` counts the packets of a tick from 0; it travels as the header's round.
    """

    tick: int
    records: tuple[Measurement, ...]
    exchange: int = 0


@dataclass(frozen=True, slots=True)
class EncodedMeasurements:
    """A measurement body as bytes; ``left_out`` records did not fit, were too old or say nothing."""

    body: bytes
    count: int
    left_out: int


def identity(record: Measurement) -> tuple[MeasurementKind, int, int, int, float, Triple | None]:
    """What makes two records the same measurement, however often and by whomever it was sent.

    (kind, observer, other or 0, tick, offset as on the wire, anchor as on the wire).
    """
    other = record.other if isinstance(record, RangeMeasurement) else 0
    offset = 0.0 if isinstance(record, AccelerationMeasurement) else _single(record.offset_s)
    anchor = _singles(record.anchor_m) if isinstance(record, AnchorRangeMeasurement) else None
    return _KIND_OF[type(record)], record.observer, other, record.tick, offset, anchor


def as_sent(record: Measurement) -> Measurement:
    """The record with its numbers rounded as a receiver will see them; raises `EncodeError`.

    An agent that uses this for its own estimate works on the same numbers as everybody else. A record too
    uncertain to be sent (a sigma beyond float16) comes back as it is.
    """
    encoded = _encode_record(record, record.tick)
    if encoded is None:
        return record
    ids = (record.observer, record.other) if isinstance(record, RangeMeasurement) else (record.observer,)
    return _record_from(_LAYOUT[_KIND_OF[type(record)]].unpack(encoded), record.tick, ids)


def encode_measurements(
    measurements: Measurements, *, limit_bytes: int = MAX_DATAGRAM_BODY_BYTES
) -> EncodedMeasurements:
    """Records as bytes, in the order given, cut at ``limit_bytes``.

    Raises `EncodeError` for a record that is not a measurement: NaN, no variance, an id that is none, a tick
    later than the packet's.
    """
    parts: list[bytes] = []
    used = 0
    for record in measurements.records:
        encoded = _encode_record(record, measurements.tick)
        if encoded is None:
            continue
        if used + len(encoded) > limit_bytes:
            break  # what follows matters less: better nothing than that in place of this one
        parts.append(encoded)
        used += len(encoded)
    return EncodedMeasurements(b"".join(parts), len(parts), len(measurements.records) - len(parts))


def decode_measurements(
    body: bytes, *, tick: int, count: int, roster: Collection[int], exchange: int = 0
) -> Measurements:
    """Records of a body; the header says ``tick``, ``count``, ``exchange``. Raises `Rejected` unless all are good."""
    records: list[Measurement] = []
    at = 0
    for _ in range(count):
        try:
            layout = _LAYOUT[body[at]]
            fields = layout.unpack_from(body, at)
        except (IndexError, KeyError, struct.error):
            raise Rejected(Reason.MALFORMED, f"record {len(records)} at byte {at} of {len(body)}") from None
        records.append(_record_from(fields, tick, roster))
        at += layout.size
    if at != len(body):
        raise Rejected(Reason.MALFORMED, f"{len(body) - at} bytes after the last record")
    return Measurements(tick, tuple(records), exchange)


# --- one record --------------------------------------------------------------------------------------------


def _single(value: float) -> float:
    return float(_SINGLE.unpack(_SINGLE.pack(value))[0])


def _singles(values: Triple) -> Triple:
    return _triple(_SINGLES.unpack(_SINGLES.pack(*values)))


def _half_up(value: float) -> float:
    """The smallest float16 not below ``value`` >= 0; inf beyond its range."""
    if value > 65504.0:
        return math.inf
    packed = _HALF.pack(value)
    rounded: float = _HALF.unpack(packed)[0]
    if rounded < value:
        rounded = _HALF.unpack(_HALF_BITS.pack(_HALF_BITS.unpack(packed)[0] + 1))[0]
    return rounded


def _encode_record(record: Measurement, packet_tick: int) -> bytes | None:
    """Bytes of a record, ``None`` if it is too old or too uncertain to be worth any."""
    age = packet_tick - record.tick
    if record.tick < 0 or age < 0:
        raise EncodeError(f"{record}: expected a tick from 0 to the packet's tick {packet_tick}")
    _check_ids(record)
    values, limit, variances, half_widths = _numbers(record)
    for value in values:
        if not -limit <= value <= limit:
            raise EncodeError(f"{record}: values must be finite and at most {limit:g}")
    for variance in variances:
        if not 0 < variance < math.inf:
            raise EncodeError(f"{record}: variances must be finite and positive")
    for half_width in half_widths:
        if not half_width > 0:
            raise EncodeError(f"{record}: half widths must be positive (inf = no bound)")
    sigmas = [_half_up(math.sqrt(variance)) for variance in variances]
    if age > MAX_AGE_TICKS or math.inf in sigmas:
        return None
    middle: tuple[float, ...] = () if isinstance(record, AccelerationMeasurement) else (_offset(record),)
    if isinstance(record, RangeMeasurement):
        middle += (record.other,)
    elif isinstance(record, AnchorRangeMeasurement):
        middle += _anchor(record)
    kind = _KIND_OF[type(record)]
    rounded_widths = [_half_up(half_width) for half_width in half_widths]
    return _LAYOUT[kind].pack(kind, record.observer, age, *middle, *values, *sigmas, *rounded_widths)


def _check_ids(record: Measurement) -> None:
    good = MIN_AGENT_ID <= record.observer <= MAX_AGENT_ID
    if isinstance(record, RangeMeasurement):
        good = good and MIN_AGENT_ID <= record.other <= MAX_AGENT_ID and record.other != record.observer
    if not good:
        raise EncodeError(f"{record}: expected distinct agent ids from {MIN_AGENT_ID} to {MAX_AGENT_ID}")


def _offset(
    record: PositionMeasurement | VelocityMeasurement | SpeedMeasurement | RangeMeasurement | AnchorRangeMeasurement,
) -> float:
    if not -MAX_OFFSET_S <= record.offset_s <= MAX_OFFSET_S:
        raise EncodeError(f"{record}: offset must be within +-{MAX_OFFSET_S:g} s")
    return record.offset_s


def _anchor(record: AnchorRangeMeasurement) -> Triple:
    if not all(-MAX_POSITION_M <= component <= MAX_POSITION_M for component in record.anchor_m):
        raise EncodeError(f"{record}: the anchor must be finite and at most {MAX_POSITION_M:g} m away")
    return record.anchor_m


_Floats = tuple[float, ...]


def _numbers(record: Measurement) -> tuple[_Floats, float, _Floats, _Floats]:
    """Values, the largest magnitude they may have, variances, half widths."""
    match record:
        case PositionMeasurement():
            return record.position_m, MAX_POSITION_M, record.variance_m2, record.half_width_m
        case VelocityMeasurement():
            return record.velocity_mps, MAX_SPEED_MPS, record.variance_m2ps2, record.half_width_mps
        case SpeedMeasurement():
            return (record.speed_mps,), MAX_SPEED_MPS, (record.variance_m2ps2,), (record.half_width_mps,)
        case RangeMeasurement() | AnchorRangeMeasurement():
            return (record.range_m,), MAX_RANGE_M, (record.variance_m2,), (record.half_width_m,)
        case AccelerationMeasurement():
            return record.accel_mps2, MAX_ACCEL_MPS2, record.variance_m2ps4, ()


def _record_from(fields: tuple[float, ...], packet_tick: int, roster: Collection[int]) -> Measurement:
    kind, observer, tick = fields[0], int(fields[1]), packet_tick - int(fields[2])
    _known(observer, roster)
    if tick < 0:
        raise Rejected(Reason.OUT_OF_RANGE, f"record of tick {tick}")
    if kind == MeasurementKind.ACCELERATION:
        accel = _bounded(fields[3:6], MAX_ACCEL_MPS2, "acceleration")
        return AccelerationMeasurement(observer, tick, _triple(accel), _triple(_variances(fields[6:9])))
    offset = _bounded(fields[3:4], MAX_OFFSET_S, "offset")[0]
    if kind == MeasurementKind.POSITION:
        position = _triple(_bounded(fields[4:7], MAX_POSITION_M, "position"))
        variance = _triple(_variances(fields[7:10]))
        return PositionMeasurement(observer, tick, position, variance, _triple(_widths(fields[10:13])), offset)
    if kind == MeasurementKind.VELOCITY:
        velocity = _triple(_bounded(fields[4:7], MAX_SPEED_MPS, "velocity"))
        variance = _triple(_variances(fields[7:10]))
        return VelocityMeasurement(observer, tick, velocity, variance, _triple(_widths(fields[10:13])), offset)
    sigma, half_width = _variances(fields[-2:-1])[0], _widths(fields[-1:])[0]
    if kind == MeasurementKind.SPEED:
        speed = _bounded(fields[4:5], MAX_SPEED_MPS, "speed")[0]
        return SpeedMeasurement(observer, tick, speed, sigma, half_width, offset)
    if kind == MeasurementKind.RANGE:
        other = _known(int(fields[4]), roster)
        if other == observer:
            raise Rejected(Reason.OUT_OF_RANGE, f"range of agent {observer} to itself")
        range_m = _bounded(fields[5:6], MAX_RANGE_M, "range")[0]
        return RangeMeasurement(observer, tick, other, range_m, sigma, half_width, offset)
    anchor = _triple(_bounded(fields[4:7], MAX_POSITION_M, "anchor"))
    range_m = _bounded(fields[7:8], MAX_RANGE_M, "range")[0]
    return AnchorRangeMeasurement(observer, tick, anchor, range_m, sigma, half_width, offset)


def _known(agent_id: int, roster: Collection[int]) -> int:
    if agent_id not in roster:
        raise Rejected(Reason.UNKNOWN_AGENT, f"record of agent {agent_id}")
    return agent_id


def _bounded(values: _Floats, limit: float, what: str) -> _Floats:
    for value in values:
        if not -limit <= value <= limit:
            if not math.isfinite(value):
                raise Rejected(Reason.NOT_FINITE, what)
            raise Rejected(Reason.OUT_OF_RANGE, f"{what} {value:g}, at most {limit:g}")
    return values


def _variances(sigmas: _Floats) -> _Floats:
    for sigma in sigmas:
        if not 0 < sigma < math.inf:
            if not math.isfinite(sigma):
                raise Rejected(Reason.NOT_FINITE, "sigma")
            raise Rejected(Reason.OUT_OF_RANGE, f"sigma {sigma:g}, expected positive")
    return tuple([sigma * sigma for sigma in sigmas])


def _widths(half_widths: _Floats) -> _Floats:
    for half_width in half_widths:
        if not half_width > 0:
            if math.isnan(half_width):
                raise Rejected(Reason.NOT_FINITE, "half width")
            raise Rejected(Reason.OUT_OF_RANGE, f"half width {half_width:g}, expected positive")
    return half_widths


def _triple(values: _Floats) -> Triple:
    return values[0], values[1], values[2]
