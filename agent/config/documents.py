"""A configuration before it is understood: the tables of one or several TOML files with overrides laid over them.

It knows where each key was written, so that whatever is wrong is said of a line in a file, or of the option that was
typed.
"""

from __future__ import annotations

import copy
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from agent.config.faults import Fault, named_steps, shown, steps_of
from agent.config.structs import abbreviated
from agent.config.toml_lines import KeyPath, key_lines
from agent.errors import ConfigError

MAX_FILE_BYTES = 1_000_000
SET = "--set"


class Given(NamedTuple):
    """A setting that the command line gives; ``option`` is the one that was typed."""

    option: str
    key: str
    value: Any


Override = str | Given
"""``key=value`` of ``--set``, or another option's."""


@dataclass(frozen=True, slots=True)
class Source:
    """A file (its keys' lines), or an option (no lines)."""

    name: str
    lines: Mapping[KeyPath, int | None]

    @property
    def is_option(self) -> bool:
        return self.name.startswith("--")

    def longest(self, *spellings: KeyPath) -> tuple[int, int | None]:
        """How many steps of a path are written here, and the line of that; 0 for none."""
        for length in range(len(spellings[0]), 0, -1):
            for path in spellings:
                if path[:length] in self.lines:
                    return length, self.lines[path[:length]]
        return 0, None

    def has_inside(self, steps: KeyPath) -> bool:
        """Whether something in a table is written here."""
        return any(path[: len(steps)] == steps for path in self.lines)


@dataclass(frozen=True, slots=True)
class Document:
    """Tables as plain values; ``where`` names the file, ``sources`` say where keys were written, the last win."""

    tables: dict[str, Any]
    where: str
    sources: tuple[Source, ...] = ()

    def laid_over(self, above: Document) -> Document:
        """With another one's keys laid over: tables merged, arrays of tables with an ``id`` by that."""
        return Document(merged(self.tables, above.tables), self.where, self.sources + above.sources)

    def overridden(self, overrides: Iterable[Override]) -> Document:
        """With ``key=value`` settings put in; raises `ConfigError` for one that is none or fits nowhere."""
        document = replace(self, tables=copy.deepcopy(self.tables))
        for override in overrides:
            given = override if isinstance(override, Given) else _parsed(override)
            key = _put(document.tables, given)
            steps = steps_of(key)
            lines = dict.fromkeys((steps, named_steps(self.tables, steps)))
            document = replace(document, sources=(*document.sources, Source(given.option, lines)))
        return document

    def with_table(self, name: str, table: dict[str, Any]) -> Document:
        """With one table in place of what was there."""
        return replace(self, tables={**self.tables, name: table})

    def without(self, keys: Iterable[str]) -> Document:
        """Without some keys; of a value in an array, without that."""
        tables = copy.deepcopy(self.tables)
        for key in keys:
            place: Any = tables
            table, last = tables, ""
            for step in steps_of(key):
                if isinstance(place, dict):
                    table, last = place, str(step)
                place = place.get(step) if isinstance(place, dict) else _element(place, step)
            table.pop(last, None)
        return replace(self, tables=tables)

    def error(self, fault: Fault) -> ConfigError:
        """What is wrong, with the place where it was written: the key itself, or the nearest table around it."""
        source, line = self._place(steps_of(fault.key))
        option_of_its_own = source is not None and source.is_option and source.name != SET
        key = "" if option_of_its_own else shown(self.tables, fault.key)
        where = self.where if source is None else source.name
        return ConfigError(where, key, fault.expected, fault.found, line=line, meant=fault.meant, says=fault.says)

    def _place(self, steps: KeyPath) -> tuple[Source | None, int | None]:
        """The last source that wrote a key, or all of the array that it is in; else the nearest table around it."""
        named = named_steps(self.tables, steps)
        nearest: tuple[Source | None, int | None] = (None, None)
        nearest_length = 0
        for source in reversed(self.sources):
            length, line = source.longest(named, steps)
            whole_array = 0 < length < len(steps) and isinstance(named[length], int)
            if length == len(steps) or whole_array or (length and source.is_option):
                return source, line
            if length > nearest_length:
                nearest, nearest_length = (source, line), length
        if nearest_length == 0:  # a table that only an option speaks of
            inside = (each for each in reversed(self.sources) if each.is_option and each.has_inside(steps))
            return next(inside, None), None
        return nearest


def read_document(path: str | Path) -> Document:
    """A TOML file as it stands; raises `ConfigError`."""
    file = str(path)
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(file, "", "a TOML file", _in_words(error)) from error
    if len(raw) > MAX_FILE_BYTES:
        raise ConfigError(file, "", f"a TOML file of at most {MAX_FILE_BYTES} bytes", f"{len(raw)} bytes")
    try:
        text = raw.decode("utf-8")
        tables = tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise ConfigError(file, "", "text in UTF-8", str(error)) from error
    except tomllib.TOMLDecodeError as error:
        at = re.search(r" \(at line (\d+), column \d+\)$", str(error))
        line = int(at.group(1)) if at else text.count("\n") + 1
        says = f"no valid TOML: {str(error)[: at.start() if at else None]}"
        raise ConfigError(file, "", "valid TOML", str(error), line=line, says=says) from error
    lines = {named_steps(tables, path): line for path, line in reversed(key_lines(text).items())}
    return Document(tables, file, (Source(file, lines),))


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Tables with others laid over them; tables are merged, arrays of tables with an ``id`` by that."""
    return below | {key: _laid_over(below.get(key), value) for key, value in above.items()}


def _laid_over(below: Any, above: Any) -> Any:
    if isinstance(below, dict) and isinstance(above, dict):
        return merged(below, above)
    if _have_ids(below) and _have_ids(above):
        tables = {table["id"]: table for table in below}
        return list((tables | {each["id"]: merged(tables.get(each["id"], {}), each) for each in above}).values())
    return above


def _have_ids(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(each, dict) and isinstance(each.get("id"), int | str) for each in value
    )


def _parsed(override: str) -> Given:
    key, separator, text = override.partition("=")
    if not separator or not all(key.strip().split(".")):
        raise ConfigError(SET, key or "key", "key=value with a dotted key", repr(override))
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    return Given(SET, key.strip(), value)


def _put(tables: dict[str, Any], given: Given) -> str:
    """Put a setting in its place; returns the key of that as faults spell it."""
    names = given.key.split(".")
    place: Any = tables
    spelled = ""
    for depth, name in enumerate(names):
        step: Any = name
        if isinstance(place, list):
            step = _index_of(place, name, spelled, given.option)
            spelled += f"[{step}]"
        elif isinstance(place, dict):
            spelled += f".{name}" if spelled else name
        else:
            raise ConfigError(given.option, spelled, "a table", abbreviated(place))
        if depth == len(names) - 1:
            place[step] = given.value
        else:
            place = place.setdefault(step, {}) if isinstance(place, dict) else place[step]
    return spelled


def _index_of(tables: list[Any], name: str, spelled: str, option: str) -> int:
    """Index of the table with that id (agents) or agent (paths, outages)."""
    keys = {str(t.get("id", t.get("agent"))): i for i, t in enumerate(tables) if isinstance(t, dict)}
    if name not in keys:
        raise ConfigError(option, f"{spelled}.{name}", f"one of the ids {', '.join(keys) or 'none'}", name)
    return keys[name]


def _element(array: Any, index: str | int) -> Any:
    return array[index] if isinstance(array, list) and isinstance(index, int) and index < len(array) else None


def _in_words(error: OSError) -> str:
    if isinstance(error, FileNotFoundError):
        return "no such file"
    if isinstance(error, IsADirectoryError):
        return "a folder"
    if isinstance(error, PermissionError):
        return "one that may not be read"
    return error.strerror or str(error)
