"""Frozen DMHE cases -> recordings and settings.

A case holds a global measurement vector with one owner per row; a recording holds the same values by sensor.
Run as a script to convert a folder: ``python -m tests.support.frozen_cases CASES_DIR OUT_DIR`` writes, for
each case, ``NAME.npz`` (the recording) and ``NAME.toml`` (its ``[estimator]`` table).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

KINDS = {"pre": "dmhe_pre_ekf", "full": "dmhe", "dekf": "dekf_ci", "central_ekf": "centralized_ekf"}


def load_case(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays and options of a case."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = {key: archive[key] for key in archive.files}
    return arrays, json.loads(str(arrays["options"]))


def neighbour_lists(options: dict[str, Any]) -> list[list[int]]:
    """Sorted neighbours of every agent, the order of a case's range rows."""
    found: list[set[int]] = [set() for _ in range(options["na"])]
    for a, b in options["edges"]:
        found[a].add(b)
        found[b].add(a)
    return [sorted(each) for each in found]


def case_recording(arrays: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """The arrays of the recording (format: docs/replay.md)."""
    n = options["na"]
    ticks = len(arrays["y"])
    gps = np.full((ticks, n, 4), np.nan)
    ranges = np.full((ticks, n, n), np.nan)
    half_gps = np.full(4, np.nan)
    half_range = np.nan
    column = 0
    for agent, others in enumerate(neighbour_lists(options)):
        if options["gps"][agent]:
            gps[:, agent] = arrays["y"][:, column : column + 4]
        half_gps = arrays["half"][column : column + 4]
        column += 4
        for other in others:
            ranges[:, agent, other] = arrays["y"][:, column]
            half_range = arrays["half"][column]
            column += 1
    assert column == arrays["y"].shape[1], "every row of the case must have found its place"
    recording = {
        "period_s": np.float64(options["dt"]),
        "agents": np.arange(1, n + 1),
        "edges": np.array(options["edges"], np.int64).reshape(-1, 2),
        "accel": arrays["u_meas"].reshape(ticks - 1, n, 3),
        "gps": gps,
        "ranges": ranges,
        "gps_half_width": half_gps,
        "range_half_width": np.float64(half_range),
        "accel_half_width": np.float64(np.sqrt(3.0 * options["q_own"])),
        "x0": arrays["x0"],
        "P0": arrays["P0"],
        "truth": arrays["x_true"].reshape(ticks, n, 6),
    }
    if "link" in arrays:
        recording["received"] = arrays["link"].astype(bool)
    return recording


def case_settings(options: dict[str, Any]) -> dict[str, Any]:
    """The ``[estimator]`` table."""
    table: dict[str, Any] = {
        "kind": KINDS[options["kind"]],
        "window": options["N"],
        "rounds": options["L"],
        "other_accel_variance": options["q_other"],
        "norm_smoothing_m": options["eps"],
        "tolerance": 1e-9,
        "max_iterations": 1000,
    }
    if options["con"] is not None:
        table["noise_bounds"] = "soft"
        table["noise_bounds_on"] = {"pred": "predicted", "corr": "corrected"}[options["con_at"]]
        table["noise_bounds_penalty"] = options["rho1"]
    if options["box"] is not None:
        table["state_box_position_m"], table["state_box_speed_mps"] = map(float, options["box"])
    return table


def toml(table: dict[str, Any]) -> str:
    """A flat table as TOML."""
    return "[estimator]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in table.items())


def main(cases: Path, out: Path) -> None:
    """Convert a folder of cases."""
    out.mkdir(parents=True, exist_ok=True)
    for path in sorted(cases.glob("c*.npz")):
        arrays, options = load_case(path)
        np.savez_compressed(out / path.name, **case_recording(arrays, options))
        (out / path.with_suffix(".toml").name).write_text(toml(case_settings(options)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
