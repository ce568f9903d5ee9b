"""``fleetloc survey``: anchors out of the fixed targets that a fleet found in a flight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fleetloc.options import FleetFile, Overrides, Profiles


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("survey")(survey)


def survey(
    config: FleetFile,
    directory: Annotated[Path, typer.Argument(help="Folder with the agents' records of a flight.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the [[anchors]] here; absent = the terminal.")
    ] = None,
    within_m: Annotated[
        float, typer.Option("--within", metavar="M", help="Leave out what is known worse (1-sigma).", min=0.0)
    ] = 0.3,
    profiles: Profiles = None,
    overrides: Overrides = None,
) -> None:
    """Write the fixed [[targets]] of a flight as [[anchors]].

    Put them into the configuration of the next flight in place of those targets. Exit codes: 0 all fixed targets are
    known well enough, 1 some are left out.
    """
    from agent.config.reading import load_config
    from fleetloc.errors import FAILED, InputError
    from fleetloc.report.surveyed_anchors import as_toml, surveyed

    fleet = load_config(config, overrides or (), profiles or ())
    fixed = [target.id for target in fleet.targets if target.motion == "fixed"]
    if not fixed:
        raise InputError(str(config), "targets", 'at least one with motion = "fixed"', "none")
    found, unread = surveyed(fleet, directory)
    for line in unread:
        typer.echo(f"warning: {line}", err=True)
    good = [each for each in found if each.total_sigma_m <= within_m]
    known = {each.id: each.total_sigma_m for each in found}
    left_out = [each for each in fixed if each not in {anchor.id for anchor in good}]
    for each in left_out:
        said = f"known to {known[each]:.2f} m, --within {within_m:g} m" if each in known else "not found"
        typer.echo(f"target {each}: {said}, left out", err=True)
    text = as_toml(good)
    if out is None:
        typer.echo(text, nl=False)
    else:
        out.write_text(text)
        typer.echo(f"{len(good)} anchors: {out}")
    if left_out:
        raise typer.Exit(FAILED)
