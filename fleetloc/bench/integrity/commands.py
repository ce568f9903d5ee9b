"""The commands of this folder, as the command line has them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


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
