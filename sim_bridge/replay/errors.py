"""What the replay raises on purpose."""

from __future__ import annotations


class ReplayError(ValueError):
    """Logs, ranges, truth or options that do not fit together; the message is one line a user can act on."""

    def __init__(self, where: object, expected: str, found: str) -> None:
        super().__init__(f"{where}: expected {expected}, found {found}")
