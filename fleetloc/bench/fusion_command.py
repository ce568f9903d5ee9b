"""``fleetloc bench fusion``: estimation over links that hold and delay packets, against reference figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from fleetloc.bench.lossy_fusion import Figures, Setting

ACCEPTED_STANDARD_ERRORS = 4.0


def fusion(
    runs: Annotated[int | None, typer.Option("--runs", min=2, help="Per setting; default 300, 200 and 200.")] = None,
    seed: Annotated[int, typer.Option("--seed")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here too.")] = None,
) -> None:
    """Fu, Bi and Gao's filters over a channel that delays.

    By Monte Carlo, beside the figures of an independent implementation.
    """
    from fleetloc.bench.lossy_fusion import METHODS, SETTINGS, study
    from fleetloc.output import print_table, progress_bar, write_json

    counts = [setting.runs if runs is None else runs for setting in SETTINGS]
    results: dict[str, Any] = {"seed": seed, "settings": {}}
    with progress_bar("runs", sum(counts)) as advance:
        for setting, count in zip(SETTINGS, counts, strict=True):
            figures = study(setting, count, seed, advance)
            rows = {name: _row(setting, name, figures[name]) for name in METHODS}
            results["settings"][setting.name] = {"runs": count, "methods": rows}
    for name, result in results["settings"].items():
        columns = ["method", "MSE m2", "trace P", "NEES/6", "expected", "standard errors apart"]
        lines = [_shown(method, row) for method, row in result["methods"].items()]
        print_table(columns, lines, title=f"{name}, {result['runs']} runs")
    if json_file is not None:
        write_json(json_file, results)


def _row(setting: Setting, name: str, figures: Figures) -> dict[str, float | None]:
    row: dict[str, float | None] = {
        "mse_m2": figures.mse_m2,
        "mse_se_m2": figures.mse_se_m2,
        "trace_m2": figures.trace_m2,
        "nees_per_state": figures.nees_per_state,
        "expected_mse_m2": None,
        "standard_errors_apart": None,
    }
    if name in setting.expected:
        mse, error = setting.expected[name]
        row["expected_mse_m2"] = mse
        row["standard_errors_apart"] = (figures.mse_m2 - mse) / float((figures.mse_se_m2**2 + error**2) ** 0.5)
    return row


def _shown(method: str, row: dict[str, float | None]) -> list[str]:
    expected, apart = row["expected_mse_m2"], row["standard_errors_apart"]
    remark = "" if apart is None else f"{apart:+.1f}{'' if abs(apart) <= ACCEPTED_STANDARD_ERRORS else ' !'}"
    return [
        method,
        f"{row['mse_m2']:.2f} ± {row['mse_se_m2']:.2f}",
        f"{row['trace_m2']:.2f}",
        f"{row['nees_per_state']:.3f}",
        "" if expected is None else f"{expected:.2f}",
        remark,
    ]
