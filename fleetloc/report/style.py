"""Colours and style of all plots; imports no plotting library."""

from __future__ import annotations

from typing import Any

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f6000", "#444444")
"""Told apart by most eyes (Okabe and Ito), then repeated."""
STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "svg.hashsalt": "fleetloc",
}
NO_PLOTS = "this page has no plots"
"""Said where the plotting library is missing."""


def colour(slot: int) -> str:
    """The colour of an agent in every plot."""
    return COLOURS[slot % len(COLOURS)]
