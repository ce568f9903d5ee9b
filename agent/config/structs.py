"""Reading a table into the struct that describes it, and saying of every mistake in it what it is.

msgspec stops at the first mistake and speaks of types and patterns; this walks along the struct, lets msgspec judge
value by value, and puts what it says into words.
"""

from __future__ import annotations

import math
import re
import types
import typing
from collections.abc import Iterator
from typing import Any, TypeVar

import msgspec

from agent.config.faults import Fault, one_of, probably

T = TypeVar("T", bound=msgspec.Struct)
NONE = type(None)
PLAIN_NAMES = {
    "float": "a number",
    "int": "a whole number",
    "str": "a string",
    "bool": "true or false",
    "object": "a table",
    "array": "an array",
}
SHOWN_CHARACTERS = 80


def read_struct(value: Any, struct: type[T], key: str = "") -> tuple[T | None, list[Fault]]:
    """The struct that a table describes, or all that is wrong with it; ``key`` is the table's own."""
    faults = list(_faults(value, struct, key))
    return (None if faults else msgspec.convert(value, struct)), faults


def keys_of(struct: type[msgspec.Struct]) -> list[str]:
    """Names of the keys that a table may have."""
    config = struct.__struct_config__
    return ([config.tag_field] if config.tag_field else []) + list(struct.__struct_encode_fields__)


def _faults(value: Any, kind: Any, key: str) -> Iterator[Fault]:
    plain, metas = _unwrapped(kind)
    if value is None and NONE in typing.get_args(plain):
        return
    plain = _without_none(plain)
    choices = [each for each in (typing.get_args(plain) or (plain,)) if _is_struct(each)]
    if choices and typing.get_origin(plain) is not tuple:
        yield from _table_faults(value, choices, key)
    elif typing.get_origin(plain) is tuple and _is_struct(_without_none(typing.get_args(plain)[0]), deep=True):
        yield from _array_faults(value, typing.get_args(plain)[0], metas, key)
    else:
        yield from _value_faults(value, kind, key)


def _table_faults(value: Any, choices: list[type[msgspec.Struct]], key: str) -> Iterator[Fault]:
    """Of a table, or of one whose ``kind`` says which of several it is."""
    if not isinstance(value, dict):
        yield Fault(key, "a table", abbreviated(value))
        return
    struct = choices[0]
    if len(choices) > 1:
        tag_field = str(struct.__struct_config__.tag_field)
        by_tag = {str(each.__struct_config__.tag): each for each in choices}
        tag = value.get(tag_field)
        if not isinstance(tag, str) or tag not in by_tag:
            found = "nothing" if tag is None else abbreviated(tag)
            yield Fault(_inside(key, tag_field), one_of(by_tag), found, probably(str(tag), by_tag))
            return
        struct = by_tag[tag]
    known = keys_of(struct)
    for name in value:
        if name not in known:
            yield Fault(_inside(key, name), one_of(known), "an unknown key", probably(name, known))
    for field in msgspec.structs.fields(struct):
        place = _inside(key, field.encode_name)
        if field.encode_name in value:
            yield from _faults(value[field.encode_name], field.type, place)
        elif field.required:
            yield Fault(place, f"{_sort_of(field.type)} (it is required)", "nothing")


def _sort_of(kind: Any) -> str:
    """A value, a table or an array of tables."""
    plain, _ = _unwrapped(kind)
    if typing.get_origin(plain) is tuple and _is_struct(typing.get_args(plain)[0], deep=True):
        return "an array of tables"
    return "a table" if _is_struct(plain, deep=True) else "a value"


def _array_faults(value: Any, kind: Any, metas: list[msgspec.Meta], key: str) -> Iterator[Fault]:
    """Of an array of tables."""
    if not isinstance(value, list | tuple):
        yield Fault(key, "an array of tables", abbreviated(value))
        return
    length: Any = tuple[Any, ...]
    for meta in metas:
        length = typing.Annotated[length, meta]
    yield from _value_faults(value, length, key)
    for index, each in enumerate(value):
        yield from _faults(each, kind, f"{key}[{index}]")


def _value_faults(value: Any, kind: Any, key: str) -> Iterator[Fault]:
    """Of one value, or an array of values."""
    if isinstance(value, float) and not math.isfinite(value):
        yield Fault(key, "a finite number", str(value))
        return
    if isinstance(value, list | tuple):
        for index, each in enumerate(value):
            if isinstance(each, float) and not math.isfinite(each):
                yield Fault(f"{key}[{index}]", "a finite number", str(each))
                return
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        yield _explained(str(error), value, kind, key)


def _explained(message: str, value: Any, kind: Any, key: str) -> Fault:
    """What msgspec says of a value, in words."""
    match = re.fullmatch(r"(.*?)(?: - at `\$(.*)`)?", message, re.DOTALL)
    what, path = (match.group(1), match.group(2) or "") if match else (message, "")
    for index in re.findall(r"\[(\d+)\]", path):
        value = value[int(index)]
        inner = typing.get_args(_without_none(_unwrapped(kind)[0]))
        kind = inner[0] if inner[-1] is Ellipsis else inner[int(index)]
    plain, metas = _unwrapped(kind)
    plain = _without_none(plain)
    if what.startswith("Invalid"):
        choices = typing.get_args(plain)
        return Fault(key + path, one_of(choices), abbreviated(value), probably(str(value), choices))
    if "regex" in what:
        rule = next(meta.description for meta in metas if meta.pattern is not None)
        return Fault(key + path, str(rule), abbreviated(value))
    return Fault(key + path, _expected(what), abbreviated(value))


def _expected(what: str) -> str:
    """``Expected `int | null` >= 1, got `str``` as ``a whole number >= 1``."""
    what = re.sub(r"^Expected |, got .*$", "", what)
    what = re.sub(r"(\d)\.0$", r"\1", what)
    names = (
        [name for name in re.findall(r"\w+", match.group(1)) if name != "null"]
        if (match := re.match(r"`([^`]*)`", what))
        else []
    )
    words = " or ".join(PLAIN_NAMES.get(name, name) for name in names)
    return re.sub(r"^`[^`]*`", words, what)


def abbreviated(value: Any) -> str:
    """A value as it is shown in messages."""
    text = repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


def _inside(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _unwrapped(kind: Any) -> tuple[Any, list[msgspec.Meta]]:
    """A type without its annotations, and those."""
    metas: list[msgspec.Meta] = []
    while typing.get_origin(kind) is typing.Annotated:
        metas += [meta for meta in kind.__metadata__ if isinstance(meta, msgspec.Meta)]
        kind = typing.get_args(kind)[0]
    if NONE in typing.get_args(kind):
        inner, inner_metas = _unwrapped(_without_none(kind))
        return typing.Union[inner, None], metas + inner_metas  # noqa: UP007  # of a value, not in a signature
    return kind, metas


def _without_none(kind: Any) -> Any:
    """A type without ``None`` alternatives."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return kind
    left = [each for each in typing.get_args(kind) if each is not NONE]
    return left[0] if len(left) == 1 else typing.Union[tuple(left)]  # noqa: UP007


def _is_struct(kind: Any, *, deep: bool = False) -> bool:
    """Whether a type is a table; ``deep``: or a choice of tables."""
    if deep and typing.get_origin(kind) in (typing.Union, types.UnionType):
        return any(map(_is_struct, typing.get_args(kind)))
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)
