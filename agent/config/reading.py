"""Reading, checking and printing a fleet's configuration: one TOML file for the whole fleet.

Order of precedence: override (``--set key=value``) over file over default. Everything wrong raises one
`ConfigError` that says where, which key, what was expected and what was found.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
import typing
from collections.abc import Iterable
from collections.abc import Set as AbstractSet
from pathlib import Path as FilePath
from typing import Any, TypeVar

import msgspec

from agent.config.checks import check_fleet
from agent.config.other_tables import READ_BY_OTHERS, OtherTables
from agent.config.tables import FleetConfig
from agent.errors import ConfigError
from estimators.settings import EstimatorSettings, with_kind_defaults

T = TypeVar("T", bound=msgspec.Struct)
MAX_FILE_BYTES = 1_000_000
OVERRIDE = "override"
PLAIN_NAMES = {
    "float": "a number",
    "int": "a whole number",
    "str": "a string",
    "bool": "true or false",
    "object": "a table",
    "array": "an array",
}


def load_config(
    path: str | FilePath, overrides: Iterable[str] = (), profiles: Iterable[str | FilePath] = ()
) -> FleetConfig:
    """Read a fleet's configuration.

    ``profiles`` are further TOML files laid over it in turn (`--with`), e.g. a link profile: their keys beat the
    file's, tables are merged, ``[[agents]]`` by their ids; everything else is replaced.

    ``overrides`` are ``key=value`` with dotted keys and TOML values (a bare word is a string), e.g.
    ``estimator.window=3`` or ``agents.2.mavlink=udpin:127.0.0.1:14562``, where 2 is the agent's id. Raises
    `ConfigError`.
    """
    document, where = read_document(path), str(path)
    for profile in profiles:
        document = merged(document, read_document(profile))
        where += f" with {profile}"
    return config_from(document, where, overrides)


def load_estimator_settings(path: str | FilePath | None, overrides: Iterable[str] = ()) -> EstimatorSettings:
    """Only the ``[estimator]`` table of a configuration (None: the defaults), with its overrides.

    The rest of the file is not looked at: a tick-level recording brings its own fleet. Raises `ConfigError`,
    also for an override outside the table.
    """
    document = {} if path is None else read_document(path)
    overrides = list(overrides)
    for override in overrides:
        key = override.partition("=")[0].strip()
        if not key.startswith("estimator."):
            raise ConfigError(OVERRIDE, key, "a key of the table estimator (estimator.<name>=value)", repr(override))
    origin = {"lat_deg": 0.0, "lon_deg": 0.0, "alt_m": 0.0}
    stub: dict[str, Any] = {
        "fleet": {"name": "recording", "origin": origin},
        "agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:0"}],
    }
    table = {"estimator": document["estimator"]} if "estimator" in document else {}
    return _decoded(stub | table, "defaults" if path is None else str(path), overrides).estimator


def read_document(path: str | FilePath) -> dict[str, Any]:
    """A TOML file as it stands; raises `ConfigError`."""
    file = str(path)
    try:
        raw = FilePath(path).read_bytes()
    except OSError as error:
        raise ConfigError(file, "file", "a readable TOML file", error.strerror or str(error)) from error
    if len(raw) > MAX_FILE_BYTES:
        raise ConfigError(file, "file", f"at most {MAX_FILE_BYTES} bytes", f"{len(raw)} bytes")
    try:
        text = raw.decode("utf-8")
        return tomllib.loads(text)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(file, "syntax", "valid TOML", str(error)) from error


def merged(document: dict[str, Any], profile: dict[str, Any]) -> dict[str, Any]:
    """A document with another one's keys laid over it; tables are merged, arrays of tables with an ``id`` by that."""
    return document | {key: _laid_over(document.get(key), value) for key, value in profile.items()}


def _laid_over(below: Any, above: Any) -> Any:
    if isinstance(below, dict) and isinstance(above, dict):
        return merged(below, above)
    if _have_ids(below) and _have_ids(above):
        tables = {table["id"]: table for table in below}
        return list((tables | {each["id"]: merged(tables.get(each["id"], {}), each) for each in above}).values())
    return above


def _have_ids(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(each, dict) and _is_id(each.get("id")) for each in value)


def _is_id(value: Any) -> bool:
    return isinstance(value, int | str)


def config_from(document: dict[str, Any], where: str, overrides: Iterable[str] = ()) -> FleetConfig:
    """The checked configuration of a decoded TOML document; ``where`` names it in errors."""
    config = _decoded(document, where, overrides)
    check_fleet(config, where)
    return config


def _decoded(document: dict[str, Any], where: str, overrides: Iterable[str]) -> FleetConfig:
    """Every setting by itself as it may be; what has to hold between them is not looked at."""
    overridden = frozenset(_override(document, override) for override in overrides)
    others = {name: document[name] for name in READ_BY_OTHERS if name in document}
    own = {name: value for name, value in document.items() if name not in others}
    if isinstance(own.get("estimator"), dict):
        own["estimator"] = with_kind_defaults(own["estimator"])
    if "others" in own:
        raise ConfigError(where, "others", _one_of(_table_names()), "an unknown key")
    config = _converted(own, FleetConfig, "", where, overridden)
    return msgspec.structs.replace(config, others=OtherTables(others, where, overridden))


def other_table(config: FleetConfig, name: str, struct: type[T]) -> T:
    """A table that another room than the agent reads, as strictly as the agent reads its own.

    Raises `ConfigError`. What has to hold between its settings and others is for the caller to check.
    """
    others = config.others
    return _converted(others.tables.get(name, {}), struct, name, others.where, others.overridden)


def with_other_table(config: FleetConfig, name: str, table: msgspec.Struct) -> FleetConfig:
    """A configuration with one of the tables that others read put in or replaced."""
    others = config.others
    tables = {**others.tables, name: msgspec.to_builtins(table)}
    return msgspec.structs.replace(config, others=OtherTables(tables, others.where, others.overridden))


def _converted(
    value: Any, struct: type[T], prefix: str, where: str, overridden: AbstractSet[str]
) -> T:
    """A table, or the whole of them; ``prefix`` is its key."""
    _check_finite(value, where, prefix)
    try:
        return msgspec.convert(value, struct)
    except msgspec.ValidationError as error:
        raise _explained(error, value, struct, prefix, where, overridden) from error


def effective(config: FleetConfig) -> dict[str, Any]:
    """All tables as plain values, defaults filled in; those of other rooms as far as they were written."""
    tables: dict[str, Any] = msgspec.to_builtins(config)
    return {name: table for name, table in tables.items() if name != "others"} | dict(config.others.tables)


def dump(config: FleetConfig) -> str:
    """The effective configuration as TOML; `load_config` reads it back unchanged."""
    lines: list[str] = []
    for name, table in effective(config).items():
        for entry in table if isinstance(table, list | tuple) else (table,):
            lines.append(f"[{name}]" if entry is table else f"[[{name}]]")
            lines += [f"{key} = {_toml(value)}" for key, value in entry.items() if value is not None]
            lines.append("")
    return "\n".join(lines)


def _toml(value: Any) -> str:
    """A value as TOML, tables inline; the standard library only reads TOML."""
    if isinstance(value, dict):
        items = (f"{key} = {_toml(item)}" for key, item in value.items() if item is not None)
        return f"{{ {', '.join(items)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)


def _override(document: dict[str, Any], override: str) -> str:
    """Put one ``key=value`` into the document; returns the key of its place as errors spell it."""
    where = OVERRIDE
    key, separator, text = override.partition("=")
    names = key.strip().split(".")
    if not separator or not all(names):
        raise ConfigError(where, key or "key", "key=value with a dotted key", repr(override))
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    place: Any = document
    spelled = ""
    for depth, name in enumerate(names):
        step: Any = name
        if isinstance(place, list):
            step = _index_of(place, name, spelled, where)
            spelled += f"[{step}]"
        elif isinstance(place, dict):
            spelled += f".{name}" if spelled else name
        else:
            raise ConfigError(where, spelled, "a table", repr(place))
        if depth == len(names) - 1:
            place[step] = value
        else:
            place = place.setdefault(step, {}) if isinstance(place, dict) else place[step]
    return spelled


def _index_of(tables: list[Any], name: str, spelled: str, where: str) -> int:
    """Index of the table with that id (agents) or agent (paths, outages)."""
    keys = {str(t.get("id", t.get("agent"))): i for i, t in enumerate(tables) if isinstance(t, dict)}
    if name not in keys:
        raise ConfigError(where, f"{spelled}.{name}", f"one of the ids {', '.join(keys) or 'none'}", name)
    return keys[name]


def _explained(
    error: msgspec.ValidationError, table: Any, struct: Any, prefix: str, where: str, overridden: AbstractSet[str]
) -> ConfigError:
    """Turn msgspec's message (what, at which path) into one that also names what was found."""
    message = str(error)
    match = re.fullmatch(r"(.*?)(?: - at `(?:key in )?\$\.?(.*)`)?", message, re.DOTALL)
    what, path = (match.group(1), match.group(2) or "") if match else (message, "")
    unknown = re.search(r"unknown field `([^`]*)`", what)
    missing = re.search(r"missing required field `([^`]*)`", what)
    inside = f"{prefix}.{path}".strip(".")
    if unknown:
        key = f"{inside}.{unknown.group(1)}".strip(".")
        expected, found = _one_of(_known_keys(path, table, struct)), "an unknown key"
    elif missing:
        key = f"{inside}.{missing.group(1)}".strip(".")
        expected, found = "a value (the key is required)", "nothing"
    else:
        key = inside
        plain = re.sub(r"`(\w+)`", lambda name: PLAIN_NAMES.get(name.group(1), name.group(1)), what)
        expected = (
            _choices(path, struct) if what.startswith("Invalid") else re.sub(r"^Expected |, got .*$", "", plain)
        )
        found = _abbreviated(_value_at(table, path))
    return ConfigError(OVERRIDE if key in overridden else where, key, expected, found)


def _steps(path: str) -> list[str | int]:
    """``sim.paths[0].points_m[1]`` as keys and indices."""
    return [int(i) if i else name for name, i in re.findall(r"([A-Za-z0-9_-]+)|\[(\d+|\.\.\.)\]", path)]


def _value_at(document: Any, path: str) -> Any:
    value = document
    for step in _steps(path):
        try:
            value = value[step]
        except (KeyError, IndexError, TypeError):
            return value
    return value


def _abbreviated(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _table_names() -> list[str]:
    own = [name for name in FleetConfig.__struct_encode_fields__ if name != "others"]
    return [*own, *READ_BY_OTHERS]


def _known_keys(path: str, document: Any, root: Any) -> list[str]:
    """Names of the keys that the table at ``path`` may have; of a union, those of the ``kind`` given."""
    if root is FleetConfig and not path:
        return _table_names()
    names: list[str] = []
    structs = typing.get_args(_type_at(path, root)) or (_type_at(path, root),)
    tag = _value_at(document, f"{path}.kind")
    for struct in structs:
        tag_field = struct.__struct_config__.tag_field
        if len(structs) == 1 or struct.__struct_config__.tag == tag:
            names += ([tag_field] if tag_field else []) + list(struct.__struct_encode_fields__)
    return names


def _choices(path: str, root: Any) -> str:
    """What may stand at a key whose values are enumerated."""
    table, _, key = path.rpartition(".")
    if key == "kind" and typing.get_args(_type_at(table, root)):
        return _one_of(struct.__struct_config__.tag for struct in typing.get_args(_type_at(table, root)))
    return _one_of(typing.get_args(_type_at(path, root)))


def _one_of(values: Iterable[Any]) -> str:
    return f"one of {', '.join(str(value) for value in values)}"


def _type_at(path: str, root: Any) -> Any:
    """Declared type at a path, annotations and ``None`` stripped."""
    kind: Any = root
    for step in _steps(path):
        inner = typing.get_args(kind)[0] if isinstance(step, int) else typing.get_type_hints(kind)[step]
        kind = _stripped(inner)
    return kind


def _stripped(kind: Any) -> Any:
    """A type without ``None`` alternatives."""
    alternatives = [a for a in typing.get_args(kind) if a is not type(None)]
    return alternatives[0] if type(None) in typing.get_args(kind) and len(alternatives) == 1 else kind


def _check_finite(value: Any, where: str, key: str) -> None:
    """TOML can write nan and inf; no setting can be either."""
    if isinstance(value, dict):
        for name, item in value.items():
            _check_finite(item, where, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            _check_finite(item, where, f"{key}[{index}]")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(where, key, "a finite number", str(value))
