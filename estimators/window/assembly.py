"""From settings to a window, and from a window to its problem: the same for every moving horizon estimator."""

from __future__ import annotations

import numpy as np

from estimators.model.gaussian import Pair
from estimators.model.layout import Layout
from estimators.settings import EstimatorSettings, fade_per_tick
from estimators.window.history import MeasurementWindow
from estimators.window.problem import WindowProblem


def open_window(settings: EstimatorSettings, layout: Layout, period_s: float) -> MeasurementWindow:
    """An empty measurement window as the settings ask for."""
    return MeasurementWindow(
        layout,
        settings.window,
        other_accel_variance=settings.other_accel_variance,
        reciprocal_ranges=settings.reciprocal_ranges,
        unknown_inputs=settings.unknown_inputs,
        held_accel_fade=fade_per_tick(settings, period_s),
    )


def window_problem(
    window: MeasurementWindow, prior: Pair, slot: int, period_s: float, with_gains: bool
) -> WindowProblem:
    """The least-squares problem of a window; ``prior``: the fused pair at its start. The agent itself stays in it."""
    rows, start = window.rows()
    accel, variance = window.inputs()
    information, vector = prior
    return WindowProblem(
        rows=rows,
        start=start,
        accel=accel,
        accel_variance=variance,
        information=information,
        vector=vector,
        keep=np.array([slot], np.int64),
        period_s=period_s,
        with_gains=with_gains,
    )
