"""The configuration reference: every key with its type, default and meaning, out of the structs that check it.

`make docs` writes it to ``docs/configuration.md``; a test holds the file to the code.
"""

from __future__ import annotations

import ast
import functools
import inspect
import re
import sys
import types
import typing
from collections.abc import Iterator
from typing import Any, Literal

import msgspec

from agent.config.retired import RETIRED
from agent.config.tables import FleetConfig
from estimators.settings import DEFAULT_KIND, DEFAULTS_OF_KIND, EstimatorSettings
from fleetloc.whole_config import OTHER_TABLES

HEADER = """# Configuration reference

One TOML file describes a fleet; every process of it reads the same file. Unknown keys are refused with file, line and
what was expected. `--set key=value` on the command line beats the file (`--set estimator.window=8`,
`--set agents.2.mavlink=udpin:127.0.0.1:14562`, where 2 is the agent's id). `fleetloc check CONFIG` reads it as the
daemon would, `--print` shows what is in effect. A unit is in a key's name; NED metres, seconds, radians throughout.

This page is generated from the code (`make docs`).
"""
OTHERS = """# Tables that no drone reads

The simulator, `fleetloc sitl` and `fleetloc monitor` read them; a daemon carries them along unread, so that one file
serves all, and `fleetloc check` checks them.
"""
FORMER = """# Former keys

They are constants now; a file that has one is refused, and the line can go. A flight log that has one with this value
replays as before.
"""
NONE = type(None)


def reference() -> str:
    """The page, in Markdown."""
    parts = [HEADER]
    for field in msgspec.structs.fields(FleetConfig):
        if field.name != "others":
            struct, is_array = _table_of(field.type)
            parts.append(_table(field.name, struct, is_array))
    parts.append(OTHERS)
    parts += [_table(name, table.struct, False) for name, table in OTHER_TABLES.items()]
    parts.append(_former_keys())
    return "\n".join(parts)


def _former_keys() -> str:
    rows = [f"| `{key}` | `{_toml(retired.value)}` | {retired.words} |" for key, retired in RETIRED.items()]
    return "\n".join([FORMER, "| key | value | now |", "|---|---|---|", *rows, ""])


def _table(name: str, struct: type, is_array: bool) -> str:
    """One table and, below it, the tables of its keys."""
    heading = f"`[[{name}]]`" if is_array else f"`[{name}]`"
    lines = [f"## {heading}", "", *_prose(struct), "| key | type | default | meaning |", "|---|---|---|---|"]
    nested: list[str] = []
    docstrings = _docstrings(struct)
    for field in msgspec.structs.fields(struct):
        is_kind = struct is EstimatorSettings and field.name == "kind"
        default = f'`"{DEFAULT_KIND}"`' if is_kind else _default(field)
        meaning = _one_line(docstrings.get(field.name, ""))
        lines.append(f"| `{field.encode_name}` | {_type(field.type)} | {default} | {meaning} |")
        nested += _nested(f"{name}.{field.encode_name}", field.type)
    if struct is EstimatorSettings:
        lines += ["", *_kind_defaults()]
    return "\n".join([*lines, "", *nested])


def _nested(name: str, kind: Any) -> list[str]:
    """Tables inside a table, e.g. the paths of ``[sim]``."""
    parts = []
    for struct, is_array in _structs(kind, False):
        tag = struct.__struct_config__.tag
        text = _table(name, struct, is_array).replace("## ", "### ", 1)
        parts.append(text.replace("\n", f', kind = "{tag}"\n', 1) if tag else text)
    return parts


def _structs(kind: Any, in_array: bool) -> Iterator[tuple[Any, bool]]:
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        yield kind, in_array
        return
    inside = in_array or typing.get_origin(kind) is tuple
    for argument in typing.get_args(kind):
        yield from _structs(argument, inside)


def _table_of(kind: Any) -> tuple[type, bool]:
    return next(_structs(kind, False))


def _prose(struct: type) -> list[str]:
    """What the struct's docstring says, its first line without the name of the table."""
    text = inspect.getdoc(struct) or ""
    text = re.sub(r"^``\[.*?\]``: ", "", text)
    return [_markdown(text[:1].upper() + text[1:]), ""] if text else []


@functools.cache
def _docstrings(struct: type) -> dict[str, str]:
    """The strings that stand below the fields of a struct, its bases' too."""
    found: dict[str, str] = {}
    for base in reversed(struct.__mro__):
        if not (isinstance(base, type) and issubclass(base, msgspec.Struct)) or base is msgspec.Struct:
            continue
        (definition,) = ast.parse(inspect.getsource(base)).body
        assert isinstance(definition, ast.ClassDef)
        for statement, following in zip(definition.body, definition.body[1:], strict=False):
            if isinstance(statement, ast.AnnAssign) and isinstance(following, ast.Expr):
                assert isinstance(statement.target, ast.Name)
                assert isinstance(following.value, ast.Constant)
                found[statement.target.id] = inspect.cleandoc(str(following.value.value))
    return found


def _default(field: msgspec.structs.FieldInfo) -> str:
    if field.required:
        return "**required**"
    value = field.default
    if value is msgspec.NODEFAULT:
        assert field.default_factory is not msgspec.NODEFAULT
        value = field.default_factory()
    if value is None:
        return "absent"
    if isinstance(value, msgspec.Struct):
        return "its own"
    if value == ():
        return "none"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    return f"`{value:.12g}`" if isinstance(value, float) else f"`{value}`"


def _kind_defaults() -> list[str]:
    lines = ["A `kind` may bring defaults of its own, which what is written beats:", ""]
    for kind, defaults in DEFAULTS_OF_KIND.items():
        shown = ", ".join(f"`{key} = {_toml(value)}`" for key, value in defaults.items())
        lines.append(f"- `{kind}`: {shown}")
    return lines


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


PLAIN = {float: "number", int: "whole number", str: "text", bool: "true or false"}


def _type(kind: Any) -> str:
    """A type as people read it."""
    origin = typing.get_origin(kind)
    if origin is typing.Annotated:
        plain, *metas = typing.get_args(kind)
        limits = [limit for meta in metas if isinstance(meta, msgspec.Meta) for limit in _limits(meta)]
        return " ".join([_type(plain), *limits])
    if origin is Literal:
        return " \\| ".join(f"`{_toml(choice)}`" for choice in typing.get_args(kind))
    if origin in (typing.Union, types.UnionType):
        alternatives = [_type(choice) for choice in typing.get_args(kind) if choice is not NONE]
        return " or ".join(dict.fromkeys(alternatives))
    if origin is tuple:
        arguments = typing.get_args(kind)
        if arguments[-1] is Ellipsis:
            return f"array of {_type(arguments[0])}"
        return f"[{', '.join(_type(argument) for argument in arguments)}]"
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return "table"
    return PLAIN.get(kind, str(kind))


def _limits(meta: msgspec.Meta) -> list[str]:
    signs = {"gt": "&gt;", "ge": "≥", "lt": "&lt;", "le": "≤"}
    limits = [f"{sign} {value:g}" for key, sign in signs.items() if (value := getattr(meta, key)) is not None]
    return [*limits, *([f"of {meta.description}"] if meta.pattern and meta.description else [])]


def _one_line(text: str) -> str:
    return _markdown(" ".join(text.split())).replace("|", "\\|")


def _markdown(text: str) -> str:
    """Docstrings mark code with two ticks (or one, for names of the code)."""
    return text.replace("``", "`")


if __name__ == "__main__":
    sys.stdout.write(reference())
