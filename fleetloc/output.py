"""What all commands share: progress bars and tables for people, JSON for machines."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from fleetloc.verbosity import stderr_console


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar on stderr while the block runs; gives the function that advances it by one.

    Where stderr is no terminal, a line for every tenth instead; with --quiet nothing.
    """
    console = stderr_console()
    if not console.is_terminal:
        yield _lines(console, what, total)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


def _lines(console: Console, what: str, total: int) -> Callable[[], None]:
    done, told = 0, 0

    def advance() -> None:
        nonlocal done, told
        done += 1
        tenth = 10 * done // max(total, 1)
        if tenth > told and done <= total:
            told = tenth
            console.print(f"fleetloc: {what}: {done} of {total}", markup=False, soft_wrap=True)

    return advance


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> None:
    """A table on stdout; the first column left, the others right."""
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right")
    for row in rows:
        table.add_row(*row)
    # rich takes 80 columns where there is no terminal, and would cut the headings
    console = Console() if sys.stdout.isatty() else Console(width=160)
    console.print(table)


def with_error(value: float, error: float, digits: int = 3) -> str:
    """``0.301 ± 0.013``; without the error where there is none."""
    return f"{value:.{digits}f}" if math.isnan(error) else f"{value:.{digits}f} ± {error:.{digits}f}"


def write_json(path: Path, content: Any) -> None:
    """Write machine-readable results, ``-`` to stdout; what is not a number becomes null, as JSON has no NaN."""
    if str(path) == "-":
        sys.stdout.write(json.dumps(_finite(content), indent=2) + "\n")
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_finite(content), indent=2) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
