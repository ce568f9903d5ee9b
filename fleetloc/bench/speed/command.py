"""The command ``fleetloc bench speed``: options in, tables and JSON out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, get_args

from rich.console import Console

from estimators.settings import Kind
from fleetloc.bench.speed.bounds import CASES
from fleetloc.bench.speed.fleet import report as fleet_report
from fleetloc.bench.speed.fleet.flight import parse_fleet
from fleetloc.bench.speed.fleet.study import FleetPlan, run_fleets
from fleetloc.bench.speed.joint import report as joint_report
from fleetloc.bench.speed.joint.study import JointPlan, run_joint
from fleetloc.bench.speed.peers_casadi import require_casadi
from fleetloc.bench.speed.report import as_document, show
from fleetloc.bench.speed.study import SpeedPlan, run_speed
from fleetloc.bench.speed.windows import parse_size
from fleetloc.errors import InputError
from fleetloc.output import write_json
from fleetloc.warmup import announce

TABLE_WIDTH = 120
NOTHING = "none"
"""What stands for an empty list on the command line."""

Known = TypeVar("Known", bound=str)


@dataclass(frozen=True, slots=True)
class SpeedOptions:
    """The options as they were typed; lists are separated by commas."""

    json: Path | None
    seed: int
    repeats: int
    windows: int
    sizes: str
    cases: str
    fleets: str
    kinds: str
    ticks: int
    rounds: int
    acados: str | None


def run_command(options: SpeedOptions) -> None:
    """Check the options, run the studies, show them; raises `InputError` and `EnvironmentFault`."""
    plan, fleet_plan, joint_plan = _plans(options)
    if options.json is not None and options.json.is_dir():
        raise InputError("--json", "", "a file", f"the folder {options.json}")
    if plan.sizes or joint_plan.fleets:
        require_casadi()
    announce()
    errors = Console(stderr=True, highlight=False)
    with errors.status("starting") as status:
        fleets = run_fleets(fleet_plan, status.update)
        joint = run_joint(joint_plan, status.update)
        results = run_speed(plan, status.update)
    console = Console()
    console.width = max(console.width, TABLE_WIDTH)
    fleet_report.show(console, fleets)
    joint_report.show(console, joint)
    show(console, results)
    if options.json is not None:
        write_json(options.json, as_document(plan, results, fleet_plan, fleets, joint))


def _plans(options: SpeedOptions) -> tuple[SpeedPlan, FleetPlan, JointPlan]:
    plan = SpeedPlan(
        seed=options.seed,
        repeats=options.repeats,
        windows=options.windows,
        sizes=tuple(parse_size(size) for size in _listed(options.sizes)),
        cases=tuple(_one_of("--cases", CASES, name) for name in options.cases.split(",")),
    )
    kinds: tuple[Kind, ...] = get_args(Kind)
    fleet_plan = FleetPlan(
        seed=options.seed,
        fleets=tuple(parse_fleet(text) for text in _listed(options.fleets)),
        kinds=tuple(_one_of("--kinds", kinds, name) for name in options.kinds.split(",")),
        ticks=options.ticks,
        rounds=options.rounds,
    )
    joint_plan = JointPlan(
        seed=options.seed,
        fleets=fleet_plan.fleets,
        windows=options.windows,
        repeats=options.repeats,
        acados=options.acados,
    )
    return plan, fleet_plan, joint_plan


def _listed(text: str) -> list[str]:
    return [] if text == NOTHING else text.split(",")


def _one_of(option: str, known: Sequence[Known], name: str) -> Known:
    for each in known:
        if name == each:
            return each
    raise InputError(option, "", " or ".join(known), repr(name))
