"""The commands of this folder, as the command line has them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fleetloc.options import Overrides


def setmembership(
    runs: Annotated[int, typer.Option(min=1, help="Flights, the same for all filters.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the results to this file.")] = None,
) -> None:
    """Guaranteed sets of relative positions.

    On the half circle of Bolting and Fergani 2018, beside a Kalman filter.
    """
    from fleetloc.bench.integrity.set_membership import set_membership
    from fleetloc.output import write_json
    from fleetloc.warmup import announce

    announce()
    results = set_membership(runs=runs, seed=seed)
    if json_file is not None:
        write_json(json_file, results)


def integrity(
    config: Annotated[Path, typer.Argument(help="Configuration (TOML) with its [sim].")],
    rows: Annotated[str, typer.Option(help="Names of rows of `bench faults`, by commas; empty: all.")] = "",
    rows_from: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Rows of your own (TOML) in place of those that come along.")
    ] = None,
    sizes: Annotated[str, typer.Option(metavar="LIST", help="Drones: the first of the file; empty: all.")] = "",
    clean: Annotated[float, typer.Option(min=20.0, help="Length of a flight without a fault, s.")] = 60.0,
    runs: Annotated[int, typer.Option(min=1, help="Flights of each row and size.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Of the first run; the next one has the next.")] = 1,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Processes at a time.")] = 1,
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for plots, results.json, and flights, which are not flown again.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the results to this file.")] = None,
) -> None:
    """What protection levels and alerts are worth.

    Under the faults of `bench faults`: misleading epochs, times to detect and name, false alarms.
    """
    from fleetloc.bench.fault_rows import ROWS_FILE, chosen_rows, read_rows
    from fleetloc.bench.integrity.stanford import stanford
    from fleetloc.bench.integrity.study import SETTLED_S, cases
    from fleetloc.bench.integrity.study import integrity as study
    from fleetloc.bench.plots import save
    from fleetloc.errors import InputError
    from fleetloc.options import with_options
    from fleetloc.output import write_json
    from fleetloc.warmup import announce
    from fleetloc.whole_config import load_whole

    fleet = load_whole(config, with_options([], overrides))
    selected = chosen_rows(read_rows(rows_from or ROWS_FILE), rows)
    try:
        counts = [int(each) for each in sizes.split(",")] if sizes else [len(fleet.ids)]
    except ValueError:
        raise InputError("--sizes", "", "numbers, separated by commas", sizes) from None
    flown = cases(fleet, selected, counts, clean)
    announce()
    results, promises = study(flown, runs=runs, seed=seed, jobs=jobs, folder=out)
    found = {"config": str(config), "runs": runs, "seed": seed, "rows": results}
    limits_m = fleet.integrity.alert_horizontal_m, fleet.integrity.alert_vertical_m
    if out is not None:
        write_json(out / "results.json", found)
        for count in counts:
            of_all = zip(flown, promises, strict=True)
            made = [each for case, group in of_all if len(case.config.ids) == count for each in group]
            save(stanford(made, limits_m, round(SETTLED_S / fleet.fleet.period_s)), out, f"stanford_{count}")
    if json_file is not None:
        write_json(json_file, found)
