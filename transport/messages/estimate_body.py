"""Estimate bodies: where one agent thinks everybody is, and how well it knows.

Wire form: ``status u8 | reserved u8[3] | ids u16[n] | ages u16[n] | mean[6n] | variance f32[6n] | own
covariance f32[21]``, the mean in float32 or float64, the covariance as its upper triangle by rows. Variances
are rounded up to float32: they never claim more than was known.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import MAX_AGENT_ID, MIN_AGENT_ID

_PREFIX = struct.Struct("<B3x")
_OWN_TRIANGLE = np.triu_indices(6)
MAX_AGE_TICKS = 0xFFFF
"""Also stands for "never heard"."""
MAX_MEAN = 1e9
MAX_VARIANCE = 1e18
MAX_STATUS = 4
_INDEFINITE = 1e-6
"""A covariance with an eigenvalue below minus this share of its trace is none; less than that is rounding."""

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FleetEstimate:
    """The fleet as its sender sees it at ``tick``.

    Attributes
    ----------
    tick : int
    status : int
        0 ok, 1 not converged, 2 fell back to the pre-estimate, 3 not observable, 4 no data.
    agents : tuple of int
        Agent ids in the order of their blocks of six.
    mean : Vector ``(6n,)``
        Position and velocity of each agent, NED m and m/s.
    variance : Vector ``(6n,)``
        Diagonal of the covariance, m2 and (m/s)2.
    age_ticks : tuple of int
        Ticks since anything of that agent last entered the estimate; 65535 and more: never.
    own_covariance : Matrix ``(6, 6)``
        Block of the sender itself; zero if the sender is not among ``agents``.
    """

    tick: int
    status: int
    agents: tuple[int, ...]
    mean: Vector
    variance: Vector
    age_ticks: tuple[int, ...]
    own_covariance: Matrix


def estimate_bytes(agents: int, *, double: bool) -> int:
    """Length of the body for a number of agents."""
    return _PREFIX.size + agents * (4 + 6 * (8 if double else 4) + 24) + 4 * 21


def encode_estimate(estimate: FleetEstimate, *, double: bool = False) -> bytes:
    """Body of an estimate packet; raises `EncodeError` for NaN, negative variances and wrong shapes."""
    e, n = estimate, len(estimate.agents)
    if len(set(e.agents)) != n or not all(MIN_AGENT_ID <= a <= MAX_AGENT_ID for a in e.agents) or not n:
        raise EncodeError(f"estimate: agents {e.agents}, expected distinct ids up to {MAX_AGENT_ID}")
    shapes = (e.mean.shape, e.variance.shape, len(e.age_ticks), e.own_covariance.shape)
    if shapes != ((6 * n,), (6 * n,), n, (6, 6)):
        raise EncodeError(f"estimate: shapes {shapes} do not fit {n} agents")
    if not 0 <= e.status <= MAX_STATUS or min(e.age_ticks) < 0:
        raise EncodeError(f"estimate: status {e.status}, ages {e.age_ticks}")
    if not (np.abs(e.mean) <= MAX_MEAN).all() or not (np.abs(e.own_covariance) <= MAX_VARIANCE).all():
        raise EncodeError("estimate: mean and covariance must be finite and bounded")
    if _is_indefinite(e.own_covariance, _INDEFINITE):
        raise EncodeError("estimate: the own covariance is not positive semidefinite")
    if not ((e.variance >= 0) & (e.variance <= MAX_VARIANCE)).all():
        raise EncodeError("estimate: variances must be finite and not negative")
    ages = [min(age, MAX_AGE_TICKS) for age in e.age_ticks]
    return b"".join((
        _PREFIX.pack(e.status),
        np.asarray(e.agents, "<u2").tobytes(),
        np.asarray(ages, "<u2").tobytes(),
        e.mean.astype("<f8" if double else "<f4").tobytes(),
        _float32_up(e.variance).tobytes(),
        e.own_covariance[_OWN_TRIANGLE].astype("<f4").tobytes(),
    ))  # fmt: skip


def decode_estimate(
    body: bytes, *, tick: int, agents: int, double: bool, roster: Collection[int]
) -> FleetEstimate:
    """The estimate in a body; raises `Rejected` unless its length, ids and numbers are sound."""
    if not 1 <= agents <= len(roster) or len(body) != estimate_bytes(agents, double=double):
        raise Rejected(Reason.WRONG_DIMENSION, f"{len(body)} bytes for an estimate of {agents} agents")
    number = np.dtype("<f8" if double else "<f4")
    status, at = body[0], _PREFIX.size
    ids = tuple(int(i) for i in np.frombuffer(body, "<u2", agents, at))
    ages = tuple(int(i) for i in np.frombuffer(body, "<u2", agents, at + 2 * agents))
    at += 4 * agents
    with np.errstate(invalid="ignore"):  # a signalling NaN may not warn before it is refused
        mean = np.frombuffer(body, number, 6 * agents, at).astype(np.float64)
        rest = np.frombuffer(body, "<f4", offset=at + 6 * agents * number.itemsize).astype(np.float64)
    variance, own = rest[: 6 * agents], rest[6 * agents :]
    if not (np.isfinite(mean).all() and np.isfinite(rest).all()):
        raise Rejected(Reason.NOT_FINITE, "estimate")
    if len(set(ids)) != agents or not all(agent_id in roster for agent_id in ids):
        raise Rejected(Reason.UNKNOWN_AGENT, f"estimate of agents {ids}")
    if status > MAX_STATUS or any(body[1 : _PREFIX.size]) or (np.abs(mean) > MAX_MEAN).any():
        raise Rejected(Reason.OUT_OF_RANGE, f"estimate with status {status} or mean beyond {MAX_MEAN:g}")
    if (variance < 0).any() or max(variance.max(), np.abs(own).max()) > 1.001 * MAX_VARIANCE:
        raise Rejected(Reason.OUT_OF_RANGE, "estimate with negative or absurd variances")
    covariance = np.zeros((6, 6))
    covariance[_OWN_TRIANGLE] = own
    covariance += np.triu(covariance, 1).T
    if _is_indefinite(covariance, 2 * _INDEFINITE):  # what was sent at the limit may be rounded beyond it
        raise Rejected(Reason.NOT_POSITIVE_DEFINITE, "own covariance of an estimate")
    return FleetEstimate(tick, status, ids, mean, variance, ages, covariance)


def _is_indefinite(covariance: Matrix, tolerance: float) -> bool:
    return bool(np.linalg.eigvalsh(covariance)[0] < -tolerance * abs(np.trace(covariance)))


def _float32_up(values: Vector) -> NDArray[np.float32]:
    rounded = values.astype("<f4")
    upward = np.nextafter(rounded, np.float32(np.inf))
    return cast("NDArray[np.float32]", np.where(rounded < values, upward, rounded).astype("<f4"))
