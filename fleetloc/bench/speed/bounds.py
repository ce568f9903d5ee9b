"""The bounds that a timed window gets: none, loose ones, or ones of which a few are active at the optimum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from estimators.model.measurements import Vector
from estimators.settings import EstimatorSettings

CaseName = Literal["free", "loose", "active"]
CASES: tuple[CaseName, ...] = ("free", "loose", "active")

HALF_WIDTHS = (0.4, 0.5)
"""Range of the noise bounds' half widths, m and m/s: bounds 0.8 to 1.0 wide."""

BOX_POSITION_M = 40.0
BOX_SPEED_MPS = 8.0
"""The box of the windows with loose bounds."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Hard box on every state of the window, soft bounds on every row's corrected residual."""

    position_m: float = BOX_POSITION_M
    speed_mps: float = BOX_SPEED_MPS
    penalty: float = EstimatorSettings().noise_bounds_penalty
    """Cost per half width of excess; the cost has no factor one half."""

    def box(self, dimension: int) -> Vector:
        """The box's half edges ``(6n,)``."""
        return np.tile(np.repeat([self.position_m, self.speed_mps], 3), dimension // 6)

    def settings(self, base: EstimatorSettings) -> EstimatorSettings:
        """Settings with these bounds."""
        return msgspec.structs.replace(
            base,
            noise_bounds="soft",
            noise_bounds_on="corrected",
            noise_bounds_penalty=self.penalty,
            state_box_position_m=self.position_m,
            state_box_speed_mps=self.speed_mps,
        )
