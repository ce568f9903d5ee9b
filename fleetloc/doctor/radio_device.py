"""Whether the device of the fleet's radio is there, and patient enough with hardware addresses for a lossy radio.

Before it sends anything the kernel asks for the receiver's hardware address. Where all its questions are lost,
nothing is sent to that neighbour for seconds, and no daemon can help (docs/links.md).
"""

from __future__ import annotations

import fcntl
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

from agent.config.tables import FleetConfig
from fleetloc.doctor.examination import Examined, Mark

QUESTIONS_WANTED = 10
"""Of ten questions all are lost once in 800 times at 30 % loss each way; of three once in eight."""
SETTINGS = Path("/proc/sys/net/ipv4/neigh")
SOLICIT = ("ucast_solicit", "mcast_solicit")
GET_ADDRESS, REQUEST_BYTES, ADDRESS_AT = 0x8915, 256, slice(20, 24)
"""Linux's SIOCGIFADDR and its structure."""


def of_radio(config: FleetConfig, agent_id: int, settings: Path = SETTINGS) -> list[Examined]:
    """One line, or none for a drone without an address on the radio and on systems that do not tell.

    ``settings`` is the kernel's folder of neighbour settings, a folder for each device.
    """
    radio = config.agent(agent_id).radio
    if radio is None or not settings.is_dir():
        return []
    device = device_of(radio)
    if device is None:
        to_do = "is the radio up, and `agents.radio` the address of this drone?"
        return [Examined(Mark.WRONG, "radio", f"no device of this machine has {radio}", to_do)]
    few = [kind for kind in SOLICIT if _number(settings / device / kind) < QUESTIONS_WANTED]
    if config.transport.link == "tcp" or not few:
        return [Examined(Mark.GOOD, "radio", f"{radio} is {device}")]
    wanted = " ".join(f"net.ipv4.neigh.{device}.{kind}={QUESTIONS_WANTED}" for kind in few)
    found = f"{radio} is {device}, which soon gives up asking for hardware addresses"
    return [Examined(Mark.UNWISE, "radio", found, f"if it loses frames: sysctl -w {wanted}")]


def device_of(host: str) -> str | None:
    """The network device that has the IPv4 address of ``host``; ``None`` = none of this machine."""
    try:
        wanted = socket.gethostbyname(host)
    except OSError:
        return None
    return next((name for name, address in _devices() if address == wanted), None)


def _devices() -> Iterator[tuple[str, str]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            request = struct.pack(f"{REQUEST_BYTES}s", name.encode())
            try:
                answer = fcntl.ioctl(asked.fileno(), GET_ADDRESS, request)
            except OSError:  # a device without an address
                continue
            yield name, socket.inet_ntoa(answer[ADDRESS_AT])


def _number(file: Path) -> int:
    """What a setting is; a device without it needs none."""
    try:
        return int(file.read_text())
    except (OSError, ValueError):
        return QUESTIONS_WANTED
