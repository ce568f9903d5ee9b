"""Stanford diagrams: errors against protection levels, epoch by epoch, with the alert limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fleetloc.bench.integrity.flights import Promises
from fleetloc.extras import is_installed
from fleetloc.report.style import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def stanford(flown: Sequence[Promises], limits_m: tuple[float, float], settled: int) -> Figure | None:
    """Horizontal and vertical, of flights of one fleet; ``None`` where the plotting library is missing."""
    if not is_installed("report"):
        return None
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 4.8), layout="constrained")
        FigureCanvasAgg(figure)
        for axis, axes in enumerate(figure.subplots(1, 2)):
            error = np.concatenate([each.error_m[settled:, :, axis].ravel() for each in flown])
            level = np.concatenate([each.level_m[settled:, :, axis].ravel() for each in flown])
            known, limit = np.isfinite(error) & np.isfinite(level), limits_m[axis]
            edges = np.linspace(0.0, 2.0 * limit, 81)
            axes.hist2d(error[known], level[known], bins=[edges, edges], cmin=1, norm="log", cmap="viridis")
            axes.plot(edges, edges, color="#b00020", linewidth=0.8)
            axes.axhline(limit, color="#888888", linewidth=0.8)
            axes.axvline(limit, color="#888888", linewidth=0.8)
            name = ("horizontal", "vertical")[axis]
            axes.set(title=name, xlabel="error m", ylabel="protection level m")
    return figure
