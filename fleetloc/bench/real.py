"""``fleetloc bench real``: the estimators on recordings of real robots, beside a batch over the whole recording.

TIERS: four TurtleBots with UWB between them and to one anchor, 122 s (Xianjia Yu et al., 2022). The factor
graph ``tiers.pyfg`` (A. Papalia et al., CORA) has their odometry, truth, and ranges that its authors have calibrated;
its source states no licence, so it is read where the user has it. ``20221011_processed.csv`` (MIT) has raw ranges of
the same modules; the median error of each pair there is put back for the second half of the table.
"""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.factory import make_estimator
from estimators.integrity.consistency import nees
from estimators.model.layout import STATES_PER_AGENT, Layout
from estimators.settings import EstimatorSettings, default_settings
from estimators.systematic.range_biases import RangeBiases
from fleetloc.errors import InputError
from fleetloc.output import print_table, progress_bar, write_json
from sim_bridge.studies.imports.pyfg import FactorGraph, read_pyfg, study_of_graph
from sim_bridge.studies.lockstep import records_of
from sim_bridge.studies.planar_batch import solve_batch
from sim_bridge.studies.study_input import StudyInput

Floats = NDArray[np.float64]
GRAPH, RAW = "tiers.pyfg", "20221011_processed.csv"
ROBOTS_OF_NODES = {"1": "A", "3": "B", "4": "C", "5": "D"}
SETTLED_S = 5.0


@dataclass(frozen=True, slots=True)
class RealFigures:
    """One method on one recording: horizontal RMSE and median of all robots, m, after the first seconds.

    ``anees`` of the horizontal places of the whole fleet; ``biases_m`` by pair of robots, averaged over the second
    half: they are constant.
    """

    method: str
    rmse_m: float
    median_m: float
    anees: float | None
    biases_m: Mapping[str, float]


def run_real(
    folder: Path, odometry_sigma_m: float, range_sigma_factor: float, json_file: Path | None
) -> dict[str, Any]:
    """Run TIERS and print the table; raises `InputError` where a file is missing, `StudyInputError`.

    The file's variances are of single values. Of odometry, one of ``odometry_sigma_m`` a step is taken instead, of
    ranges those times the square of ``range_sigma_factor``: successive ranges of a pair err alike.
    """
    for name in (GRAPH, RAW):
        if not (folder / name).is_file():
            raise InputError(str(folder), name, "this file of TIERS (docs/results.md says where it is)", "none")
    graph = read_pyfg(folder / GRAPH)
    graph.edges = [replace(edge, variance=odometry_sigma_m**2) for edge in graph.edges]
    graph.ranges = [replace(each, variance=range_sigma_factor**2 * each.variance) for each in graph.ranges]
    added = raw_biases(folder / RAW)
    raw = FactorGraph(graph.vertices, graph.anchors, graph.edges, graph.ranges)
    raw.ranges = [replace(each, range_m=each.range_m + added.get("".join(each.pair), 0.0)) for each in graph.ranges]
    figures: dict[str, Any] = {
        "odometry_sigma_m": odometry_sigma_m,
        "range_sigma_factor": range_sigma_factor,
        "added_biases_m": added,
    }
    for name, each, true_m in (("calibrated", graph, {}), ("raw biases", raw, added)):
        found = _study(study_of_graph(each), graph.robots, name)
        _print(name, found, true_m)
        figures[name] = [_as_json(one, true_m) for one in found]
    if json_file is not None:
        write_json(json_file, figures)
    return figures


def raw_biases(path: Path) -> dict[str, float]:
    """The median error of each pair in the file of raw ranges, m, by letters of robots; raises `InputError`."""
    errors: dict[str, list[float]] = defaultdict(list)
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                ends = sorted(ROBOTS_OF_NODES[row[node].partition(".")[0]] for node in ("node1", "node2"))
                errors["".join(ends)].append(float(row["uwb_range"]) - float(row["mocap_range"]))
    except (KeyError, ValueError) as error:
        raise InputError(str(path), "columns", "node1, node2, uwb_range, mocap_range", str(error)) from None
    return {pair: float(np.median(values)) for pair, values in sorted(errors.items())}


def _study(recording: StudyInput, robots: tuple[str, ...], name: str) -> list[RealFigures]:
    shared = default_settings()
    methods = {
        "centralised EKF": replace_setting(shared, kind="centralized_ekf"),
        "shared MHE": replace_setting(shared, systematic_errors=False),
        "shared MHE, biases": shared,
    }
    found = []
    with progress_bar(f"TIERS, {name}: ticks", len(methods) * (recording.ticks + 1)) as advance:
        for method, settings in methods.items():
            found.append(_estimated(recording, settings, robots, method, advance))
    for biases in (False, True):
        solution = solve_batch(recording, biases=biases)
        errors = solution.position_m - _truth(recording)
        named = {robots[a] + robots[b]: bias for (a, b), bias in solution.bias_m.items()}
        found.append(_figures("batch, biases" if biases else "batch", recording, errors, None, named))
    return found


def replace_setting(settings: EstimatorSettings, **changed: Any) -> EstimatorSettings:
    """The same settings but for some."""
    import msgspec

    return msgspec.structs.replace(settings, **changed)


def _truth(recording: StudyInput) -> Floats:
    assert recording.truth is not None
    return recording.truth[:, :, :2]


def _estimated(
    recording: StudyInput, settings: EstimatorSettings, robots: tuple[str, ...], method: str, advance: Any
) -> RealFigures:
    """What each robot knows that has heard everything in time: one estimator over everybody's rows."""
    n = len(recording.agents)
    layout = Layout(tuple(int(each) for each in recording.agents))
    estimator = make_estimator(settings, layout, 0, recording.x0[0], recording.P0, recording.period_s)
    errors, squares = np.empty((recording.ticks + 1, n, 2)), np.empty(recording.ticks + 1)
    plane = np.array([STATES_PER_AGENT * slot + axis for slot in range(n) for axis in (0, 1)])
    biases: list[RangeBiases] = []
    for tick in range(recording.ticks + 1):
        estimator.begin(tick, *records_of(recording, [(tick, slot) for slot in range(n)]))
        for round_ in range(estimator.rounds):
            estimator.outgoing(round_)
            estimator.mix(round_, {})
        estimate = estimator.solve()
        error = estimate.mean[plane] - _truth(recording)[tick].ravel()
        errors[tick] = error.reshape(n, 2)
        squares[tick] = nees(error, estimate.covariance[np.ix_(plane, plane)]) / len(plane)
        if estimate.range_biases is not None and 2 * tick > recording.ticks:
            biases.append(estimate.range_biases)
        advance()
    named = {}
    if biases:
        bias_m = np.mean([each.bias_m for each in biases], axis=0)
        named = {robots[a] + robots[b]: float(bias_m[a, b]) for a in range(n) for b in range(a + 1, n)}
    return _figures(method, recording, errors, squares, {k: v for k, v in named.items() if math.isfinite(v)})


def _figures(
    method: str, recording: StudyInput, errors: Floats, squares: Floats | None, biases: Mapping[str, float]
) -> RealFigures:
    settled = slice(round(SETTLED_S / recording.period_s), None)
    distances = np.linalg.norm(errors[settled], axis=-1)
    anees = None if squares is None else float(squares[settled].mean())
    return RealFigures(method, float(np.sqrt((distances**2).mean())), float(np.median(distances)), anees, biases)


def _worst(one: RealFigures, true_m: Mapping[str, float]) -> float | None:
    """The largest error of a bias, where all are known."""
    if not one.biases_m:
        return None
    return max(abs(bias - true_m.get(pair, 0.0)) for pair, bias in one.biases_m.items())


def _print(name: str, found: list[RealFigures], true_m: Mapping[str, float]) -> None:
    rows = []
    for one in found:
        worst = _worst(one, true_m)
        rows.append(
            [
                one.method,
                f"{one.rmse_m:.3f}",
                f"{one.median_m:.3f}",
                "-" if one.anees is None else f"{one.anees:.2f}",
                "-" if worst is None else f"{worst:.3f}",
            ]
        )
    print_table(["method", "RMSE m", "median m", "ANEES", "worst bias m"], rows, title=f"TIERS, {name}")


def _as_json(one: RealFigures, true_m: Mapping[str, float]) -> dict[str, Any]:
    return {
        "method": one.method,
        "rmse_m": one.rmse_m,
        "median_m": one.median_m,
        "anees": one.anees,
        "biases_m": dict(one.biases_m),
        "worst_bias_error_m": _worst(one, true_m),
    }
