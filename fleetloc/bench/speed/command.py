"""The command ``fleetloc bench speed``: options in, tables and JSON out."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from fleetloc.bench.speed.bounds import CASES, CaseName
from fleetloc.bench.speed.peers_casadi import require_casadi
from fleetloc.bench.speed.report import as_document, show
from fleetloc.bench.speed.study import SpeedPlan, run_speed
from fleetloc.bench.speed.windows import parse_size
from fleetloc.errors import InputError
from fleetloc.output import write_json
from fleetloc.warmup import announce

TABLE_WIDTH = 120


def run_command(json: Path | None, seed: int, repeats: int, windows: int, sizes: str, cases: str) -> None:
    """Check the options, run the study, show it; raises `InputError` and `EnvironmentFault`."""
    plan = SpeedPlan(
        seed=seed,
        repeats=repeats,
        windows=windows,
        sizes=tuple(parse_size(size) for size in sizes.split(",")),
        cases=tuple(_parse_case(name) for name in cases.split(",")),
    )
    if json is not None and json.is_dir():
        raise InputError("--json", "", "a file", f"the folder {json}")
    require_casadi()
    announce()
    errors = Console(stderr=True, highlight=False)
    with errors.status("starting") as status:
        results = run_speed(plan, status.update)
    console = Console()
    console.width = max(console.width, TABLE_WIDTH)
    show(console, results)
    if json is not None:
        write_json(json, as_document(plan, results))


def _parse_case(name: str) -> CaseName:
    for known in CASES:
        if name == known:
            return known
    raise InputError("--cases", "", " or ".join(CASES), repr(name))
