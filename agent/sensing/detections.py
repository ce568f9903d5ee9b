"""Detections of targets (``target-detection/1``) to sightings in NED; sans-I/O."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

from agent.sensing.frames import rotated
from agent.sensing.samples import Triple
from agent.sensing.timeline import Orientation
from transport.messages.detection_body import DetectionFrame, Frame, decode_detections
from transport.messages.uwb_body import FrameIntake

MAX_LEAD_S = 0.05
MAX_AGE_S = 1.0
"""An older frame comes too late for the usual window, 6 ticks of 0.1 s."""
LEAST_SIGMA_RAD = 1e-3
"""Of a direction, whatever its camera claims: an attitude is not known better."""


@dataclass(frozen=True, slots=True)
class DetectionSample:
    """Where a target was seen: ``direction`` of length one in ``axes``, 1-sigma in rad about each axis across it.

    ``distance_m`` with its 1-sigma, or neither.
    """

    t_s: float
    target: int
    axes: Frame
    direction: Triple
    sigma_rad: float
    distance_m: float | None
    distance_sigma_m: float | None


class DetectionAdapter:
    """What the camera of one drone says of ``targets``."""

    def __init__(self, observer: int, targets: Collection[int]) -> None:
        self._targets = frozenset(targets)
        self.intake = FrameIntake(observer, decode_detections, "detection", max_age_s=MAX_AGE_S)
        self.skipped: Counter[str] = Counter()
        """Detections left out, by reason; `intake` counts refused frames."""

    def receive(self, payload: bytes, *, now_s: float, host_s: float, unix_s: float) -> list[DetectionSample]:
        """The samples in a frame; the times as for `agent.uwb.adapter.UwbAdapter.receive`."""
        accepted = self.intake.accept(payload, unix_s=unix_s, monotonic_s=host_s)
        return [] if accepted is None else self._samples_of(*accepted, now_s)

    def _samples_of(self, frame: DetectionFrame, age_s: float, now_s: float) -> list[DetectionSample]:
        samples = []
        for each in frame.detections:
            t_s = now_s - max(age_s, 0.0) + each.offset_s
            if each.target not in self._targets:
                self.skipped["not a target"] += 1
            elif t_s > now_s + MAX_LEAD_S:
                self.skipped["wrong time"] += 1
            else:
                sigma_rad = max(each.sigma_rad, LEAST_SIGMA_RAD)
                seen = each.distance_m, each.distance_sigma_m
                samples.append(
                    DetectionSample(t_s, each.target, frame.axes, _unit(each.direction), sigma_rad, *seen)
                )
        return samples


def ned_direction(sample: DetectionSample, orientation: Orientation | None) -> Triple | None:
    """The direction in NED; ``None`` where it is in body axes and nobody knows how these lay."""
    if sample.axes == "ned":
        return sample.direction
    return None if orientation is None else _unit(rotated(orientation.quaternion, sample.direction))


def _unit(vector: Triple) -> Triple:
    length = math.hypot(*vector)
    return vector[0] / length, vector[1] / length, vector[2] / length
