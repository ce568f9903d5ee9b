"""``fleetloc estimate``: run an estimator over a study input."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleetloc.options import Overrides

if TYPE_CHECKING:
    from sim_bridge.studies.lockstep import LockstepResult
    from sim_bridge.studies.study_input import StudyInput


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("estimate")(estimate)


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
