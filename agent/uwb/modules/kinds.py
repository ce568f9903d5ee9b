"""The kinds of modules that there are drivers for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from agent.uwb.modules import dwm1001, dwm3001, linktrack, uci
from agent.uwb.modules.reading import ModuleParser


@dataclass(frozen=True, slots=True)
class ModuleKind:
    """A protocol on a port of so many baud; ``usb_vendors`` of boards that may be spoken to unasked."""

    name: str
    parser: Callable[[], ModuleParser]
    baud: int
    usb_vendors: tuple[int, ...] = ()


SEGGER = 0x1366
"""The debug probe on DWM1001-DEV, which its shell is reached through."""
KINDS = {
    kind.name: kind
    for kind in (
        ModuleKind("linktrack", linktrack.LinkTrackParser, linktrack.BAUD),
        ModuleKind("uci", uci.UciParser, uci.BAUD),
        ModuleKind("dwm1001", dwm1001.Dwm1001Parser, dwm1001.BAUD, (SEGGER,)),
        ModuleKind("dwm3001-cli", dwm3001.Dwm3001Parser, dwm3001.BAUD),
    )
}
