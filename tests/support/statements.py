"""What integrity says of a tick, for tests of who listens to it."""

from __future__ import annotations

from estimators.integrity.protection.levels import ErrorEllipse, ProtectionLevel
from estimators.integrity.protection.statement import IntegrityState, Statement


def statement(state: IntegrityState, level: ProtectionLevel, sigma_m: float) -> Statement:
    """Nothing is off, and nobody else is spoken of."""
    return Statement(
        state=state,
        reason="",
        ellipse=ErrorEllipse(sigma_m, sigma_m, 0.0, sigma_m),
        own=level,
        relative={},
        guaranteed={},
        off={},
        ranges_off=(),
        undetectable=(),
        unattributable=False,
    )
