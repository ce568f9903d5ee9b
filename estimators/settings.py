"""The ``[estimator]`` table of a configuration: which estimator runs, and how."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec

Kind = Literal["dmhe_pre_ekf", "dmhe", "dmhe_shared", "dekf_ci", "consensus_mhe", "centralized_ekf"]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]

DEFAULT_KIND: Kind = "dmhe_shared"
"""What runs where nothing is said; docs/algorithms.md says why."""
FORMER_KINDS: Mapping[str, Kind] = {"dmhe_relay": "dmhe_shared"}
"""Former names of kinds, by which configurations and stored flights may still call them."""
DEFAULTS_OF_KIND: Mapping[str, Mapping[str, Any]] = {
    "dmhe_shared": {
        "window": 6,  # ticks that a late or repeated record may take
        "rounds": 2,  # a record moves as many hops in a tick
        "share_inputs": "fleet",
        "relay_hops": 2,
        "unknown_inputs": "hold",  # the last acceleration heard, with a variance that grows
        "held_accel_fade_s": 2.0,  # no vehicle accelerates for long
        "systematic_errors": True,
        "robust": True,
    },
    "consensus_mhe": {
        "weights": "metropolis",
        "rounds": 4,  # the diameter of the paper's graphs: fewer leave the far ends apart
        "reciprocal_ranges": "independent",  # each end uses its own
    },
}
"""Defaults that go with a kind; of every other kind those of `EstimatorSettings`, which are the paper's."""


class VehicleLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What no vehicle of the fleet goes beyond, in any state of the window: hard limits, for ``dmhe_shared``.

    Altitudes are above the fleet's origin, not above the ground below. A limit keeps the estimate from places where
    no vehicle can be; it does not keep a vehicle within. Leave room for what it may do.
    """

    floor_m: float | None = None
    """Lowest altitude; absent = none."""

    ceiling_m: float | None = None
    """Highest altitude, above the floor; absent = none."""

    north_m: tuple[float, float] | None = None
    """Lowest and highest north; absent = none."""

    east_m: tuple[float, float] | None = None
    """Lowest and highest east; absent = none."""

    speed_mps: Positive | None = None
    """Highest speed, over all axes; absent = none."""


class TargetLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Between which altitudes targets are, above the fleet's origin.

    For ranges from a flat fleet a target has a mirror image above it; a ceiling below the fleet leaves one place.
    """

    floor_m: float | None = None
    """Lowest altitude; absent = none."""

    ceiling_m: float | None = None
    """Highest altitude, above the floor; absent = none."""


class LimitsTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the states, a table for each kind of body."""

    vehicle: VehicleLimits = VehicleLimits()
    """Of vehicles."""

    target: TargetLimits = TargetLimits()
    """Of targets (also ``consensus_mhe``)."""


class LocalWindowTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What ``consensus_mhe`` assumes of the states that its local problem takes from the neighbours."""

    neighbour_sigma_m: Annotated[float, msgspec.Meta(ge=0)] = 3.0
    """Standard deviation of a neighbour's position on a range's line, added to the range's own."""

    range_gate_m: Positive | None = None
    """Ranges to neighbours that are further off are left out; absent = none is."""

    reinject_own: bool = True
    """Whether the own states after the last round are those of the own local problem, and not the average."""


class EstimatorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of one estimator; every agent of a fleet runs the same.

    The defaults are those of the paper's estimator, but where a configuration's ``kind`` brings its own
    (`DEFAULTS_OF_KIND`).
    """

    kind: Kind = "dmhe_pre_ekf"
    """Algorithm."""

    window: Annotated[int, msgspec.Meta(ge=1, le=64)] = 2
    """Horizon N in ticks (moving horizon estimators; DEKF-CI takes its observability rank over it)."""

    rounds: Annotated[int, msgspec.Meta(ge=0, le=16)] = 1
    """Consensus rounds L per tick."""

    weights: Literal["observability_rank", "metropolis", "uniform"] = "observability_rank"
    """Consensus weights over the closed neighbourhood: Borelle et al. 2023, (24)-(26), or a classic."""

    share_inputs: Literal["none", "neighbours", "fleet"] = "none"
    """Whose tick-averaged acceleration an agent uses besides its own."""

    relay_hops: Annotated[int, msgspec.Meta(ge=0, le=8)] = 0
    """How many hops measurement records travel beyond their owner's neighbours (0 = none)."""

    other_accel_variance: Positive = 4.0 / 3.0
    """Variance, (m/s2)2 per axis, of an acceleration that is not known; 4/3 is uniform in +-2 m/s2."""

    unknown_inputs: Literal["zero", "hold"] = "zero"
    """What stands for an acceleration that is not known: zero, or the last one heard from that agent."""

    held_accel_fade_s: Positive | None = None
    """Time constant with which a held acceleration fades to zero; absent = it stays (``unknown_inputs = "hold"``)."""

    norm_smoothing_m: Positive = 1e-3
    """eps of the smoothed norms sqrt(|.|^2 + eps^2), in m for ranges and m/s for speeds."""

    noise_bounds: Literal["off", "soft"] = "off"
    """Whether the sensors' hard noise bounds enter the optimisation; an exact penalty is on their excess."""

    noise_bounds_on: Literal["corrected", "predicted"] = "corrected"
    """Residual that the bounds hold for: after the gain's correction, or the innovation (8) of the paper."""

    noise_bounds_penalty: Positive = 100.0
    """Cost per half width of excess; the cost (9) has no factor one half."""

    state_box_position_m: Positive | None = None
    """Hard bound on every position component of every state in the window; absent = none."""

    state_box_speed_mps: Positive | None = None
    """Hard bound on every velocity component of every state in the window; absent = none."""

    limits: LimitsTable = LimitsTable()
    """Where bodies can be, and how fast (``dmhe_shared``)."""

    reciprocal_ranges: Literal["independent", "shared"] = "independent"
    """Ranges a->b and b->a of one tick: two measurements, or one exchange seen from both ends, fused once."""

    local_window: LocalWindowTable = LocalWindowTable()
    """Of ``consensus_mhe``."""

    iterations_ekf: Count = 1
    """Updates per tick of the centralised EKF; 1 is the plain one, more the iterated one."""

    systematic_errors: bool = False
    """Whether the wander of fixes, the bias of ranges and the error of accelerations are estimated (``dmhe_shared``),
    of sensors without hard bounds."""

    robust: bool = False
    """Whether outliers are weighted down, by a Student-t density beyond three sigma (``dmhe_shared``)."""

    qp: Literal["osqp", "daqp"] = "osqp"
    """Engine of the constrained step."""

    max_iterations: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 100
    """Gauss-Newton iterations per tick at most."""

    tolerance: Positive = 1e-6
    """Convergence: largest change of a state component, m or m/s, still expected from another iteration."""


def present_name(kind: str) -> str:
    """What a kind of estimator is called today."""
    return FORMER_KINDS.get(kind, kind)


def with_kind_defaults(table: Mapping[str, Any]) -> dict[str, Any]:
    """An ``[estimator]`` table as it was written, completed by its kind and that kind's own defaults."""
    kind = table.get("kind", DEFAULT_KIND)
    if not isinstance(kind, str):
        return dict(table)
    kind = present_name(kind)
    return {**DEFAULTS_OF_KIND.get(kind, {}), **table, "kind": kind}


def default_settings() -> EstimatorSettings:
    """The settings of a configuration that says nothing about the estimator."""
    return msgspec.convert(with_kind_defaults({}), EstimatorSettings)


def fade_per_tick(settings: EstimatorSettings, period_s: float) -> float:
    """Factor that a held acceleration fades by in a tick of ``period_s``; 1 where it stays."""
    return 1.0 if settings.held_accel_fade_s is None else math.exp(-period_s / settings.held_accel_fade_s)
