"""``fleetloc init``: a first configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fleetloc.first.configuration import Autopilot, Module, NewFleet, RadioKind, as_toml, next_steps


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("init")(init)


def init(
    file: Annotated[Path, typer.Argument(help="The file to write; it must not be there yet.")] = Path("fleet.toml"),
    *,
    origin: Annotated[
        str, typer.Option(metavar="LAT,LON,ALT", help="A point in the middle of your field: deg, deg, m above sea.")
    ],
    drones: Annotated[int, typer.Option(help="How many drones there are.", min=1, max=999)] = 3,
    name: Annotated[str, typer.Option(metavar="NAME", help="The fleet's name.")] = "myfleet",
    autopilot: Annotated[Autopilot, typer.Option(help="px4, ardupilot, or auto: as its heartbeat says.")] = "auto",
    link: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="Address of each autopilot; {id} is the drone's id, {port} is 14550 more. "
            "On a drone e.g. serial:/dev/autopilot{id}:921600.",
        ),
    ] = "udpin:127.0.0.1:{port}",
    uwb: Annotated[
        Module, typer.Option(help="UWB modules: none, linktrack, uci, dwm1001 or dwm3001-cli.")
    ] = "none",
    radio: Annotated[
        RadioKind, typer.Option(help="The radio: wired (cable, or as good), mixed or lossy_radio.")
    ] = "wired",
    address: Annotated[
        str | None,
        typer.Option(metavar="HOST", help="Each drone's on the radio, e.g. 192.168.7.{id}; without: all are here."),
    ] = None,
    feedback: Annotated[
        bool, typer.Option("--feedback", help="Give the autopilots the estimate when GPS is lost.")
    ] = False,
) -> None:
    """Write a first configuration of a fleet.

    `fleetloc check` passes it, and it is a beginning: open it in an editor. An existing file is never changed.
    """
    import time
    import tomllib

    from agent.config.documents import Document
    from fleetloc.config_check import check_document
    from fleetloc.errors import InputError

    if file.exists():
        raise InputError(str(file), "", "a file that is not there yet", "one")
    lat_deg, lon_deg, alt_m = _place(origin)
    fleet = NewFleet(
        name=name,
        drones=drones,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_m=alt_m,
        autopilot=autopilot,
        link=link,
        uwb=uwb,
        radio=radio,
        address=address,
        feedback=feedback,
    )
    text = as_toml(fleet, file.name)
    checked = check_document(Document(tomllib.loads(text), str(file)), file.parent, None, unix_s=time.time())
    if checked.mistakes:
        raise checked.mistakes[0]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    typer.echo(f"{file}: {drones} drone{'s' if drones > 1 else ''}. Next:")
    for step in next_steps(fleet, str(file)):
        typer.echo(f"  {step}")


def _place(text: str) -> tuple[float, float, float]:
    from fleetloc.errors import InputError

    try:
        lat_deg, lon_deg, alt_m = (float(each) for each in text.split(","))
    except ValueError:
        expected = "latitude and longitude in deg and height in m, e.g. 47.3977,8.5456,488"
        raise InputError("--origin", "", expected, repr(text)) from None
    return lat_deg, lon_deg, alt_m
