"""Arguments and options that several commands have, said once. Imports nothing heavy: it is read at every start."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

FleetFile = Annotated[Path, typer.Argument(help="Configuration of the fleet (TOML).")]
Profiles = Annotated[
    list[Path] | None, typer.Option("--with", help="TOML laid over it, e.g. a link profile; may be repeated.")
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="KEY=VALUE, beats the file; may be repeated.")
]
Loss = Annotated[float | None, typer.Option("--loss", help="Probability that a packet is lost, 0..1.")]
Delay = Annotated[float | None, typer.Option("--delay", help="Delay of every packet in s.")]
FiguresFile = Annotated[Path | None, typer.Option("--json", help="Write the figures here too.")]
