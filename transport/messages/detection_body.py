"""``target-detection/1``: what a camera's process tells the agent of its own drone: where it sees bodies.

JSON on ``.../agent/{id}/uwb``, beside the frames of ``uwb-range/1`` and as they are without packet header and
signature; the schema's name tells them apart. A detection has a direction, and a distance where the camera knows one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import msgspec

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.uwb_body import MAX_BYTES, MAX_ID, MAX_OFFSET_S, MAX_RANGE_M, Clock

SCHEMA = "target-detection/1"
MAX_DETECTIONS = 64
MAX_SIGMA_RAD = 1.0
LEAST_LENGTH = 1e-3
"""Of a vector that has a direction."""

Triple = tuple[float, float, float]
Frame = Literal["body", "ned"]


@dataclass(frozen=True, slots=True)
class Detection:
    """Where a body is seen from the drone.

    ``direction`` is a vector to it of any length, in the axes of the frame. ``sigma_rad``: 1-sigma of its direction,
    about each of the axes across it. ``distance_m`` with ``distance_sigma_m``, or neither: only a bearing.
    ``offset_s`` of this detection from the frame's time.
    """

    target: int
    direction: Triple
    sigma_rad: float
    distance_m: float | None = None
    distance_sigma_m: float | None = None
    offset_s: float = 0.0


@dataclass(frozen=True, slots=True)
class DetectionFrame:
    """Detections of one observer; ``clock`` and ``t_ns`` as in `transport.messages.uwb_body.UwbFrame`.

    ``axes``: those of all its directions, the drone's body FRD or NED. ``skipped`` counts unusable detections.
    """

    seq: int
    clock: Clock
    t_ns: int
    detections: tuple[Detection, ...]
    observer: int
    axes: Frame = "body"
    skipped: int = 0


class _JsonDetection(msgspec.Struct):
    id: int
    dir: tuple[float, float, float]
    sa: float
    r: float | None = None
    sr: float | None = None
    dt: float = 0.0


class _JsonDetectionFrame(msgspec.Struct):
    schema: str
    obs: int
    seq: int
    clk: Clock
    t: int
    m: list[_JsonDetection]
    axes: Frame = "body"


class _Named(msgspec.Struct):
    schema: str = ""


_JSON, _NAMED = msgspec.json.Decoder(_JsonDetectionFrame), msgspec.json.Decoder(_Named)


def is_detection_frame(payload: bytes) -> bool:
    """Whether a payload says that it is one, of whatever version."""
    if b'"schema"' not in payload[:MAX_BYTES]:
        return False
    try:
        return _NAMED.decode(payload).schema.startswith(SCHEMA.partition("/")[0] + "/")
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False


def decode_detections(payload: bytes) -> DetectionFrame:
    """The frame in a payload; raises `Rejected`.

    A detection that is unusable by itself is left out and counted in ``skipped``; the others stand.
    """
    if len(payload) > MAX_BYTES:
        raise Rejected(Reason.TOO_LONG, f"detection frame of {len(payload)} bytes, at most {MAX_BYTES}")
    try:
        frame = _JSON.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Rejected(Reason.MALFORMED, f"detection JSON: {error}") from None
    if frame.schema != SCHEMA:
        raise Rejected(Reason.BAD_VERSION, f"{frame.schema[:40]!r}, expected {SCHEMA}")
    if len(frame.m) > MAX_DETECTIONS:
        raise Rejected(Reason.TOO_LONG, f"{len(frame.m)} detections, at most {MAX_DETECTIONS}")
    if not (1 <= frame.obs <= MAX_ID and 0 <= frame.seq < 1 << 63 and 0 <= frame.t < 1 << 63):
        raise Rejected(Reason.OUT_OF_RANGE, f"detection observer {frame.obs}, seq {frame.seq}, t {frame.t}")
    every = [Detection(each.id, each.dir, each.sa, each.r, each.sr, each.dt) for each in frame.m]
    usable = tuple(each for each in every if _usable(each) and each.target != frame.obs)
    return DetectionFrame(frame.seq, frame.clk, frame.t, usable, frame.obs, frame.axes, len(every) - len(usable))


def encode_detections(frame: DetectionFrame) -> bytes:
    """The JSON; raises `EncodeError` for a detection that is not usable."""
    if len(frame.detections) > MAX_DETECTIONS:
        raise EncodeError(f"detection frame: {len(frame.detections)} detections, at most {MAX_DETECTIONS}")
    for each in frame.detections:
        if not _usable(each) or each.target == frame.observer:
            raise EncodeError(f"detection frame: {each} is not usable")
    told = [
        _JsonDetection(d.target, d.direction, d.sigma_rad, d.distance_m, d.distance_sigma_m, d.offset_s)
        for d in frame.detections
    ]
    return msgspec.json.encode(
        _JsonDetectionFrame(SCHEMA, frame.observer, frame.seq, frame.clock, frame.t_ns, told, frame.axes)
    )


def _usable(each: Detection) -> bool:
    distance, sigma = each.distance_m, each.distance_sigma_m
    bearing = distance is None and sigma is None
    placed = distance is not None and sigma is not None and 0 < distance <= MAX_RANGE_M and 0 < sigma <= MAX_RANGE_M
    length = math.hypot(*each.direction)
    return (
        1 <= each.target <= MAX_ID and (bearing or placed) and LEAST_LENGTH <= length < math.inf
        and 0 < each.sigma_rad <= MAX_SIGMA_RAD and abs(each.offset_s) <= MAX_OFFSET_S
    )  # fmt: skip
