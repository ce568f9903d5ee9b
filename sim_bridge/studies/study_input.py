"""Recordings: the tick-level inputs of a whole fleet run in one ``.npz`` (docs/replay.md).

Arrays only, no pickles. n agents, T ticks after the first, NED metres and seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from sim_bridge.studies.study_rows import RowKind, StudyRows

Floats = NDArray[np.float64]


class StudyInputError(ValueError):
    """A study input that cannot be used: names file, key, what was expected and what was found."""

    def __init__(self, source: str, key: str, expected: str, found: str) -> None:
        super().__init__(f"{source}: {key}: expected {expected}, found {found}")


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyInput:
    """What a fleet measured, tick by tick.

    Attributes
    ----------
    period_s : float
        Length of a tick.
    agents : ``(n,)`` int
        Ids, in the order of the blocks of the state.
    edges : ``(m, 2)`` int
        Pairs of agents (0-based places in ``agents``) that hear and range each other.
    accel : ``(T, n, 3)``
        Measured acceleration, gravity removed, over (k, k+1), m/s2.
    gps : ``(T+1, n, 4)``
        Measured position and speed norm; NaN where there was no fix.
    ranges : ``(T+1, n, n)``
        Ranges measured by the row agent to the column agent; NaN where there was none.
    gps_half_width : ``(4,)``, range_half_width, accel_half_width
        Bounds of the uniform noises; variances are half_width^2 / 3.
    x0 : ``(n, 6n)``
        Every agent's first estimate of the fleet.
    P0 : ``(6n, 6n)``
        Its covariance.
    received : ``(T+1, n, n)`` bool
        Whether the packets that the column agent sent in tick k reached the row agent.
    delay_ticks : ``(T+1, n, n)`` int
        How many ticks late they did.
    truth : ``(T+1, n, 6)``, optional
    rows : optional
        Further measurements, in a file of version 2.
    """

    period_s: float
    agents: NDArray[np.int64]
    edges: NDArray[np.int64]
    accel: Floats
    gps: Floats
    ranges: Floats
    gps_half_width: Floats
    range_half_width: float
    accel_half_width: float
    x0: Floats
    P0: Floats
    received: NDArray[np.bool_]
    delay_ticks: NDArray[np.int64]
    truth: Floats | None = None
    rows: StudyRows | None = None

    @property
    def ticks(self) -> int:
        """T: ticks after the first."""
        return len(self.accel)

    def save(self, path: Path) -> None:
        """Write the file; optional arrays that are absent are left out."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "rows"}
        if self.rows is not None:
            arrays["version"] = 2
            arrays |= {_array_of(field.name): getattr(self.rows, field.name) for field in fields(self.rows)}
        np.savez_compressed(path, **{key: value for key, value in arrays.items() if value is not None})


def _array_of(field: str) -> str:
    """What a field of `StudyRows` is called in a file."""
    return field if field == "anchors_m" else f"row_{field}"


REQUIRED = (
    "period_s", "agents", "edges", "accel", "gps", "ranges", "gps_half_width", "range_half_width",
    "accel_half_width", "x0", "P0",
)  # fmt: skip
OPTIONAL = ("received", "delay_ticks", "truth")


def load_study_input(path: Path) -> StudyInput:
    """Read and check a file; raises `StudyInputError`."""
    try:
        with path.open("rb") as file, NpzFile(file, allow_pickle=False) as archive:
            arrays = {key: np.asarray(archive[key]) for key in archive.files}
    except FileNotFoundError:
        raise StudyInputError(str(path), "file", "a study input (.npz)", "no such file") from None
    except (ValueError, OSError, BadZipFile, EOFError, KeyError) as error:
        raise StudyInputError(str(path), "file", "a study input (.npz without pickles)", str(error)) from None
    return study_input_from_arrays(arrays, str(path))


def study_input_from_arrays(arrays: Mapping[str, Any], source: str) -> StudyInput:
    """Check arrays against the format and make a study input of them; raises `StudyInputError` naming ``source``."""
    check = _Checker(arrays, source)
    period_s = check.number("period_s", positive=True)
    agents = check.agents()
    n = len(agents)
    edges = check.edges(n)
    ticks = check.tick_count(n)
    accel = check.array("accel", (ticks, n, 3))
    gps = check.array("gps", (ticks + 1, n, 4), nan=True)
    ranges = check.array("ranges", (ticks + 1, n, n), nan=True)
    received = check.optional("received", (ticks + 1, n, n), np.ones((ticks + 1, n, n), bool))
    delay = check.optional("delay_ticks", (ticks + 1, n, n), np.zeros((ticks + 1, n, n), np.int64))
    if (delay < 0).any():
        raise StudyInputError(source, "delay_ticks", "no negative delay", f"{int(delay.min())}")
    return StudyInput(
        period_s=period_s,
        agents=agents,
        edges=edges,
        accel=accel,
        gps=gps,
        ranges=ranges,
        gps_half_width=check.positive("gps_half_width", (4,)),
        range_half_width=check.number("range_half_width", positive=True),
        accel_half_width=check.number("accel_half_width", positive=True),
        x0=check.array("x0", (n, 6 * n)),
        P0=check.covariance("P0", 6 * n),
        received=received.astype(bool),
        delay_ticks=delay.astype(np.int64),
        truth=check.array("truth", (ticks + 1, n, 6)) if "truth" in arrays else None,
        rows=check.rows(ticks, n),
    )


@dataclass(frozen=True, slots=True)
class _Checker:
    """Takes arrays out of an archive, each held to its shape and its values."""

    arrays: Mapping[str, Any]
    source: str

    def fail(self, key: str, expected: str, found: str) -> StudyInputError:
        return StudyInputError(self.source, key, expected, found)

    def raw(self, key: str) -> NDArray[Any]:
        if key not in self.arrays:
            known = ", ".join(sorted(self.arrays)) or "nothing"
            raise self.fail(key, "this key (all of " + ", ".join(REQUIRED) + ")", f"only {known}")
        return np.asarray(self.arrays[key])

    def numeric(self, key: str) -> NDArray[Any]:
        value = self.raw(key)
        if value.dtype.kind not in "fiub":
            raise self.fail(key, "numbers", f"type {value.dtype}")
        return value

    def array(self, key: str, shape: tuple[int, ...], *, nan: bool = False) -> Floats:
        value = self.numeric(key)
        if value.shape != shape:
            raise self.fail(key, f"shape {shape}", f"shape {value.shape}")
        value = value.astype(np.float64)
        bad = np.isinf(value) if nan else ~np.isfinite(value)
        if bad.any():
            where = tuple(int(i) for i in np.argwhere(bad)[0])
            allowed = "finite values or NaN (no measurement)" if nan else "finite values"
            raise self.fail(key, allowed, f"{value[where]} at index {where}")
        return value

    def positive(self, key: str, shape: tuple[int, ...]) -> Floats:
        value = self.array(key, shape)
        if not (value > 0).all():
            raise self.fail(key, "positive values", f"{value.min()}")
        return value

    def number(self, key: str, *, positive: bool) -> float:
        value = float(self.array(key, ()))
        if positive and not value > 0:
            raise self.fail(key, "a positive number", f"{value}")
        return value

    def optional(self, key: str, shape: tuple[int, ...], default: NDArray[Any]) -> NDArray[Any]:
        if key not in self.arrays:
            return default
        value = self.array(key, shape)
        whole = value.astype(default.dtype)
        if (whole != value).any():
            where = tuple(int(i) for i in np.argwhere(whole != value)[0])
            raise self.fail(key, "integers", f"{value[where]} at index {where}")
        return whole

    def covariance(self, key: str, order: int) -> Floats:
        value = self.array(key, (order, order))
        if np.abs(value - value.T).max() > 1e-9 * np.abs(value).max():
            raise self.fail(key, "a symmetric matrix", "an asymmetric one")
        if np.linalg.eigvalsh(value).min() <= 0:
            raise self.fail(key, "a positive definite matrix", f"eigenvalue {np.linalg.eigvalsh(value).min():.3g}")
        return value

    def rows(self, ticks: int, n: int) -> StudyRows | None:
        version = int(self.number("version", positive=True)) if "version" in self.arrays else 1
        if version not in (1, 2):
            raise self.fail("version", "1 or 2", f"{version}")
        if version == 1:
            return None
        count = len(np.atleast_1d(self.numeric("row_tick")))
        anchors_m = self.numeric("anchors_m")
        if anchors_m.ndim != 2 or anchors_m.shape[1] != 3:
            raise self.fail("anchors_m", "shape (m, 3)", f"shape {anchors_m.shape}")
        kind = self.whole("row_kind", (count,), max(RowKind))
        lowest = np.where(np.isin(kind, (RowKind.RANGE, RowKind.ANCHOR_RANGE)), 0, -1)
        highest = np.select([kind == RowKind.RANGE, kind == RowKind.ANCHOR_RANGE], [n - 1, len(anchors_m) - 1], n - 1)
        body, other = self.whole("row_body", (count,), n - 1), self.whole("row_other", (count,), None, lowest=-1)
        wrong = (other < lowest) | (other > highest) | ((kind == RowKind.RANGE) & (other == body))
        if wrong.any():
            at = int(np.argmax(wrong))
            expected = "the place of another body (range) or of an anchor (anchor_range)"
            raise self.fail("row_other", expected, f"{other[at]} in row {at} of kind {kind[at]}")
        return StudyRows(
            tick=self.whole("row_tick", (count,), ticks),
            offset_s=self.array("row_offset_s", (count,)),
            kind=kind,
            value=self.array("row_value", (count,)),
            variance=self.positive("row_variance", (count,)),
            body=body,
            other=other,
            tag=self.whole("row_tag", (count, 2), None),
            anchors_m=self.array("anchors_m", anchors_m.shape),
        )

    def whole(self, key: str, shape: tuple[int, ...], most: int | None, *, lowest: int = 0) -> NDArray[np.int64]:
        """Whole numbers from ``lowest`` to ``most``."""
        value = self.array(key, shape)
        beyond = np.zeros(shape, bool) if most is None else value > most
        bad = (value != np.trunc(value)) | (value < lowest) | beyond
        if bad.any():
            where = tuple(int(i) for i in np.argwhere(bad)[0])
            to = "" if most is None else f" to {most}"
            raise self.fail(key, f"whole numbers from {lowest}{to}", f"{value[where]:g} at index {where}")
        return value.astype(np.int64)

    def agents(self) -> NDArray[np.int64]:
        value = self.numeric("agents")
        if value.ndim != 1 or not len(value):
            raise self.fail("agents", "shape (n,) with n at least 1", f"shape {value.shape}")
        if value.dtype.kind not in "iu" or (value < 1).any() or (value > 999).any():
            raise self.fail("agents", "integer ids 1..999", f"{value.tolist()}")
        if len(set(value.tolist())) != len(value):
            raise self.fail("agents", "distinct ids", f"{value.tolist()}")
        return value.astype(np.int64)

    def edges(self, n: int) -> NDArray[np.int64]:
        value = self.numeric("edges")
        if value.size == 0:
            return np.zeros((0, 2), np.int64)
        if value.ndim != 2 or value.shape[1] != 2:
            raise self.fail("edges", "shape (m, 2)", f"shape {value.shape}")
        if (value != np.trunc(value)).any():
            raise self.fail("edges", "integers", f"{value.tolist()}")
        for i, (a, b) in enumerate(value.tolist()):
            if not (0 <= a < n and 0 <= b < n):
                raise self.fail("edges", f"places of agents 0..{n - 1}", f"unknown agent in edge {i}: ({a}, {b})")
            if a == b:
                raise self.fail("edges", "two different agents", f"edge {i}: ({a}, {b})")
        return value.astype(np.int64)

    def tick_count(self, n: int) -> int:
        accel = self.numeric("accel")
        if accel.ndim != 3 or accel.shape[1:] != (n, 3):
            raise self.fail("accel", f"shape (T, {n}, 3)", f"shape {accel.shape}")
        if not len(accel):
            raise self.fail("accel", "at least one tick", "none")
        return len(accel)
