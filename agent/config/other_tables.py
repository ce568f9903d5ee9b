"""Tables of a fleet's file that other rooms read: the simulator's, the SITL bridge's and the monitor's.

The agent knows their names only. It carries them along as they were written, so that a run's effective configuration
is whole, and refuses nothing in them; who reads one checks it (`agent.config.reading.OtherTable`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from agent.config.documents import Document

READ_BY_OTHERS = ("sim", "sitl", "monitor")


@dataclass(frozen=True, slots=True)
class OtherTables:
    """The tables by name, as plain values, and the document that they are from."""

    tables: dict[str, Any] = field(default_factory=dict)
    document: Document = field(default_factory=lambda: Document({}, "configuration"), compare=False)
