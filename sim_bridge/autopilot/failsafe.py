"""What an autopilot that flies by a lost position does: it lands, and PX4 goes on when the position is back."""

from __future__ import annotations

from sim_bridge.autopilot.flavours import FlightMode
from sim_bridge.autopilot.fusing import LossFigures


class EstimatorFailsafe:
    """Of one autopilot; ``ordered`` counts how often it landed."""

    def __init__(self, figures: LossFigures) -> None:
        self._figures = figures
        self.ordered = 0
        self._left: FlightMode | None = None
        """The mode that the failsafe ended."""
        self._aided_since_s: float | None = None

    def step(self, mode: FlightMode, unaided_s: float, now: float) -> FlightMode | None:
        """The mode to enter now, of a vehicle in the air; ``unaided_s`` since a position was used."""
        if self._left is None:
            if unaided_s < self._figures.failsafe_s or mode is FlightMode.LAND:
                return None
            self._left, self._aided_since_s = mode, None
            self.ordered += 1
            return FlightMode.LAND
        if mode is not FlightMode.LAND:  # somebody took over
            self._left = None
            return None
        if unaided_s > self._figures.flag_s:
            self._aided_since_s = None
            return None
        self._aided_since_s = now if self._aided_since_s is None else self._aided_since_s
        after_s = self._figures.returns_after_s
        if after_s is None or now - self._aided_since_s < after_s:
            return None
        back, self._left = self._left, None
        return back
