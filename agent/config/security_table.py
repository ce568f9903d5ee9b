"""The ``[security]`` table: which profile, and where its keys are; `agent.security` says what a profile promises."""

from __future__ import annotations

from typing import Literal

from agent.config.fields import Positive, Table

Profile = Literal["lab", "field", "lossy_field"]


class SecurityTable(Table, frozen=True):
    """``[security]``: how the fleet is protected; docs/security.md says against whom."""

    profile: Profile = "lab"
    """``lab``: plain links, packets signed unless ``mode`` says otherwise. ``field``: mutual TLS, access control,
    signed packets, MAVLink signed where it leaves the machine. ``lossy_field``: the same without TLS, for links that
    lose much; UWB frames have to be sealed. A field profile does not start while anything that it promises is
    missing."""
    mode: Literal["signed", "unsigned"] = "signed"
    """Signatures of packets. Unsigned is for the lab and has to be asked for."""
    encrypt: bool = False
    """Encrypt packets with the fleet's group key; for links without TLS."""
    keys: str = "keys"
    """Folder of the key files, relative to the configuration file."""
    state: str | None = None
    """Folder for what must outlive a restart (start numbers, MAVLink stamps), relative to the configuration file;
    absent = the key folder, which the daemon then writes to. Made where only itself is missing."""
    freshness_s: Positive = 10.0
    """Packets whose sender's UTC clock differs by more are refused, which also stops replays after a restart."""
