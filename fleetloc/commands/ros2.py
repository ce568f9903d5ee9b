"""``fleetloc ros2``: the drones' odometry for ROS 2 over rmw_zenoh, without ROS; checked for bytes only."""

from __future__ import annotations

from typing import Annotated

import typer

from fleetloc.options import FleetFile, Overrides, Profiles


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("ros2")(ros2)


def ros2(
    config: FleetFile,
    profiles: Profiles = None,
    overrides: Overrides = None,
    connect: Annotated[
        list[str] | None, typer.Option("--connect", help="Endpoint of the fleet to dial, not those of the file.")
    ] = None,
    router: Annotated[str, typer.Option("--router", help="Where rmw_zenohd listens.")] = "tcp/127.0.0.1:7447",
    domain: Annotated[int, typer.Option("--domain", help="ROS_DOMAIN_ID.")] = 0,
    namespace: Annotated[str, typer.Option("--namespace", help="Of a drone; {id} for its id.")] = "uav{id}",
    frame: Annotated[str, typer.Option("--frame", help="Name of the fleet's frame, east-north-up.")] = "map",
    duration_s: Annotated[float | None, typer.Option("--duration", help="End after so many seconds.")] = None,
) -> None:
    """Publish every drone's estimate to ROS 2, until Ctrl-C.

    It goes to a Zenoh router of ROS 2 (rmw_zenoh) as nav_msgs/Odometry. The command listens to the fleet as a monitor
    does. Checked for bytes only, not against a running ROS graph.
    """
    import asyncio

    from agent.config.reading import load_config
    from fleetloc.errors import InputError
    from fleetloc.ros2.bridge import Ros2Settings, run

    if duration_s is not None and not duration_s > 0:
        raise InputError("--duration", "", "seconds greater than 0", f"{duration_s:g}")
    settings = Ros2Settings(router, domain, namespace, frame)
    fleet = load_config(config, list(overrides or ()), profiles or ())
    say = typer.echo
    asyncio.run(
        run(fleet, config.parent, settings, endpoints=connect or (), duration_s=duration_s, say=say)
    )
