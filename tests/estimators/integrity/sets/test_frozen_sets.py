"""Frozen cases of set membership, of an independent reference.

Four files are kept in ``tests/data/esmf``; more may lie in ``shared/cases/esmf`` beside the repository.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimators.integrity.sets.cuts import Outcome, Strip, cut, cut_range, predicted, strip_of_range
from estimators.integrity.sets.ellipsoid import Ellipsoid
from sim_bridge.studies.half_circle import HalfCircleData, set_filter

KEPT = Path(__file__).parents[3] / "data" / "esmf"
SHARED = Path(__file__).resolve().parents[5] / "shared" / "cases" / "esmf"


def files(pattern: str) -> list[Path]:
    """Of both folders, each name once."""
    found = {path.name: path for folder in (SHARED, KEPT) for path in folder.glob(f"esmf_{pattern}.npz")}
    return [found[name] for name in sorted(found)]


def load(path: Path) -> Mapping[str, Any]:
    with np.load(path) as archive:
        return dict(archive)


def near(found: Any, expected: Any, rtol: float) -> bool:
    """Within ``rtol`` of the largest entry."""
    scale = max(float(np.abs(expected).max()), 1e-300)
    return bool(np.abs(np.asarray(found) - expected).max() <= rtol * scale)


@pytest.mark.parametrize("path", files("predict*"), ids=lambda path: path.stem)
def test_predictions(path: Path) -> None:
    case = load(path)
    for k in range(len(case["c"])):
        made = predicted(Ellipsoid(case["c"][k], case["P"][k]), case["A"][k], case["u"][k], case["Q"][k])
        assert near(made.centre, case["c_out"][k], case["rtol"])
        assert near(made.shape, case["P_out"][k], case["rtol"])


@pytest.mark.parametrize("path", files("strip*"), ids=lambda path: path.stem)
def test_strips(path: Path) -> None:
    case = load(path)
    seen = set()
    for k, status in enumerate(case["status"]):
        strip = Strip(case["C"][k], float(case["lo"][k]), float(case["hi"][k]))
        before = Ellipsoid(case["c"][k], case["P"][k])
        made = cut(before, strip)
        assert made.outcome == status
        seen.add(made.outcome)
        if made.outcome is Outcome.EMPTY:
            assert made.ellipsoid is before
            continue
        assert near(made.ellipsoid.centre, case["c_out"][k], case["rtol"])
        assert near(made.ellipsoid.shape, case["P_out"][k], case["rtol"])
        assert (made.strip.low, made.strip.high) == pytest.approx(
            (case["lo_t"][k], case["hi_t"][k]), rel=1e-9, abs=1e-9
        )
        if made.outcome is Outcome.CUT:
            assert made.weight == pytest.approx(case["q"][k], rel=float(case["rtol"]))
    assert seen == set(Outcome)


@pytest.mark.parametrize("path", files("range*"), ids=lambda path: path.stem)
def test_range_strips(path: Path) -> None:
    case = load(path)
    for k, status in enumerate(case["status"]):
        held = Ellipsoid(case["c"][k], case["P"][k])
        strip, rho = strip_of_range(held, float(case["r"][k]), float(case["w"][k]))
        found = [*strip.row, strip.low, strip.high, rho]
        assert near(found, [*case["C"][k], case["lo"][k], case["hi"][k], case["rho"][k]], case["rtol"])
        made = cut(held, strip)
        assert made.outcome == status
        if status != Outcome.EMPTY:
            assert near(made.ellipsoid.centre, case["c_out"][k], case["rtol"])
            assert near(made.ellipsoid.shape, case["P_out"][k], case["rtol"])
            assert made.ellipsoid.level(case["d_true"][k]) <= 1.0 + 1e-9


def test_without_the_remainder_a_range_rejects_the_truth() -> None:
    case = load(KEPT / "esmf_counterexample.npz")
    held, range_m, width_m = Ellipsoid(case["c"], case["P"]), float(case["r"]), float(case["w"])
    strip, rho = strip_of_range(held, range_m, width_m)
    assert rho == pytest.approx(float(case["rho"]), rel=1e-9)
    made = cut_range(held, range_m, width_m)
    assert made.outcome is not Outcome.EMPTY
    assert made.ellipsoid.level(case["d_true"]) == pytest.approx(float(case["level_with"]), rel=1e-9)
    assert cut(held, Strip(strip.row, strip.low + rho, strip.high)).outcome is Outcome.EMPTY


@pytest.mark.parametrize("path", files("halfcircle*"), ids=lambda path: path.stem)
def test_half_circle(path: Path) -> None:
    case = load(path)
    data = HalfCircleData(
        case["d"], case["y"], case["du"], case["r"], case["H"], float(case["W"]), float(case["wtd"]),
        float(case["wuwb"]),
    )  # fmt: skip
    for name in ("gnss", "uwb"):
        made = list(set_filter(data, with_ranges=name == "uwb"))
        rtol = float(case["rtol"])
        assert near([held.centre for held, _ in made], case[f"c_{name}"], rtol)
        assert near([held.shape for held, _ in made], case[f"P_{name}"], rtol)
