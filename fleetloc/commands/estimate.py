"""``fleetloc estimate``: run an estimator over a study input; ``fleetloc import``: make one of another recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleetloc.options import Overrides

if TYPE_CHECKING:
    from sim_bridge.studies.lockstep import LockstepResult
    from sim_bridge.studies.study_input import StudyInput


Source = Annotated[Path, typer.Argument(metavar="FILE", help="The recording.")]
Out = Annotated[Path, typer.Option("--out", metavar="FILE", help="The study input to write (.npz).")]
Period = Annotated[float, typer.Option("--period", metavar="S", min=0.001, help="Length of a tick, s.")]
AccelSigma = Annotated[
    float, typer.Option("--accel-sigma", min=1e-3, help="Of accelerations, which nobody measured, m/s2 per axis.")
]


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("estimate")(estimate)
    group = typer.Typer(help="Make study inputs of other recordings: csv, pyfg.", rich_markup_mode=None)
    group.callback()(_group)
    group.command("csv")(csv)
    group.command("pyfg")(pyfg)
    app.add_typer(group, name="import")


def estimate(
    study_input: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="What each drone sensed and heard in each tick (.npz, docs/replay.md)."),
    ],
    config: Annotated[
        Path | None, typer.Option("--config", help="TOML file; only its [estimator] table is read.")
    ] = None,
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write mean, cov_diag and status here (.npz).")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
) -> None:
    """Run the estimators tick by tick over a study input.

    One per agent, in lockstep. The errors are printed where the file holds the truth.
    """
    from agent.config.reading import load_estimator_settings
    from fleetloc.output import progress_bar, write_json
    from fleetloc.warmup import announce
    from sim_bridge.studies.lockstep import run_lockstep
    from sim_bridge.studies.study_input import load_study_input

    settings = load_estimator_settings(config, overrides or [])
    fleet = load_study_input(study_input)
    announce()
    with progress_bar("ticks", fleet.ticks + 1) as advance:
        result = run_lockstep(fleet, settings, lambda _tick: advance())
    if out is not None:
        _write(out, result)
    figures = _figures(fleet, result)
    _print(fleet, figures)
    if json_file is not None:
        write_json(json_file, {"study_input": study_input.name, "estimator": settings.kind, **figures})


def _write(path: Path, result: LockstepResult) -> None:
    import numpy as np

    with path.open("wb") as file:
        np.savez_compressed(file, mean=result.mean, cov_diag=result.cov_diag, status=result.status)


def _figures(study_input: StudyInput, result: LockstepResult) -> dict[str, Any]:
    """What there is to say about a run, per agent, with units in the keys."""
    import numpy as np

    from estimators.estimator import Status
    from estimators.integrity.consistency import rms
    from estimators.model.layout import position, velocity

    agents = []
    for slot, agent_id in enumerate(study_input.agents.tolist()):
        row: dict[str, Any] = {"id": agent_id}
        row["status"] = {
            status.name.lower(): int(np.count_nonzero(result.status[:, slot] == status)) for status in Status
        }
        if study_input.truth is not None and result.nees_full is not None:
            own = result.mean[:, slot, :] - study_input.truth.reshape(len(study_input.truth), -1)
            row["position_rmse_m"] = rms(own[1:, position(slot)])
            row["velocity_rmse_mps"] = rms(own[1:, velocity(slot)])
            row["norm_full_mean"] = float(np.linalg.norm(own[1:], axis=1).mean())
            row["norm_full_final"] = float(np.linalg.norm(own[-1]))
            row["anees"] = float(result.nees_full[1:, slot].mean())
        agents.append(row)
    return {"ticks": study_input.ticks + 1, "agents": agents, "late_records_dropped": int(result.dropped.sum())}


def _print(study_input: StudyInput, figures: dict[str, Any]) -> None:
    from fleetloc.output import print_table

    known = study_input.truth is not None
    columns = ["agent", "ticks ok", "other"]
    if known:
        columns += ["position RMSE m", "velocity RMSE m/s", "fleet error", "at the end", "ANEES"]
    rows = []
    for agent in figures["agents"]:
        ok = agent["status"]["ok"]
        row = [str(agent["id"]), str(ok), str(figures["ticks"] - ok)]
        if known:
            keys = ("position_rmse_m", "velocity_rmse_mps", "norm_full_mean", "norm_full_final", "anees")
            row += [f"{agent[key]:.4f}" for key in keys]
        rows.append(row)
    print_table(columns, rows)


def _group() -> None:
    """Make study inputs of recordings in other formats."""


def csv(file: Source, out: Out, period: Period = 0.1, accel_sigma: AccelSigma = 0.5) -> None:
    """Rows as text, one measurement a line.

    The columns are time_s, kind, body, other, value and sigma (docs/replay.md).
    """
    from sim_bridge.studies.imports.csv_rows import study_of_csv
    from sim_bridge.studies.imports.row_builder import Start

    study_of_csv(file, period, Start(accel_mps2=accel_sigma)).save(_named(out))


def pyfg(file: Source, out: Out, period: Period = 0.1, accel_sigma: AccelSigma = 0.5) -> None:
    """Planar factor graphs in the text format of PyFG.

    Odometry becomes velocities, landmarks become anchors.
    """
    from sim_bridge.studies.imports.pyfg import read_pyfg, study_of_graph
    from sim_bridge.studies.imports.row_builder import Start

    study_of_graph(read_pyfg(file), period, Start(accel_mps2=accel_sigma)).save(_named(out))


def _named(out: Path) -> Path:
    """numpy puts .npz behind another name, which nobody asked for."""
    from fleetloc.errors import InputError

    if out.suffix != ".npz":
        raise InputError("--out", "", "a file name that ends in .npz", out.name)
    return out
