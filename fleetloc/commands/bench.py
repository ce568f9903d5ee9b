"""``fleetloc bench``: studies of the estimators."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fleetloc.bench.fusion_command import fusion
from fleetloc.bench.integrity.commands import integrity, setmembership
from fleetloc.options import Overrides

if TYPE_CHECKING:
    from fleetloc.bench.sweep import Point
    from sim_bridge.studies.study_scenario import StudyScenario

Runs = Annotated[int, typer.Option(min=1, help="Monte Carlo runs, the same for all methods.")]
Seed = Annotated[int, typer.Option(min=0, help="Of all random draws.")]
Period = Annotated[float, typer.Option(min=0.001, help="Length of a tick, s.")]
Samples = Annotated[int, typer.Option(min=1, help="Ticks after the first.")]
OtherAccel = Annotated[
    float, typer.Option(min=1e-9, help="Variance (m/s2)^2 assumed for accelerations that are not known.")
]
StartKind = Annotated[Literal["paper", "good"], typer.Option(help="Estimates at zero, or drawn around the truth.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the results to this file.")]
OutFolder = Annotated[Path | None, typer.Option("--out", help="Folder for the plots (PNG) and results.json.")]
Jobs = Annotated[int, typer.Option(min=0, max=256, help="Processes at a time; 0: one per processor.")]
Methods = Annotated[str, typer.Option(help="Names, separated by commas; empty: all.")]


def register(app: typer.Typer) -> None:
    """Add the command group to the command line."""
    bench = typer.Typer(
        help="Studies: accuracy, loss, faults, scale, speed, sets, real.", rich_markup_mode=None
    )
    bench.callback()(_group)
    bench.command("table1")(table1)
    bench.command("accuracy")(accuracy)
    bench.command("loss")(loss)
    bench.command("blind")(blind)
    bench.command("partition")(partition)
    bench.command("speed")(speed)
    bench.command("fusion")(fusion)
    bench.command("faults")(faults)
    bench.command("awareness")(awareness)
    bench.command("scale")(scale)
    bench.command("setmembership")(setmembership)
    bench.command("integrity")(integrity)
    bench.command("real")(real)
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
    """Table I of the paper: four estimators on its fleet.

    The paper is Borelle et al. 2023.
    """
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
    graph: Annotated[str, typer.Option(help="line, triangle, line4..10, ring4..10 or K4..10.")] = "line",
    period: Period = 0.1,
    samples: Samples = 70,
    other_accel_variance: OtherAccel = 4.0 / 3.0,
    start: StartKind = "good",
    blind: Annotated[int, typer.Option(min=0, help="Agents without GPS, from the last backwards.")] = 0,
    methods: Methods = "",
    agents: Annotated[str, typer.Option(help="Repeat with fleets of these sizes (3..10), by commas.")] = "",
    family: Annotated[Literal["line", "ring", "K"], typer.Option(help="Graphs of --agents.")] = "ring",
    gps_shares: Annotated[str, typer.Option(help="Repeat with these shares of drones with GPS, by commas.")] = "",
    start_offsets: Annotated[
        str, typer.Option(help="Repeat with every position of the start so many m off (P0 knows), by commas.")
    ] = "",
    jobs: Jobs = 0,
    out: OutFolder = None,
    json_file: JsonFile = None,
) -> None:
    """Accuracy and consistency (ANEES) of all estimators.

    All fly the same runs; also along a few axes.
    """
    from fleetloc.bench.accuracy import accuracy as study
    from fleetloc.bench.methods import chosen, default_methods
    from fleetloc.errors import InputError
    from sim_bridge.studies.study_scenario import GRAPHS, StudyScenario

    if graph not in GRAPHS:
        raise InputError("--graph", "", f"one of {', '.join(GRAPHS)}", graph)
    if blind > GRAPHS[graph][0]:
        raise InputError("--blind", "", f"at most {GRAPHS[graph][0]} agents", str(blind))
    if start == "paper" and start_offsets:
        raise InputError("--start-offsets", "", "the good start", "the paper's")
    scenario = StudyScenario(graph, samples, period, start, blind)
    sweeps = _sweeps(scenario, agents, family, gps_shares, start_offsets)
    selected = chosen(default_methods(other_accel_variance), methods)
    folder = _prepare(out)
    results = study(
        runs=runs, seed=seed, scenario=scenario, methods=selected, sweeps=sweeps, jobs=_jobs(jobs), out=folder
    )
    _write(results, folder, json_file)


def _sweeps(scenario: StudyScenario, agents: str, family: str, gps_shares: str, start_offsets: str) -> list[Point]:
    from fleetloc.bench.accuracy import sweep_points

    return sweep_points(
        scenario,
        family,
        _whole_numbers("--agents", agents, 3, 10),
        _numbers("--gps-shares", gps_shares, 0.0, 1.0),
        _numbers("--start-offsets", start_offsets, 0.0, 1000.0),
    )


def loss(
    runs: Runs = 20,
    seed: Seed = 0,
    link_seed: Annotated[int | None, typer.Option(min=0, help="Of the links' draws alone; default: --seed.")] = None,
    losses: Annotated[str, typer.Option(help="Probabilities, separated by commas.")] = "0,0.1,0.3,0.5,0.8,0.9",
    delays: Annotated[str, typer.Option(help="Ticks, separated by commas.")] = "1,2,3,5",
    channels: Annotated[
        str, typer.Option(help="Of bursts, jitter, duplicates, one-way, fu: by commas.")
    ] = "bursts,jitter,duplicates,one-way,fu",
    methods: Methods = "",
    jobs: Jobs = 0,
    out: OutFolder = None,
    json_file: JsonFile = None,
) -> None:
    """The same with packets lost, late or doubled.

    Beside it stands what could be known.
    """
    from fleetloc.bench.links import CHANNELS
    from fleetloc.bench.links import loss as study
    from fleetloc.bench.methods import chosen, methods_with_genie
    from fleetloc.errors import InputError

    names = [name.strip() for name in channels.split(",") if name.strip()]
    if not set(names) <= set(CHANNELS):
        raise InputError("--channels", "", f"some of {', '.join(CHANNELS)}", channels)
    probabilities = _numbers("--losses", losses, 0.0, 0.99)
    ticks = _whole_numbers("--delays", delays, 0, 50)
    selected = chosen(methods_with_genie(), methods)
    folder = _prepare(out)
    results = study(
        runs=runs, seed=seed, losses=probabilities, delays_ticks=ticks, channels=names, methods=selected,
        jobs=_jobs(jobs), link_seed=link_seed, out=folder,
    )  # fmt: skip
    _write(results, folder, json_file)


def blind(
    runs: Runs = 20,
    seed: Seed = 0,
    methods: Methods = "dmhe_pre_ekf,dekf_ci_shared,dmhe_shared,centralized_iekf",
    jobs: Jobs = 0,
    json_file: JsonFile = None,
) -> None:
    """A drone without GPS in several graphs.

    Its error, its consistency, and whether it says that it is lost.
    """
    from fleetloc.bench.blind import blind as study
    from fleetloc.bench.methods import chosen, default_methods

    selected = chosen(default_methods(), methods)
    _prepare(None)
    _write(study(runs=runs, seed=seed, methods=selected, jobs=_jobs(jobs)), None, json_file)


def partition(
    runs: Runs = 20,
    seed: Seed = 0,
    length: Annotated[float, typer.Option(min=1.0, max=600.0, help="Of the partition, s.")] = 20.0,
    moving: Annotated[
        bool, typer.Option("--moving", help="Every 5 s to the next one's place; else they hover.")
    ] = False,
    keep_ranges: Annotated[
        bool, typer.Option("--keep-ranges", help="Packets are cut, ranges between the islands are not.")
    ] = False,
    loss: Annotated[float, typer.Option(min=0.0, max=0.99, help="Of all packets, with the cut and without.")] = 0.1,
    jobs: Jobs = 0,
    out: OutFolder = None,
    json_file: JsonFile = None,
) -> None:
    """A mesh of five falls apart into two and three, and heals.

    Are the islands consistent, and when do they agree again?
    """
    from estimators.settings import default_settings
    from fleetloc.bench.partition import PartitionPlan
    from fleetloc.bench.partition import partition as study

    turn_every_s = 5.0 if moving else None
    plan = PartitionPlan(
        default_settings(), seed, length_s=length, turn_every_s=turn_every_s, ranges_cut=not keep_ranges, loss=loss
    )
    folder = _prepare(out)
    _write(study(plan, runs=runs, jobs=_jobs(jobs), out=folder), folder, json_file)


def awareness(
    test: Annotated[
        str, typer.Option(metavar="LIST", help="1, 2, 3-under, 3-ahead, 4-under, 4-ahead; separated by commas.")
    ] = "1",
    graph: Annotated[Literal["cycle", "ladder", "chain"], typer.Option(help="Who hears whom.")] = "cycle",
    kinds: Annotated[
        str, typer.Option(metavar="LIST", help="Of estimators, separated by commas.")
    ] = "consensus_mhe,dmhe_shared",
    rounds: Annotated[
        str, typer.Option(metavar="LIST", help="Consensus rounds of a tick, separated by commas.")
    ] = "2,6,10",
    window: Annotated[int | None, typer.Option(min=1, max=64, help="Ticks; absent: the kind's own.")] = None,
    loss: Annotated[float, typer.Option(min=0.0, max=0.99, help="Of all packets.")] = 0.0,
    runs: Runs = 5,
    seed: Seed = 0,
    jobs: Jobs = 0,
    out: OutFolder = None,
    json_file: JsonFile = None,
) -> None:
    """Nine drones, a sparse graph and a target: who knows what.

    1: drone 1 hovers, the others fly. 2: two links fail for 30 s. 3 and 4: a fixed and a moving target.
    """
    from typing import get_args

    from estimators.settings import Kind
    from fleetloc.bench.awareness import SCENARIOS, AwarenessPlan
    from fleetloc.bench.awareness import awareness as study

    counts = _whole_numbers("--rounds", rounds, 0, 16)
    tests, chosen = _names("--test", test, tuple(SCENARIOS)), _names("--kinds", kinds, get_args(Kind))
    plans = [
        AwarenessPlan(each, graph, kind, count, window, loss, seed)
        for each in tests
        for kind in chosen
        for count in counts
    ]
    folder = _prepare(out)
    _write(study(plans, runs=runs, jobs=_jobs(jobs)), folder, json_file)


def faults(
    config: Annotated[Path, typer.Argument(help="Configuration (TOML) with its [sim].")],
    rows: Annotated[str, typer.Option(help="Names, separated by commas; empty: all.")] = "",
    rows_from: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Rows of your own (TOML) in place of those that come along.")
    ] = None,
    runs: Runs = 3,
    seed: Annotated[int, typer.Option(min=0, help="Of the first run; the next one has the next.")] = 1,
    jobs: Jobs = 0,
    overrides: Overrides = None,
    json_file: JsonFile = None,
) -> None:
    """Deceived receivers, blocked ranges, lying members.

    A fleet flies with each fault and, on the same seeds, without.
    """
    from fleetloc.bench.fault_rows import ROWS_FILE, chosen_rows, read_rows
    from fleetloc.bench.faults import faults as study
    from fleetloc.options import with_options
    from fleetloc.whole_config import load_whole

    fleet = load_whole(config, with_options([], overrides))
    selected = chosen_rows(read_rows(rows_from or ROWS_FILE), rows)
    _prepare(None)
    results = study(fleet, selected, runs=runs, seed=seed, jobs=_jobs(jobs))
    _write({"config": str(config), "runs": runs, "seed": seed, "rows": results}, None, json_file)


def scale(
    sizes: Annotated[
        str, typer.Option(metavar="LIST", help="Drones of the fleets, separated by commas.")
    ] = "10,20,50,100",
    whole: Annotated[
        str, typer.Option(metavar="LIST", help="Sizes flown with a joint state of the whole fleet too, by commas.")
    ] = "20",
    joint_bodies: Annotated[
        int, typer.Option(min=0, max=999, help="Most drones of a joint state; 0: the default of configurations.")
    ] = 0,
    runs: Runs = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of the first run; the next one has the next.")] = 1,
    duration: Annotated[float, typer.Option(min=6.0, max=600.0, help="Of a flight, s.")] = 15.0,
    settle: Annotated[float, typer.Option(min=2.0, max=60.0, help="Begin of a flight that is left out, s.")] = 5.0,
    degree: Annotated[float, typer.Option(min=2.0, max=30.0, help="Mean number of neighbours.")] = 6.0,
    timed: Annotated[int, typer.Option(min=1, max=100, help="Agents whose computing time is measured.")] = 4,
    jobs: Annotated[int, typer.Option(min=0, max=256, help="Processes at a time; 0: one per processor.")] = 1,
    json_file: JsonFile = None,
) -> None:
    """Fleets of up to a hundred drones: costs, knowledge.

    On random geometric graphs, in virtual time; beyond some size a drone's state is that of its neighbourhood.
    """
    from agent.config.tables import JOINT_BODIES
    from fleetloc.bench.scale import scale as study
    from fleetloc.bench.scale_flights import places_and_edges
    from fleetloc.errors import InputError

    if settle > duration - 2.0:  # far reports come once a second
        raise InputError("--settle", "", f"at most {duration - 2.0:g}, two seconds less than it flies", f"{settle:g}")
    counts, wholes = _whole_numbers("--sizes", sizes, 2, 999), _whole_numbers("--whole", whole, 2, 999)
    for size in {*counts, *wholes}:
        for run in range(seed, seed + runs):
            try:
                places_and_edges(size, degree, run)
            except ValueError as error:
                raise InputError("--degree", "", "one that gives a connected graph", str(error)) from None
    _prepare(None)
    results = study(
        sizes=counts, whole=wholes, joint_bodies=joint_bodies or JOINT_BODIES, runs=runs, seed=seed,
        duration_s=duration, settle_s=settle, degree=degree, timed=timed, jobs=_jobs(jobs),
    )  # fmt: skip
    _write(results, None, json_file)


def _prepare(out: Path | None) -> Path | None:
    """Compile what is missing once, before several processes would wait for each other; make the folder."""
    from fleetloc.errors import InputError
    from fleetloc.extras import is_installed, sentence
    from fleetloc.warmup import announce

    announce()
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError("--out", "", "a folder that can be written", f"{out} ({error.strerror})") from None
        if not is_installed("report"):
            typer.echo(f"note: {sentence('report', 'no plots are drawn')}", err=True)
    return out


def _jobs(jobs: int) -> int:
    from fleetloc.bench.sweep import default_jobs

    return jobs or default_jobs()


def _write(results: dict[str, Any], folder: Path | None, json_file: Path | None) -> None:
    from fleetloc.output import write_json

    if folder is not None:
        write_json(folder / "results.json", results)
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


def _names(option: str, text: str, known: tuple[str, ...]) -> list[str]:
    """A comma-separated list of known names; raises `InputError`."""
    from fleetloc.errors import InputError

    names = [part.strip() for part in text.split(",") if part.strip()]
    if not names or not set(names) <= set(known):
        raise InputError(option, "", f"of {', '.join(known)}, separated by commas", text)
    return names


def _whole_numbers(option: str, text: str, low: int, high: int) -> list[int]:
    """A comma-separated list of integers within bounds; raises `InputError`."""
    from fleetloc.errors import InputError

    values = _numbers(option, text, low, high)
    if any(value != int(value) for value in values):
        raise InputError(option, "", f"whole numbers from {low} to {high}, separated by commas", text)
    return [int(value) for value in values]


def real(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Holds tiers.pyfg and 20221011_processed.csv.")],
    odometry_sigma_m: Annotated[
        float, typer.Option("--odometry-sigma", min=1e-4, help="Of a step of odometry, m per axis.")
    ] = 0.005,
    range_sigma_factor: Annotated[
        float, typer.Option("--range-sigma-factor", min=0.1, help="On the file's sigma of ranges, which err alike.")
    ] = 2.0,
    json_file: JsonFile = None,
) -> None:
    """Recorded real robots: TIERS, odometry and one anchor.

    With the ranges as their authors calibrated them, and with the biases of the raw ones put back.
    """
    from fleetloc.bench.real import run_real
    from fleetloc.warmup import announce

    announce()
    run_real(folder, odometry_sigma_m, range_sigma_factor, json_file)


def speed(
    seed: Seed = 0,
    repeats: Annotated[int, typer.Option(min=1, help="Timed rounds over the windows, at most.")] = 30,
    windows: Annotated[int, typer.Option(min=1, max=64, help="Different windows per size.")] = 8,
    sizes: Annotated[str, typer.Option(help="AGENTSxWINDOW, separated by commas, or none.")] = "3x2,5x5,10x5,20x5",
    cases: Annotated[str, typer.Option(help="Of free, loose, active: separated by commas.")] = "free,loose,active",
    fleets: Annotated[str, typer.Option(help="DRONES[line|ring] of the whole step, or none.")] = "3,10,10ring",
    kinds: Annotated[str, typer.Option(help="Our estimators in it; ratios are to the first.")] = "dmhe_shared",
    ticks: Annotated[int, typer.Option(min=1, help="Timed ticks of its flights, at least.")] = 60,
    rounds: Annotated[int, typer.Option(min=1, help="Times that its flights are gone through.")] = 5,
    acados: Annotated[str | None, typer.Option(help="Python of an environment that has acados.")] = None,
    json_file: JsonFile = None,
) -> None:
    """Time of our step beside other solvers.

    The whole step beside gtsam's smoothers, our windows beside acados, IPOPT, SQP+OSQP, SLSQP and plain numpy.
    """
    from fleetloc.bench.speed.environment import use_one_thread

    use_one_thread()  # before numpy comes in
    from fleetloc.bench.speed.command import SpeedOptions, run_command

    run_command(SpeedOptions(json_file, seed, repeats, windows, sizes, cases, fleets, kinds, ticks, rounds, acados))
