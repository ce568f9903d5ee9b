"""``uwb-range/1``: what a UWB driver process tells the agent of its own drone.

Plain bytes on ``.../agent/{id}/uwb``, JSON or binary, without packet header and signature: driver and agent
share a drone. Ids are integers as everywhere (1..65535 on the wire, so that anchors have room too).
"""

from __future__ import annotations

import math
import struct
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeVar

import msgspec

from transport.errors import EncodeError, Reason, Rejected, RejectionCounter

MAX_RANGES = 64
MAX_RANGE_M = 2000.0
MAX_AGE_S = 1.0
MAX_BYTES = 16 * 1024
MAX_ID = 0xFFFF
MAX_OFFSET_S = 1.0

_MAGIC = b"UWB1"
_HEADER = struct.Struct("<4sBBHIQ")
_RECORD = struct.Struct("<HfHbbBB")
MAX_TAGS = 16
"""Antennas of a module on one drone."""
_FLAG_UNIX = 0b1
_NOT_GIVEN_DBM = 127
"""A power of +127 dBm does not occur; it stands for "not given"."""

Clock = Literal["mono", "unix", "none"]


@dataclass(frozen=True, slots=True)
class UwbRange:
    """One range: antenna to antenna in m, antenna delays already removed.

    ``sigma_m`` 1-sigma (``None``: the driver does not know), ``nlos`` probability 0..1 of no line of sight,
    ``offset_s`` of this measurement from the frame's time, powers in dBm, ``quality`` 0..1. ``tag`` and ``other_tag``
    0..15 say which of the observer's and of the other's antennas.
    """

    other: int
    range_m: float
    sigma_m: float | None = None
    nlos: float | None = None
    rx_dbm: float | None = None
    first_path_dbm: float | None = None
    quality: float | None = None
    offset_s: float = 0.0
    tag: int = 0
    other_tag: int = 0


@dataclass(frozen=True, slots=True)
class UwbFrame:
    """Ranges of one observer.

    ``t_ns`` on ``clock``: ``mono`` = CLOCK_MONOTONIC of this very host, ``unix`` = UTC, ``none`` = use the
    arrival. ``observer`` is ``None`` in the binary form, where the key alone says it. ``skipped`` counts
    measurements of the frame that were unusable (failed, out of range).
    """

    seq: int
    clock: Clock
    t_ns: int
    ranges: tuple[UwbRange, ...]
    observer: int | None = None
    skipped: int = 0


class _JsonRange(msgspec.Struct):
    id: int
    r: float | None = None
    s: float | None = None
    q: float | None = None
    rx: float | None = None
    fp: float | None = None
    nlos: float | None = None
    dt: float = 0.0
    st: str = "ok"
    tag: int = 0
    otag: int = 0


class _JsonFrame(msgspec.Struct):
    v: int
    obs: int
    seq: int
    clk: Clock
    t: int
    m: list[_JsonRange]


_JSON = msgspec.json.Decoder(_JsonFrame)


def decode_uwb(payload: bytes) -> UwbFrame:
    """The frame in a payload, JSON or binary; raises `Rejected`.

    A measurement that is unusable by itself is left out and counted in ``skipped``; the others stand.
    """
    if len(payload) > MAX_BYTES:
        raise Rejected(Reason.TOO_LONG, f"uwb frame of {len(payload)} bytes, at most {MAX_BYTES}")
    return _decode_binary(payload) if payload[:4] == _MAGIC else _decode_json(payload)


def encode_uwb_json(frame: UwbFrame) -> bytes:
    """The JSON form; raises `EncodeError` without observer or for an unusable range."""
    if frame.observer is None:
        raise EncodeError("uwb frame: the JSON form needs an observer")
    _check_sendable(frame)
    ranges = [
        _JsonRange(
            id=r.other,
            r=r.range_m,
            s=r.sigma_m,
            q=r.quality,
            rx=r.rx_dbm,
            fp=r.first_path_dbm,
            nlos=r.nlos,
            dt=r.offset_s,
            tag=r.tag,
            otag=r.other_tag,
        )
        for r in frame.ranges
    ]
    return msgspec.json.encode(_JsonFrame(1, frame.observer, frame.seq, frame.clock, frame.t_ns, ranges))


def encode_uwb_binary(frame: UwbFrame) -> bytes:
    """The binary form: mm sigma, whole dBm, no per-measurement offset; raises `EncodeError`."""
    _check_sendable(frame)
    if frame.clock == "none" or any(r.offset_s for r in frame.ranges):
        raise EncodeError("uwb frame: the binary form has a time (mono or unix) and no offsets; use JSON")
    flags = _FLAG_UNIX if frame.clock == "unix" else 0
    try:
        header = _HEADER.pack(_MAGIC, flags, len(frame.ranges), 0, frame.seq, frame.t_ns)
        return header + b"".join(_pack_range(r) for r in frame.ranges)
    except struct.error as error:
        raise EncodeError(f"uwb frame: {error}") from None


class LocalFrame(Protocol):
    """What the frames of all local sensors have."""

    @property
    def seq(self) -> int:
        """Counts the driver's frames."""
        ...

    @property
    def clock(self) -> Clock:
        """Of ``t_ns``."""
        ...

    @property
    def t_ns(self) -> int:
        """When it was measured."""
        ...

    @property
    def observer(self) -> int | None:
        """Whose sensor it is, if it says so."""
        ...

    @property
    def skipped(self) -> int:
        """Unusable measurements in it."""
        ...


FrameT = TypeVar("FrameT", bound=LocalFrame)


class FrameIntake(Generic[FrameT]):
    """Decodes one observer's frames and refuses old and repeated ones; sans-I/O.

    Refused frames are counted in ``rejections``, unusable measurements within good frames in ``skipped``. ``decode``
    raises `Rejected`; ``what`` names the frames in words.
    """

    def __init__(
        self,
        observer: int,
        decode: Callable[[bytes], FrameT],
        what: str,
        *,
        max_age_s: float = MAX_AGE_S,
        remembered: int = 256,
    ) -> None:
        self._observer, self._decode, self._what = observer, decode, what
        self._max_age_s = max_age_s
        self._remembered = remembered
        self._seen: OrderedDict[tuple[int, int], None] = OrderedDict()
        self.rejections = RejectionCounter()
        self.received = 0
        self.skipped = 0

    def accept(self, payload: bytes, *, unix_s: float, monotonic_s: float) -> tuple[FrameT, float] | None:
        """The frame and its age in s on its own clock (0 if it has none); ``None`` if it was refused."""
        try:
            frame = self._decode(payload)
            age_s = self._checked_age(frame, unix_s, monotonic_s)
        except Rejected as rejected:
            self.rejections.count(rejected.reason)
            return None
        self.received += 1
        self.skipped += frame.skipped
        return frame, age_s

    def _checked_age(self, frame: FrameT, unix_s: float, monotonic_s: float) -> float:
        if frame.observer not in (None, self._observer):
            raise Rejected(Reason.WRONG_KEY, f"observer {frame.observer} on the key of {self._observer}")
        age_s = 0.0
        if frame.clock != "none":
            age_s = (unix_s if frame.clock == "unix" else monotonic_s) - frame.t_ns * 1e-9
        if abs(age_s) > self._max_age_s:
            raise Rejected(Reason.STALE, f"{self._what} frame {age_s:.3f} s old, at most {self._max_age_s:g} s")
        # a restarted driver counts from 0 again: only the same number with the same time is the same frame
        identity = (frame.seq, frame.t_ns)
        if identity in self._seen:
            raise Rejected(Reason.DUPLICATE, f"{self._what} frame {frame.seq}")
        self._seen[identity] = None
        if len(self._seen) > self._remembered:
            self._seen.popitem(last=False)
        return age_s


class UwbIntake(FrameIntake[UwbFrame]):
    """That of ranges."""

    def __init__(self, observer: int, *, max_age_s: float = MAX_AGE_S, remembered: int = 256) -> None:
        super().__init__(observer, decode_uwb, "uwb", max_age_s=max_age_s, remembered=remembered)


def _decode_json(payload: bytes) -> UwbFrame:
    try:
        frame = _JSON.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Rejected(Reason.MALFORMED, f"uwb JSON: {error}") from None
    if frame.v != 1:
        raise Rejected(Reason.BAD_VERSION, f"uwb-range/{frame.v}, expected 1")
    if len(frame.m) > MAX_RANGES:
        raise Rejected(Reason.TOO_LONG, f"{len(frame.m)} uwb ranges, at most {MAX_RANGES}")
    if not (1 <= frame.obs <= MAX_ID and 0 <= frame.seq < 1 << 63 and 0 <= frame.t < 1 << 63):
        raise Rejected(Reason.OUT_OF_RANGE, f"uwb observer {frame.obs}, seq {frame.seq}, t {frame.t}")
    ranges = [
        UwbRange(m.id, m.r, m.s, m.nlos, m.rx, m.fp, m.q, m.dt, m.tag, m.otag)
        for m in frame.m
        if m.st == "ok" and m.r is not None
    ]
    return _frame(frame.seq, frame.clk, frame.t, ranges, frame.obs, len(frame.m))


def _decode_binary(payload: bytes) -> UwbFrame:
    if len(payload) < _HEADER.size:
        raise Rejected(Reason.TOO_SHORT, f"uwb frame of {len(payload)} bytes")
    _, flags, count, reserved, seq, t_ns = _HEADER.unpack_from(payload)
    if flags & ~_FLAG_UNIX or reserved:
        raise Rejected(Reason.BAD_FLAGS, f"uwb flags {flags:#x}")
    if count > MAX_RANGES:
        raise Rejected(Reason.TOO_LONG, f"{count} uwb ranges, at most {MAX_RANGES}")
    if len(payload) != _HEADER.size + count * _RECORD.size:
        raise Rejected(Reason.BAD_LENGTH, f"uwb frame of {len(payload)} bytes with {count} ranges")
    if t_ns >= 1 << 63:
        raise Rejected(Reason.OUT_OF_RANGE, f"uwb time {t_ns} ns")
    ranges = []
    for other, range_m, sigma_mm, rx, fp, nlos, tags in _RECORD.iter_unpack(payload[_HEADER.size :]):
        sigma_m = sigma_mm * 1e-3 if sigma_mm else None
        tag, other_tag = divmod(tags, MAX_TAGS)
        powers = _power(rx), _power(fp)
        ranges.append(UwbRange(other, range_m, sigma_m, nlos / 255, *powers, tag=tag, other_tag=other_tag))
    return _frame(seq, "unix" if flags & _FLAG_UNIX else "mono", t_ns, ranges, None, count)


def _power(dbm: int) -> float | None:
    return None if dbm == _NOT_GIVEN_DBM else float(dbm)


def _frame(
    seq: int, clock: Clock, t_ns: int, ranges: list[UwbRange], observer: int | None, count: int
) -> UwbFrame:
    usable = tuple(r for r in ranges if _usable(r) and r.other != observer)
    return UwbFrame(seq, clock, t_ns, usable, observer, count - len(usable))


def _usable(r: UwbRange) -> bool:
    powers = all(dbm is None or -200 <= dbm <= 100 for dbm in (r.rx_dbm, r.first_path_dbm))
    shares = all(share is None or 0 <= share <= 1 for share in (r.nlos, r.quality))
    sigma = r.sigma_m is None or 0 < r.sigma_m <= MAX_RANGE_M
    return (
        1 <= r.other <= MAX_ID and 0 < r.range_m <= MAX_RANGE_M and sigma
        and powers and shares and abs(r.offset_s) <= MAX_OFFSET_S
        and 0 <= r.tag < MAX_TAGS and 0 <= r.other_tag < MAX_TAGS
    )  # fmt: skip


def _check_sendable(frame: UwbFrame) -> None:
    if len(frame.ranges) > MAX_RANGES:
        raise EncodeError(f"uwb frame: {len(frame.ranges)} ranges, at most {MAX_RANGES}")
    for r in frame.ranges:
        if not _usable(r) or r.other == frame.observer:
            raise EncodeError(f"uwb frame: {r} is not usable")


def _pack_range(r: UwbRange) -> bytes:
    sigma_mm = 0 if r.sigma_m is None else min(max(math.ceil(r.sigma_m * 1e3 - 1e-9), 1), 0xFFFF)
    powers = (_NOT_GIVEN_DBM if dbm is None else round(dbm) for dbm in (r.rx_dbm, r.first_path_dbm))
    tags = r.tag * MAX_TAGS + r.other_tag
    return _RECORD.pack(r.other, r.range_m, sigma_mm, *powers, round(255 * (r.nlos or 0.0)), tags)
