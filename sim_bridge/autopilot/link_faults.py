"""What a bad serial line or radio does to an autopilot's frames: lost, doubled, out of order. Seeded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class LinkQuality:
    """Probabilities per frame, each way."""

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    """A frame waits until the next one has passed."""

    def __post_init__(self) -> None:
        for name in ("loss", "duplicate", "reorder"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"link quality: {name}: expected a probability 0..1, found {value}")


class FaultyLink:
    """One direction of one link."""

    def __init__(self, quality: LinkQuality, rng: np.random.Generator) -> None:
        self._quality, self._rng = quality, rng
        self._perfect = quality == LinkQuality()
        self._waiting: list[bytes] = []
        self.lost = 0

    def passed(self, frames: list[bytes]) -> list[bytes]:
        """What comes out of the link when these frames go in."""
        if self._perfect or not frames:
            return frames
        quality, out = self._quality, list[bytes]()
        for frame in frames:
            loss, duplicate, reorder = self._rng.random(3)
            if loss < quality.loss:
                self.lost += 1
                continue
            copies = [frame, frame] if duplicate < quality.duplicate else [frame]
            if reorder < quality.reorder and not self._waiting:
                self._waiting = copies
                continue
            out += copies + self._waiting
            self._waiting = []
        return out
