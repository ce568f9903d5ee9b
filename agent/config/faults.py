"""What is wrong with a setting, and how its key is spelled for people: drones by their id, not by their place."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from agent.config.toml_lines import KeyPath

STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
BODIES = {"agents": "agent", "anchors": "anchor", "targets": "target"}
"""Arrays whose tables are bodies, and what one is called."""
NAMED_BY = ("id", "agent")
"""Keys that tell the tables of an array apart."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A setting that cannot be used: its key (``agents[0].mavlink``), what was expected and what was found.

    ``meant``: what was probably meant; ``says`` stands in place of expected and found where they do not fit.
    """

    key: str
    expected: str
    found: str
    meant: str = ""
    says: str = ""


def steps_of(key: str) -> KeyPath:
    """``sim.paths[0].points_m[1]`` as keys and indices."""
    return tuple(int(index) if index else name for name, index in STEP.findall(key))


def named_steps(tables: Any, steps: Sequence[str | int]) -> KeyPath:
    """The same path with ``"#5"`` in place of an index wherever the tables of an array have an id or agent each."""
    named: list[str | int] = []
    value = tables
    for step in steps:
        named.append(_name_in(value, step) if isinstance(step, int) else step)
        try:
            value = value[step]
        except (KeyError, IndexError, TypeError):
            value = None
    return tuple(named)


def shown(tables: Any, key: str) -> str:
    """A key for people: ``agents[2].radio`` is ``agent 5, radio`` where the third agent has the id 5."""
    text = ""
    for step in named_steps(tables, steps_of(key)):
        if isinstance(step, int):
            text += f", entry {step + 1}"
        elif step.startswith("#"):
            text = f"{BODIES[text]} {step[1:]}" if text in BODIES else f"{text} of agent {step[1:]}"
        else:
            separator = ", " if re.search(r"(agent|anchor|target|entry) \d+$", text) else "."
            text += f"{separator}{step}" if text else step
    return text


def probably(name: str, known: Iterable[str]) -> str:
    """The known name that is nearest to one that is not known; empty where none is near."""
    return next(iter(difflib.get_close_matches(name, [str(each) for each in known], n=1)), "")


def one_of(values: Iterable[Any]) -> str:
    """``one of a, b, c``."""
    return f"one of {', '.join(map(str, values))}"


def _name_in(array: Any, index: int) -> str | int:
    if not isinstance(array, list | tuple) or not 0 <= index < len(array):
        return index
    for key in NAMED_BY:
        names = [table.get(key) if isinstance(table, dict) else None for table in array]
        if _is_id(names[index]) and names.count(names[index]) == 1:
            return f"#{names[index]}"
    return index


def _is_id(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
