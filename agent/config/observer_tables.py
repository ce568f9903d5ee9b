"""The tables for those who look after a fleet: ``[metrics]``, ``[log]``, ``[adsb]`` and ``[monitor]``."""

from __future__ import annotations

from typing import Annotated

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Port = Annotated[int, msgspec.Meta(ge=1, le=65_535)]


class MetricsTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[metrics]``: a daemon's figures for Prometheus, at ``http://HOST:PORT/metrics``; no password."""

    base_port: Port | None = None
    """Agent number i (from 0, in order of the file) answers at this port + i; absent = nobody does."""
    host: str = "127.0.0.1"
    """Address to listen on; another one than loopback shows the figures to whoever reaches it."""


class LogTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[log]``: a daemon's log in files, besides stderr."""

    directory: str | None = None
    """Folder for ``agent_001.log`` and so on, relative to the working folder; absent = stderr only."""
    max_mb: Positive = 10.0
    """A file that has grown to this is put aside as ``.1``, what was ``.1`` as ``.2``."""
    keep: Annotated[int, msgspec.Meta(ge=1, le=100)] = 5
    """Files put aside that are kept."""
    min_free_mb: NotNegative = 100.0
    """With less left on the disk, files put aside are deleted, the oldest first, and then no more is written."""


class AdsbTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[adsb]``: the neighbours as traffic (ADSB_VEHICLE) on the map of a ground station."""

    address: str | None = None
    """MAVLink address of the ground station or of a router before it, e.g. ``udpout:192.168.7.1:14550``; absent =
    nothing is sent. Never an autopilot's: it would evade its own fleet."""
    period_s: Annotated[float, msgspec.Meta(ge=0.2, le=10)] = 1.0
    """Each neighbour is sent this often."""
    max_sigma_m: Positive = 20.0
    """A neighbour that is known no better than this (largest axis, 1-sigma) is not shown."""


class MonitorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[monitor]``: what `fleetloc monitor` shows, and where; no daemon reads it."""

    host: str = "127.0.0.1"
    """Address of the web page; it has no password."""
    port: Annotated[int, msgspec.Meta(ge=0, le=65_535)] = 8470
    """0 = any free one."""
    refresh_s: Annotated[float, msgspec.Meta(ge=0.05, le=2)] = 0.2
    """The picture is renewed this often."""
    stale_after_s: Positive = 1.0
    """An estimate older than this (or than three periods) is shown as stale."""
    lost_after_s: Positive = 2.0
    """A drone silent for longer than this (or than six periods) is shown as lost; one that left, at once."""
    track_s: NotNegative = 60.0
    """Length of the tracks on the map."""
