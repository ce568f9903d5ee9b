"""Tables of a fleet's file that other rooms read: the simulator's, the SITL bridge's and the monitor's.

The agent knows their names only. It carries them along as they were written, so that a run's effective configuration
is whole, and refuses nothing in them; who reads one checks it (`agent.config.reading.other_table`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

READ_BY_OTHERS = ("sim", "sitl", "monitor")


@dataclass(frozen=True, slots=True)
class OtherTables:
    """The tables by name, as plain values; ``where`` they are from and which of their keys were overridden."""

    tables: Mapping[str, Any] = field(default_factory=dict)
    where: str = field(default="configuration", compare=False)
    overridden: frozenset[str] = field(default=frozenset(), compare=False)
