"""``fleetloc uwb``: the driver of a drone's UWB module."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from fleetloc.common_options import Quiet, Verbose
from fleetloc.options import FleetFile

Kind = Literal["linktrack", "uci", "dwm1001", "dwm3001-cli"]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("uwb")(uwb)


def uwb(
    kind: Annotated[Kind, typer.Argument(metavar="KIND", help="linktrack, uci, dwm1001 or dwm3001-cli.")],
    device: Annotated[str, typer.Argument(metavar="DEVICE", help="Its serial port, or auto: whichever speaks so.")],
    config: FleetFile,
    agent_id: Annotated[int, typer.Option("--id", help="The drone that carries it.")],
    carried: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="MODULE=ID", help="A module whose id is not its drone's; may be repeated."),
    ] = None,
    sigma_m: Annotated[
        float | None,
        typer.Option("--sigma", metavar="M", help="1-sigma of its ranges; default: sensors.uwb_sigma_m."),
    ] = None,
    lag_s: Annotated[
        float, typer.Option("--lag", metavar="S", help="How much older a range is than it seems.")
    ] = 0.0,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Read a UWB module and give its ranges to the daemon.

    Runs beside the daemon of the same drone, until SIGTERM or SIGINT. The module may be plugged in and out. No kind
    has been tried on hardware yet (docs/uwb-modules.md).
    """
    import asyncio
    import math

    from agent.watch.log_lines import configure_logging
    from fleetloc.errors import InputError
    from fleetloc.run.uwb_driver import drive

    if sigma_m is not None and not 0.0 < sigma_m < math.inf:
        raise InputError("--sigma", "", "m above 0", f"{sigma_m:g}")
    if not abs(lag_s) <= 1.0:
        raise InputError("--lag", "", "s, at most 1 either way", f"{lag_s:g}")
    drone_of = dict(_carried(each, kind == "dwm1001") for each in carried or ())
    configure_logging(0 if quiet else 1 + verbose)
    asyncio.run(drive(config, agent_id, kind, device, drone_of=drone_of, sigma_m=sigma_m, lag_s=lag_s))


def _carried(text: str, always_hex: bool) -> tuple[int, int]:
    """``MODULE=ID``; a module as its vendor writes it: DWM1001 in hex, the others in decimal or as 0x0001."""
    from fleetloc.errors import InputError

    module, _, drone = text.partition("=")
    try:
        found = int(module, 16 if always_hex else 0), int(drone)
    except ValueError:
        found = -1, -1
    if min(found) < 0:
        form = "022E=2" if always_hex else "7=2 or 0x0007=2"
        raise InputError("--map", "", f"MODULE=ID such as {form}", repr(text))
    return found
