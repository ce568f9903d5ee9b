"""``fleetloc bench``: studies of the estimators."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

Runs = Annotated[int, typer.Option(min=1, help="Monte Carlo runs, the same for all methods.")]
Seed = Annotated[int, typer.Option(min=0, help="Of all random draws.")]
Period = Annotated[float, typer.Option(min=0.001, help="Length of a tick, s.")]
Samples = Annotated[int, typer.Option(min=1, help="Ticks after the first.")]
OtherAccel = Annotated[
    float, typer.Option(min=1e-9, help="Variance (m/s2)^2 assumed for accelerations that are not known.")
]
StartKind = Annotated[Literal["paper", "good"], typer.Option(help="Estimates at zero, or drawn around the truth.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the results to this file.")]


def register(app: typer.Typer) -> None:
    """Add the command group to the command line."""
    bench = typer.Typer(help="Studies: accuracy, Table I of the paper, speed.", rich_markup_mode=None)
    bench.callback()(_group)
    bench.command("table1")(table1)
    bench.command("accuracy")(accuracy)
    bench.command("loss")(loss)
    bench.command("speed")(speed)
    app.add_typer(bench, name="bench")


def _group() -> None:
    """Studies of the estimators; every one takes --seed and --json."""


def table1(
    runs: Runs = 20,
    seed: Seed = 0,
    period: Period = 0.1,
    samples: Samples = 50,
    other_accel_variance: OtherAccel = 0.02,
    start: StartKind = "paper",
    json_file: JsonFile = None,
) -> None:
    """Table I of Borelle et al. 2023: four distributed estimators on the paper's fleet of three."""
    from fleetloc.bench.accuracy import table1 as study
    from fleetloc.output import write_json
    from fleetloc.warmup import announce

    announce()
    results = study(
        runs=runs,
        seed=seed,
        period_s=period,
        samples=samples,
        other_accel_variance=other_accel_variance,
        start=start,
    )
    if json_file is not None:
        write_json(json_file, results)


def accuracy(
    runs: Runs = 20,
    seed: Seed = 0,
    graph: Annotated[str, typer.Option(help="line, triangle, ring4, K4, K5 or K6.")] = "line",
    period: Period = 0.1,
    samples: Samples = 70,
    other_accel_variance: OtherAccel = 4.0 / 3.0,
    start: StartKind = "good",
    blind: Annotated[int, typer.Option(min=0, help="Agents without GPS, from the last backwards.")] = 0,
    json_file: JsonFile = None,
) -> None:
    """Steady accuracy and consistency (ANEES) of all estimators on the same runs."""
    from fleetloc.bench.accuracy import accuracy as study
    from fleetloc.bench.accuracy import default_methods
    from fleetloc.errors import InputError
    from fleetloc.output import write_json
    from fleetloc.warmup import announce
    from sim_bridge.study_scenario import GRAPHS

    if graph not in GRAPHS:
        raise InputError("--graph", "", f"one of {', '.join(GRAPHS)}", graph)
    if blind > GRAPHS[graph][0]:
        raise InputError("--blind", "", f"at most {GRAPHS[graph][0]} agents", str(blind))
    announce()
    results = study(
        runs=runs,
        seed=seed,
        graph=graph,
        samples=samples,
        period_s=period,
        start=start,
        blind=blind,
        methods=default_methods(other_accel_variance),
    )
    if json_file is not None:
        write_json(json_file, results)


def loss(
    runs: Runs = 20,
    seed: Seed = 0,
    losses: Annotated[str, typer.Option(help="Probabilities, separated by commas.")] = "0,0.1,0.3,0.5,0.8",
    delays: Annotated[str, typer.Option(help="Ticks, separated by commas.")] = "1,2",
    json_file: JsonFile = None,
) -> None:
    """Accuracy and consistency when packets are lost or late on every link of the line of three."""
    from fleetloc.bench.accuracy import default_methods
    from fleetloc.bench.accuracy import loss as study
    from fleetloc.output import write_json
    from fleetloc.warmup import announce

    chosen = ("dmhe_pre_ekf", "dekf_ci", "dekf_ci_shared", "dmhe_relay")
    methods = {name: settings for name, settings in default_methods(4.0 / 3.0).items() if name in chosen}
    probabilities = _numbers("--losses", losses, 0.0, 0.99)
    ticks = [int(value) for value in _numbers("--delays", delays, 0, 50)]
    announce()
    results = study(runs=runs, seed=seed, losses=probabilities, delays_ticks=ticks, methods=methods)
    if json_file is not None:
        write_json(json_file, results)


def _numbers(option: str, text: str, low: float, high: float) -> list[float]:
    """A comma-separated list of numbers within bounds; raises `InputError`."""
    from fleetloc.errors import InputError

    expected = f"numbers from {low:g} to {high:g}, separated by commas"
    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise InputError(option, "", expected, text) from None
    if not all(low <= value <= high for value in values):
        raise InputError(option, "", expected, text)
    return values


def speed(
    seed: Seed = 0,
    repeats: Annotated[int, typer.Option(min=1, help="Timed rounds over the windows, at most.")] = 30,
    windows: Annotated[int, typer.Option(min=1, max=64, help="Different windows per size.")] = 8,
    sizes: Annotated[str, typer.Option(help="AGENTSxWINDOW, separated by commas.")] = "3x2,5x5,10x5,20x5",
    cases: Annotated[str, typer.Option(help="Of free, loose, active: separated by commas.")] = "free,loose,active",
    json_file: JsonFile = None,
) -> None:
    """Time our step against IPOPT, SQP+OSQP, SLSQP, a plain numpy build and DEKF-CI on the same windows."""
    from fleetloc.bench.environment import use_one_thread

    use_one_thread()  # before numpy comes in
    from fleetloc.bench.command_speed import run_command

    run_command(json_file, seed, repeats, windows, sizes, cases)
