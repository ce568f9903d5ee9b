"""The studies' plots as PNG files, drawn without a display; none where the plotting library is missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fleetloc.extras import is_installed
from fleetloc.report.style import COLOURS, STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fleetloc.bench.sweep import Flown

PANELS = (
    ("norm_full_steady_mean", "steady error of the fleet state"),
    ("norm_full_transient_mean", "error in the transient"),
    ("anees_full_steady_mean", "steady ANEES"),
)


def save(figure: Figure | None, folder: Path, name: str) -> None:
    """Write a figure, where there is one, as ``folder/name.png``."""
    if figure is not None:
        folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(folder / f"{name}.png", dpi=110)


def _figure(width_in: float, height_in: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def curves(flown: Sequence[Flown], label: str) -> Figure | None:
    """Errors and ANEES of all methods along an axis, with standard errors; one point per condition."""
    if not is_installed("report"):
        return None
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = _figure(13.0, 4.4)
        values = [float(each.point.value or 0.0) for each in flown]
        for axes, (key, title) in zip(figure.subplots(1, 3), PANELS, strict=True):
            for index, method in enumerate(flown[0].rows):
                rows: list[Mapping[str, Any]] = [each.rows[method] for each in flown]
                if key in rows[0]:
                    _curve(axes, values, rows, key, COLOURS[index % len(COLOURS)], method)
            axes.set(title=title, xlabel=label, yscale="log", xticks=values)
            if key.startswith("anees"):
                axes.axhline(1.0, color="#888888", linewidth=0.8)
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return figure


def _curve(
    axes: Axes, values: Sequence[float], rows: Sequence[Mapping[str, Any]], key: str, colour: str, label: str
) -> None:
    error = np.nan_to_num([row[f"{key}_se"] for row in rows])
    middle = [row[key] for row in rows]
    axes.errorbar(values, middle, yerr=error, color=colour, marker="o", markersize=3.5, linewidth=1.2, label=label)


def islands(
    time_s: NDArray[np.float64], anees: Mapping[str, NDArray[np.float64]],
    disagreement: Mapping[str, NDArray[np.float64]], cut_s: tuple[float, float],
) -> Figure | None:  # fmt: skip
    """ANEES of each island and disagreement between them over time ``(T+1,)``; the partition is shaded."""
    if not is_installed("report"):
        return None
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = _figure(9.0, 6.0)
        above, below = figure.subplots(2, 1, sharex=True)
        for axes, lines in ((above, anees), (below, disagreement)):
            for index, (name, line) in enumerate(lines.items()):
                axes.plot(time_s, line, color=COLOURS[index], linewidth=1.0, label=name)
            axes.axvspan(*cut_s, color="#bbbbbb", alpha=0.35, linewidth=0)
            axes.set_yscale("log")
            axes.legend(loc="upper right")
        above.axhline(2.0, color="#888888", linewidth=0.8)
        above.set(title="ANEES of the fleet state, mean over runs and members")
        below.set(title="disagreement between members of different islands, rms norm", xlabel="time s")
    return figure
