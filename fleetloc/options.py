"""Arguments and options that several commands have, said once. Imports nothing heavy: it is read at every start."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from agent.config.documents import Override

FleetFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration of the fleet (TOML).")]
Profiles = Annotated[
    list[Path] | None,
    typer.Option("--with", metavar="FILE", help="TOML laid over it, e.g. a link profile; may be repeated."),
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Beats the file; may be repeated.")
]
Loss = Annotated[float | None, typer.Option("--loss", metavar="SHARE", help="Packets that are lost, 0..1.")]
Delay = Annotated[float | None, typer.Option("--delay", metavar="S", help="Delay of every packet, s.")]
Require = Annotated[
    str | None,
    typer.Option(
        "--require",
        metavar="LIMITS",
        help="Exit 1 unless the fleet keeps these: availability=0.99,rmse=0.5; also on_time, rmse_after_10s, "
        "fleet_error, anees.",
    ),
]
FiguresFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write the figures here too; - is the terminal.")
]


def with_options(given: Iterable[tuple[str, str, object]], overrides: Iterable[str] | None) -> list[Override]:
    """Settings that options give, each ``(--option, key, value or None)``, and those of ``--set``, which beat them.

    What is wrong with one is told of the option that was typed.
    """
    from agent.config.documents import Given

    return [*(Given(*each) for each in given if each[2] is not None), *(overrides or ())]
