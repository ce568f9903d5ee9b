"""Measurement bodies: compact records of what sensors said in the last ticks, what matters most first.

A packet carries the records of several ticks, own and relayed, so that one packet repairs the loss of
earlier ones; every record names the agent whose sensor it is. Wire form of a record, little endian::

    kind u8 | observer u16 | age u8 | [offset_s f32] | [other u16] | [anchor f32 x3] | values f32 |
    sigmas f16 | [half widths f16]

``age`` is the packet's tick minus the record's. Sigmas and half widths are rounded up, never down, so the
receiver never trusts a sensor more than its owner does; a half width beyond float16 becomes "no bound".

In a signed fleet the proofs of the records' origin stand behind them (`transport.messages.proofs`).

The same records come and go many times, sent again and relayed. So each is worked out once: a record remembers its
identity and its bytes, and bytes that were decoded of late are known again by all of them.
"""

from __future__ import annotations

import hashlib
import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property, lru_cache
from typing import ClassVar, NamedTuple

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import MAX_AGENT_ID, MIN_AGENT_ID
from transport.messages.half_floats import half_up
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES
from transport.messages.proofs import (
    ACKS_AHEAD,
    DIGEST_BYTES,
    Proof,
    ProofBytes,
    Prover,
    acks_bytes,
    decode_proofs,
    encode_acks,
    encode_proofs,
)
from transport.messages.uwb_body import MAX_TAGS

Triple = tuple[float, float, float]
NO_BOUND: Triple = (math.inf, math.inf, math.inf)

MAX_AGE_TICKS = 255
MAX_OFFSET_S = 10.0
MAX_POSITION_M = 1e6
MAX_SPEED_MPS = 1e4
MAX_RANGE_M = 1e5
UNSEEN_VARIANCE = 1e6
"""Stands for a distance that was not measured (the wire has no gap)."""
MAX_ACCEL_MPS2 = 1e4
MAX_TURN = 64.0
"""Of a rotation vector's components in rad and of turn rates in rad/s."""
ROUNDED = 1e-5
"""What a direction of length one may be off by, as float32."""
RECORDS_KNOWN_AGAIN = 4096
"""How many decoded records are known again by their bytes: more than a fleet of ten sends anew in its history."""
BODIES_KNOWN_AGAIN = 128
"""The same of whole bodies: in virtual time those who hear a packet are in one process, and decode it once."""


class MeasurementKind(IntEnum):
    """First byte of a record on the wire."""

    POSITION = 1
    VELOCITY = 2
    SPEED = 3
    RANGE = 4
    ANCHOR_RANGE = 5
    ACCELERATION = 6
    ORIENTATION = 7
    TAG_RANGE = 8
    ANTENNA_SPEED = 9
    HEIGHT = 10
    GROUND_HEIGHT = 11
    SIGHTING = 12
    ODOMETRY = 13


_Floats = tuple[float, ...]


class _Parts(NamedTuple):
    """The numbers of a record in their order on the wire, without observer and age."""

    middle: _Floats
    """Offset, other, anchor: what of these a kind has."""
    values: _Floats
    variances: _Floats
    half_widths: _Floats


@dataclass(frozen=True)
class _Record(ABC):
    """What all kinds have: an ``observer``, the ``tick`` they belong to, and what follows from the fields."""

    kind: ClassVar[MeasurementKind]
    limit: ClassVar[float]
    """The largest magnitude that a value may have."""

    observer: int
    tick: int

    @cached_property
    def identity(self) -> bytes:
        """What makes another record the same measurement, however often and by whomever it was sent.

        Kind, observer and tick; offset, other agent and anchor as on the wire.
        """
        middle = self.parts().middle
        return _IDENTITY.pack(self.kind, self.observer, self.tick) + _SINGLES[len(middle)].pack(*middle)

    @cached_property
    def wire(self) -> bytes | None:
        """The record's bytes with age 0, ``None`` if it is too uncertain to be worth any; raises `EncodeError`."""
        return _encode_record(self)

    @cached_property
    def digest(self) -> bytes:
        """Eight bytes that stand for all of the record, its tick with it; raises `EncodeError`."""
        told = _TICK.pack(self.tick) + (self.wire or b"")
        return hashlib.blake2b(told, digest_size=DIGEST_BYTES).digest()

    @abstractmethod
    def parts(self) -> _Parts:
        """The record's numbers."""


@dataclass(frozen=True)
class PositionMeasurement(_Record):
    """A position fix of ``observer``: NED m, variances m2 and hard bounds m per axis (inf = none).

    ``offset_s`` is the instant of the measurement minus the time of ``tick``, here and below.
    """

    kind = MeasurementKind.POSITION
    limit = MAX_POSITION_M

    position_m: Triple
    variance_m2: Triple
    half_width_m: Triple = NO_BOUND
    offset_s: float = 0.0

    def parts(self) -> _Parts:
        return _Parts((self.offset_s,), self.position_m, self.variance_m2, self.half_width_m)


@dataclass(frozen=True)
class VelocityMeasurement(_Record):
    """A velocity of ``observer``: NED m/s, variances (m/s)2 and hard bounds m/s per axis (inf = none)."""

    kind = MeasurementKind.VELOCITY
    limit = MAX_SPEED_MPS

    velocity_mps: Triple
    variance_m2ps2: Triple
    half_width_mps: Triple = NO_BOUND
    offset_s: float = 0.0

    def parts(self) -> _Parts:
        return _Parts((self.offset_s,), self.velocity_mps, self.variance_m2ps2, self.half_width_mps)


@dataclass(frozen=True)
class SpeedMeasurement(_Record):
    """The norm of ``observer``'s velocity as measured, m/s (noise can make it negative)."""

    kind = MeasurementKind.SPEED
    limit = MAX_SPEED_MPS

    speed_mps: float
    variance_m2ps2: float
    half_width_mps: float = math.inf
    offset_s: float = 0.0

    def parts(self) -> _Parts:
        return _Parts((self.offset_s,), (self.speed_mps,), (self.variance_m2ps2,), (self.half_width_mps,))


@dataclass(frozen=True)
class RangeMeasurement(_Record):
    """The range from ``observer`` to agent ``other`` as measured, m."""

    kind = MeasurementKind.RANGE
    limit = MAX_RANGE_M

    other: int
    range_m: float
    variance_m2: float
    half_width_m: float = math.inf
    offset_s: float = 0.0

    def parts(self) -> _Parts:
        return _Parts((self.offset_s, self.other), (self.range_m,), (self.variance_m2,), (self.half_width_m,))


@dataclass(frozen=True)
class TagRangeMeasurement(RangeMeasurement):
    """The same between antennas that are not the first ones of their drones: their indices, 0..15."""

    kind = MeasurementKind.TAG_RANGE

    tag: int = 0
    other_tag: int = 0

    def parts(self) -> _Parts:
        tags = self.tag * MAX_TAGS + self.other_tag
        return _Parts(
            (self.offset_s, self.other, tags), (self.range_m,), (self.variance_m2,), (self.half_width_m,)
        )


@dataclass(frozen=True)
class SightingMeasurement(RangeMeasurement):
    """Where ``observer`` sees ``other``: ``range_m`` away along ``direction``, NED, of length one.

    ``variance_m2`` of the distance, `UNSEEN_VARIANCE` and more where it was not seen but follows from the estimate;
    ``variance_across_m2`` about each axis across the direction.
    """

    kind = MeasurementKind.SIGHTING

    direction: Triple = (1.0, 0.0, 0.0)
    variance_across_m2: float = 1.0

    @property
    def is_bearing(self) -> bool:
        """Whether only the direction was seen."""
        return self.variance_m2 >= UNSEEN_VARIANCE

    def parts(self) -> _Parts:
        variances = self.variance_m2, self.variance_across_m2
        return _Parts((self.offset_s, self.other), (self.range_m, *self.direction), variances, ())


@dataclass(frozen=True)
class AntennaSpeedMeasurement(SpeedMeasurement):
    """The norm of the velocity of ``observer``'s GPS antenna, which moves against it with ``shift_mps`` NED."""

    kind = MeasurementKind.ANTENNA_SPEED

    shift_mps: Triple = (0.0, 0.0, 0.0)

    def parts(self) -> _Parts:
        values = (self.speed_mps, *self.shift_mps)
        return _Parts((self.offset_s,), values, (self.variance_m2ps2,), (self.half_width_mps,))


@dataclass(frozen=True)
class AnchorRangeMeasurement(_Record):
    """The range from ``observer`` to a fixed anchor at ``anchor_m`` (NED m) as measured, m."""

    kind = MeasurementKind.ANCHOR_RANGE
    limit = MAX_RANGE_M

    anchor_m: Triple
    range_m: float
    variance_m2: float
    half_width_m: float = math.inf
    offset_s: float = 0.0

    def parts(self) -> _Parts:
        return _Parts((self.offset_s, *self.anchor_m), (self.range_m,), (self.variance_m2,), (self.half_width_m,))


@dataclass(frozen=True)
class HeightMeasurement(_Record):
    """The height of ``observer`` by its barometer: NED m, with drift and scale that its variance leaves out."""

    kind = MeasurementKind.HEIGHT
    limit = MAX_POSITION_M

    down_m: float
    variance_m2: float
    offset_s: float = 0.0

    def parts(self) -> _Parts:
        return _Parts((self.offset_s,), (self.down_m,), (self.variance_m2,), ())


@dataclass(frozen=True)
class GroundHeightMeasurement(HeightMeasurement):
    """The height of ``observer`` by what it measures to known ground: NED m, with no error but noise."""

    kind = MeasurementKind.GROUND_HEIGHT


@dataclass(frozen=True)
class OdometryMeasurement(_Record):
    """A velocity of ``observer`` by another sensor than its receiver: NED m/s, variances (m/s)2 per axis."""

    kind = MeasurementKind.ODOMETRY
    limit = MAX_SPEED_MPS

    velocity_mps: Triple
    variance_m2ps2: Triple
    offset_s: float = 0.0

    def parts(self) -> _Parts:
        return _Parts((self.offset_s,), self.velocity_mps, self.variance_m2ps2, ())


@dataclass(frozen=True)
class AccelerationMeasurement(_Record):
    """The acceleration of ``observer`` averaged over ``tick`` to ``tick + 1``: NED m/s2, gravity removed."""

    kind = MeasurementKind.ACCELERATION
    limit = MAX_ACCEL_MPS2

    accel_mps2: Triple
    variance_m2ps4: Triple

    def parts(self) -> _Parts:
        return _Parts((), self.accel_mps2, self.variance_m2ps4, ())


@dataclass(frozen=True)
class OrientationMeasurement(_Record):
    """How ``observer`` lies at the start of ``tick``: what turns its antennas' lever arms; no part of the state.

    ``rotation_rad`` is the rotation vector that turns body FRD into NED, ``rate_radps`` the turn rate, NED.
    """

    kind = MeasurementKind.ORIENTATION
    limit = MAX_TURN

    rotation_rad: Triple
    rate_radps: Triple

    def parts(self) -> _Parts:
        return _Parts((), (*self.rotation_rad, *self.rate_radps), (), ())


Measurement = (
    PositionMeasurement
    | VelocityMeasurement
    | SpeedMeasurement
    | RangeMeasurement
    | AnchorRangeMeasurement
    | HeightMeasurement
    | OdometryMeasurement
    | AccelerationMeasurement
    | OrientationMeasurement
)

_LAYOUT: dict[int, struct.Struct] = {
    MeasurementKind.POSITION: struct.Struct("<BHBf3f3e3e"),
    MeasurementKind.VELOCITY: struct.Struct("<BHBf3f3e3e"),
    MeasurementKind.SPEED: struct.Struct("<BHBffee"),
    MeasurementKind.RANGE: struct.Struct("<BHBfHfee"),
    MeasurementKind.ANCHOR_RANGE: struct.Struct("<BHBf3ffee"),
    MeasurementKind.ACCELERATION: struct.Struct("<BHB3f3e"),
    MeasurementKind.ORIENTATION: struct.Struct("<BHB3e3e"),
    MeasurementKind.TAG_RANGE: struct.Struct("<BHBfHBfee"),
    MeasurementKind.ANTENNA_SPEED: struct.Struct("<BHBff3eee"),
    MeasurementKind.HEIGHT: struct.Struct("<BHBffe"),
    MeasurementKind.GROUND_HEIGHT: struct.Struct("<BHBffe"),
    MeasurementKind.SIGHTING: struct.Struct("<BHBfHf3fee"),
    MeasurementKind.ODOMETRY: struct.Struct("<BHBf3f3e"),
}
_HEIGHTS: dict[int, type[HeightMeasurement]] = {
    MeasurementKind.HEIGHT: HeightMeasurement,
    MeasurementKind.GROUND_HEIGHT: GroundHeightMeasurement,
}
_AGE_AT = 3
"""Where the age stands in a record."""
_IDENTITY = struct.Struct("<BHq")
_TICK = struct.Struct("<q")
_SINGLES = [struct.Struct(f"<{count}f") for count in range(5)]
"""What follows the identity's head: an agent's id is exact as a float32."""
RECORD_BYTES = {kind: layout.size for kind, layout in _LAYOUT.items()}


@dataclass(frozen=True, slots=True)
class Measurements:
    """Body of a measurement packet: the records an agent tells at ``tick``, what matters most first.

    ``exchange`` counts the packets of a tick from 0; it travels as the header's round. ``proofs`` are of the origin
    of relayed records; ``None`` where nobody asks for them: in unsigned fleets, in packets of version 1.
    ``acks`` say of whose records we have that their owners need not tell them again (`transport.messages.proofs`).
    """

    tick: int
    records: tuple[Measurement, ...]
    exchange: int = 0
    proofs: tuple[Proof, ...] | None = field(default=None, compare=False)
    acks: tuple[bytes, ...] = field(default=(), compare=False)


@dataclass(frozen=True, slots=True)
class EncodedMeasurements:
    """A measurement body as bytes; ``left_out`` records did not fit, were too old or say nothing."""

    body: bytes
    count: int
    left_out: int


def as_sent(record: Measurement) -> Measurement:
    """The record with its numbers rounded as a receiver will see them; raises `EncodeError`.

    An agent that uses this for its own estimate works on the same numbers as everybody else. A record too
    uncertain to be sent (a sigma beyond float16) comes back as it is.
    """
    wire = record.wire
    return record if wire is None else _decode_record(wire, record.tick)


def encode_measurements(
    measurements: Measurements, *, limit_bytes: int = MAX_DATAGRAM_BODY_BYTES, prover: Prover | None = None
) -> EncodedMeasurements:
    """Records as bytes, in the order given, cut at ``limit_bytes``; with a ``prover`` their proofs behind them.

    Raises `EncodeError` for a record that is not a measurement: NaN, no variance, an id that is none, a tick
    later than the packet's.
    """
    tick, proofs = measurements.tick, measurements.proofs or ()
    sent: list[Measurement] = []
    for record in measurements.records:
        if record.tick > tick:
            raise EncodeError(f"{record}: expected a tick from 0 to the packet's tick {tick}")
        if record.wire is not None and tick - record.tick <= MAX_AGE_TICKS:
            sent.append(record)
    owner = None if prover is None else prover.owner
    reserved = acks_bytes(min(len(measurements.acks), ACKS_AHEAD)) if prover is not None else 0
    sent = sent[: fitting(sent, proofs, owner, limit_bytes=limit_bytes - reserved)]
    body = bytearray()
    for record in sent:
        at = len(body)
        body += record.wire or b""
        body[at + _AGE_AT] = tick - record.tick
    if prover is not None:
        body += encode_proofs(sent, proofs, prover)
        body += encode_acks(measurements.acks, limit_bytes - len(body))
    return EncodedMeasurements(bytes(body), len(sent), len(measurements.records) - len(sent))


def fitting(
    records: Sequence[Measurement],
    proofs: Sequence[Proof],
    owner: int | None,
    *,
    limit_bytes: int = MAX_DATAGRAM_BODY_BYTES,
) -> int:
    """How many of the first of ``records`` fit into a body with their proofs; ``owner`` None: without proofs.

    What follows matters less: better nothing than that in place of the first that does not fit.
    """
    proof_bytes = None if owner is None else ProofBytes(proofs, owner)
    size, fitted = 0, 0
    for count, record in enumerate(records, 1):
        size += len(record.wire or b"")
        if proof_bytes is not None:
            size += proof_bytes.added_by(record)  # may be less than nothing, so that the next may fit again
        if size <= limit_bytes:
            fitted = count
        elif proof_bytes is None:
            break
    return fitted


def decode_measurements(
    body: bytes, *, tick: int, count: int, roster: AbstractSet[int], exchange: int = 0, proven: bool = False
) -> Measurements:
    """Records of a body; the header says ``tick``, ``count``, ``exchange``. Raises `Rejected` unless all are good.

    ``proven``: whether proofs follow; their signatures are not looked at here.
    """
    records, named, end = _decode_body(body, tick, count)
    if not named <= roster:
        raise Rejected(Reason.UNKNOWN_AGENT, f"record of agent {min(named - roster)}")
    if not proven and end != len(body):
        raise Rejected(Reason.MALFORMED, f"{len(body) - end} bytes after the last record")
    if not proven:
        return Measurements(tick, records, exchange)
    return Measurements(tick, records, exchange, *decode_proofs(body[end:], records))


@lru_cache(BODIES_KNOWN_AGAIN)
def _decode_body(body: bytes, tick: int, count: int) -> tuple[tuple[Measurement, ...], frozenset[int], int]:
    """The records of a body, all agents that they name, and where the last one ends."""
    records: list[Measurement] = []
    at, size = 0, len(body)
    for _ in range(count):
        layout = _LAYOUT.get(body[at]) if at < size else None
        if layout is None or at + layout.size > size:
            raise Rejected(Reason.MALFORMED, f"record {len(records)} at byte {at} of {size}")
        age_at, end = at + _AGE_AT, at + layout.size
        wire = body[at:age_at] + b"\0" + body[age_at + 1 : end]
        records.append(_decode_record(wire, tick - body[age_at]))
        at = end
    named = {record.observer for record in records}
    named.update(record.other for record in records if isinstance(record, RangeMeasurement))
    return tuple(records), frozenset(named), at


def forget_decoded() -> None:
    """Know no record again by its bytes: for a study that times an agent as if it were alone in its process."""
    _decode_body.cache_clear()
    _decode_record.cache_clear()


# --- one record --------------------------------------------------------------------------------------------


def _encode_record(record: _Record) -> bytes | None:
    """Bytes of a record with age 0, ``None`` if it is too uncertain to be worth any."""
    if record.tick < 0:
        raise EncodeError(f"{record}: expected a tick from 0 on")
    _check_ids(record)
    middle, values, variances, half_widths = record.parts()
    _check_place(record, middle)
    for value in values:
        if not -record.limit <= value <= record.limit:
            raise EncodeError(f"{record}: values must be finite and at most {record.limit:g}")
    for variance in variances:
        if not 0 < variance < math.inf:
            raise EncodeError(f"{record}: variances must be finite and positive")
    for half_width in half_widths:
        if not half_width > 0:
            raise EncodeError(f"{record}: half widths must be positive (inf = no bound)")
    sigmas = [half_up(math.sqrt(variance)) for variance in variances]
    if math.inf in sigmas:
        return None
    rounded_widths = [half_up(half_width) for half_width in half_widths]
    layout = _LAYOUT[record.kind]
    return layout.pack(record.kind, record.observer, 0, *middle, *values, *sigmas, *rounded_widths)


def _check_ids(record: _Record) -> None:
    good = MIN_AGENT_ID <= record.observer <= MAX_AGENT_ID
    if isinstance(record, RangeMeasurement):
        good = good and MIN_AGENT_ID <= record.other <= MAX_AGENT_ID and record.other != record.observer
    tags = (record.tag, record.other_tag) if isinstance(record, TagRangeMeasurement) else ()
    if not all(0 <= tag < MAX_TAGS for tag in tags):
        raise EncodeError(f"{record}: expected tags from 0 to {MAX_TAGS - 1}")
    if not good:
        raise EncodeError(f"{record}: expected distinct agent ids from {MIN_AGENT_ID} to {MAX_AGENT_ID}")


def _check_place(record: _Record, middle: _Floats) -> None:
    """The offset, and where an anchor stands."""
    for offset in middle[:1]:
        if not -MAX_OFFSET_S <= offset <= MAX_OFFSET_S:
            raise EncodeError(f"{record}: offset must be within +-{MAX_OFFSET_S:g} s")
    if isinstance(record, SightingMeasurement):
        off = abs(math.hypot(*record.direction) - 1.0)
        if not (record.range_m > 0.0 and off <= ROUNDED):
            raise EncodeError(f"{record}: expected a positive distance and a direction of length one")
    if isinstance(record, AnchorRangeMeasurement):
        for component in record.anchor_m:
            if not -MAX_POSITION_M <= component <= MAX_POSITION_M:
                raise EncodeError(f"{record}: the anchor must be finite and at most {MAX_POSITION_M:g} m away")


@lru_cache(RECORDS_KNOWN_AGAIN)
def _decode_record(wire: bytes, tick: int) -> Measurement:
    """A record of its bytes with age 0 and its tick: of all that it says, so that no other is taken for it."""
    record = _record_from(wire, tick)
    vars(record)["wire"] = wire  # to encode it anew would give the same
    return record


def _record_from(wire: bytes, tick: int) -> Measurement:
    if tick < 0:
        raise Rejected(Reason.OUT_OF_RANGE, f"record of tick {tick}")
    fields = _LAYOUT[wire[0]].unpack(wire)
    kind, observer = fields[0], int(fields[1])
    if kind == MeasurementKind.ACCELERATION:
        accel = _bounded(fields[3:6], MAX_ACCEL_MPS2, "acceleration")
        return AccelerationMeasurement(observer, tick, _triple(accel), _triple(_variances(fields[6:9])))
    if kind == MeasurementKind.ORIENTATION:
        turns = _bounded(fields[3:9], MAX_TURN, "orientation")
        return OrientationMeasurement(observer, tick, _triple(turns), _triple(turns[3:]))
    offset = _bounded(fields[3:4], MAX_OFFSET_S, "offset")[0]
    if kind == MeasurementKind.POSITION:
        position = _triple(_bounded(fields[4:7], MAX_POSITION_M, "position"))
        variance = _triple(_variances(fields[7:10]))
        return PositionMeasurement(observer, tick, position, variance, _triple(_widths(fields[10:13])), offset)
    if kind == MeasurementKind.VELOCITY:
        velocity = _triple(_bounded(fields[4:7], MAX_SPEED_MPS, "velocity"))
        variance = _triple(_variances(fields[7:10]))
        return VelocityMeasurement(observer, tick, velocity, variance, _triple(_widths(fields[10:13])), offset)
    if kind == MeasurementKind.ODOMETRY:
        velocity = _triple(_bounded(fields[4:7], MAX_SPEED_MPS, "velocity"))
        return OdometryMeasurement(observer, tick, velocity, _triple(_variances(fields[7:])), offset)
    if kind in _HEIGHTS:
        down_m = _bounded(fields[4:5], MAX_POSITION_M, "height")[0]
        return _HEIGHTS[kind](observer, tick, down_m, _variances(fields[5:])[0], offset)
    if kind == MeasurementKind.SIGHTING:
        return _sighting(observer, tick, offset, fields)
    sigma, half_width = _variances(fields[-2:-1])[0], _widths(fields[-1:])[0]
    if kind == MeasurementKind.SPEED:
        speed = _bounded(fields[4:5], MAX_SPEED_MPS, "speed")[0]
        return SpeedMeasurement(observer, tick, speed, sigma, half_width, offset)
    if kind == MeasurementKind.ANTENNA_SPEED:
        values = _bounded(fields[4:8], MAX_SPEED_MPS, "speed")
        return AntennaSpeedMeasurement(observer, tick, values[0], sigma, half_width, offset, _triple(values[1:]))
    if kind in (MeasurementKind.RANGE, MeasurementKind.TAG_RANGE):
        other = int(fields[4])
        if other == observer:
            raise Rejected(Reason.OUT_OF_RANGE, f"range of agent {observer} to itself")
        range_m = _bounded(fields[-3:-2], MAX_RANGE_M, "range")[0]
        if kind == MeasurementKind.RANGE:
            return RangeMeasurement(observer, tick, other, range_m, sigma, half_width, offset)
        tags = divmod(int(fields[5]), MAX_TAGS)
        return TagRangeMeasurement(observer, tick, other, range_m, sigma, half_width, offset, *tags)
    anchor = _triple(_bounded(fields[4:7], MAX_POSITION_M, "anchor"))
    range_m = _bounded(fields[7:8], MAX_RANGE_M, "range")[0]
    return AnchorRangeMeasurement(observer, tick, anchor, range_m, sigma, half_width, offset)


def _sighting(observer: int, tick: int, offset: float, fields: _Floats) -> SightingMeasurement:
    other = int(fields[4])
    if other == observer:
        raise Rejected(Reason.OUT_OF_RANGE, f"sighting of agent {observer} by itself")
    range_m = _bounded(fields[5:6], MAX_RANGE_M, "distance")[0]
    direction = _triple(_bounded(fields[6:9], 1.0 + ROUNDED, "direction"))
    if range_m <= 0.0 or abs(math.hypot(*direction) - 1.0) > ROUNDED:
        raise Rejected(Reason.OUT_OF_RANGE, f"sighting at {range_m:g} m along {direction}")
    along, across = _variances(fields[9:11])
    return SightingMeasurement(observer, tick, other, range_m, along, math.inf, offset, direction, across)


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
