"""How much a command says on stderr: -q nothing but what is wrong, -v more, -vv all. Imports nothing heavy."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


class _Verbosity:
    """Of this process, which runs one command."""

    level = 0


def set_verbosity(level: int) -> None:
    """-1 quiet, 0 as usual, 1 and more: the log of the daemon's parts too."""
    _Verbosity.level = level
    if level > 0:
        from agent.watch.log_lines import configure_logging

        configure_logging(level)


def is_quiet() -> bool:
    """Whether only what is wrong is to be said."""
    return _Verbosity.level < 0


def stderr_console() -> Console:
    """Where progress goes: stderr, or nowhere."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, quiet=is_quiet())
