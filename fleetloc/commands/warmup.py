"""``fleetloc warmup``: compile ahead of time, e.g. while a container image is built."""

from __future__ import annotations

import typer


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("warmup")(warmup)


def warmup() -> None:
    """Compile the numerical kernels, so that no later start has to.

    The cache is FLEETLOC_CACHE (default: fleetloc in the user's cache folder); FLEETLOC_CPU says for which
    processor (default generic: any of this architecture).
    """
    from estimators.compiled.cache import cache_folder
    from fleetloc.warmup import warm_up_everything

    count = warm_up_everything()
    typer.echo(f"{count} kernels ready in {cache_folder()}")
