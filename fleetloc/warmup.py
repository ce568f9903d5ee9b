"""Tells people on stderr that kernels are being compiled, which happens once per machine and version."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.status import Status

from estimators.compiled import entries as compiled
from estimators.compiled.cache import cache_folder
from fleetloc.verbosity import stderr_console


class Announcer:
    """Listener for `estimators.compiled.entries`: a live line on a terminal, plain lines in a log.

    Silent as long as everything comes from the cache.
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = stderr_console() if console is None else console
        self._status: Status | None = None
        self._said: set[str] = set()

    def __call__(self, progress: compiled.Progress) -> None:
        """Show one piece of progress."""
        if progress.what in ("waiting", "warning"):
            self._once(f"{progress.what}: {progress.detail}")
        elif progress.what == "compiling":
            self._once(f"compiling kernels into {cache_folder()} (once per machine and version)")
            self._show(progress, progress.name)
        elif progress.what == "inner":
            self._show(progress, progress.name)
        elif progress.what == "compiled" and self._status is not None:
            self._status.stop()
            self._status = None

    def _once(self, sentence: str) -> None:
        if sentence not in self._said:
            self._said.add(sentence)
            self._console.print(f"fleetloc: {escape(sentence)}", soft_wrap=True)

    def _show(self, progress: compiled.Progress, name: str) -> None:
        line = escape(f"[{progress.done + 1}/{progress.total}] {name}")
        if not self._console.is_terminal:
            if progress.what == "compiling":
                self._console.print(f"fleetloc: compiling {line}", soft_wrap=True)
        elif self._status is None:
            self._status = self._console.status(f"compiling {line}")
            self._status.start()
        else:
            self._status.update(f"compiling {line}")


def announce() -> None:
    """From now on tell on stderr when a first call compiles. Commands that estimate call this first."""
    compiled.on_progress(Announcer())


def warm_up_everything() -> int:
    """Compile or load every kernel of the project, told on stderr; returns their number."""
    compiled.import_all()
    return compiled.warm_up(Announcer())
