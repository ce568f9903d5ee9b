"""The tables for those who look after a fleet: ``[metrics]``, ``[log]`` and ``[adsb]``."""

from __future__ import annotations

from agent.config.fields import Port, Table


class MetricsTable(Table, frozen=True):
    """``[metrics]``: a daemon's figures for Prometheus, at ``http://HOST:PORT/metrics``; no password."""

    base_port: Port | None = None
    """Agent number i (from 0, in order of the file) answers at this port + i; absent = nobody does."""
    host: str = "127.0.0.1"
    """Address to listen on; another one than loopback shows the figures to whoever reaches it."""


class LogTable(Table, frozen=True):
    """``[log]``: a daemon's log in files, besides stderr."""

    directory: str | None = None
    """Folder for ``agent_001.log`` and so on, relative to the working folder; absent = stderr only."""


class AdsbTable(Table, frozen=True):
    """``[adsb]``: the neighbours as traffic (ADSB_VEHICLE) on the map of a ground station."""

    address: str | None = None
    """MAVLink address of the ground station or of a router before it, e.g. ``udpout:192.168.7.1:14550``; absent =
    nothing is sent. Never an autopilot's: it would evade its own fleet."""
