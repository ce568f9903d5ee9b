"""Reading, checking and printing a fleet's configuration: one TOML file for the whole fleet.

Order of precedence: override (``--set key=value``) over profile (``--with``) over file over default. What is wrong
raises one `ConfigError` that says where, which key, what was expected and what was found; `read` tells all of them.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from agent.config.checks import faults_between
from agent.config.documents import SET, Document, Override, read_document
from agent.config.faults import Fault, one_of, probably
from agent.config.other_tables import READ_BY_OTHERS, OtherTables
from agent.config.retired import as_flown, explained
from agent.config.structs import keys_of, read_struct
from agent.config.tables import FleetConfig
from agent.errors import ConfigError
from estimators.settings import EstimatorSettings, with_kind_defaults

NO_FLEET = "there is no [fleet] and no [[agents]]; a profile is laid over a fleet's file by --with"
T = TypeVar("T", bound=msgspec.Struct)


def load_config(
    path: str | Path, overrides: Iterable[Override] = (), profiles: Iterable[str | Path] = ()
) -> FleetConfig:
    """Read a fleet's configuration.

    ``profiles`` are further TOML files laid over it in turn (`--with`), e.g. a link profile: their keys beat the
    file's, tables are merged, ``[[agents]]`` by their ids; everything else is replaced.

    ``overrides`` are ``key=value`` with dotted keys and TOML values (a bare word is a string), e.g.
    ``estimator.window=3`` or ``agents.2.mavlink=udpin:127.0.0.1:14562``, where 2 is the agent's id. Raises
    `ConfigError`.
    """
    return config_of(load_document(path, overrides, profiles))


def load_document(
    path: str | Path, overrides: Iterable[Override] = (), profiles: Iterable[str | Path] = ()
) -> Document:
    """The same, not understood yet; raises `ConfigError` for a file that cannot be read and for no override."""
    document = read_document(path)
    for profile in profiles:
        document = document.laid_over(read_document(profile))
    return document.overridden(overrides)


def config_from(tables: dict[str, Any], where: str, overrides: Iterable[Override] = ()) -> FleetConfig:
    """The checked configuration of decoded TOML; ``where`` names it in errors. Raises `ConfigError`."""
    return config_of(Document(tables, where).overridden(overrides))


def recorded_config(text: str, where: str, flown_with: str, overrides: Iterable[Override] = ()) -> FleetConfig:
    """The configuration in a flight log, where former keys may stand; ``flown_with`` is the software that wrote it.

    Raises `ConfigError`, for a former key with another value than the present constant naming that software.
    """
    try:
        tables, faults = as_flown(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(where, "", "valid TOML", str(error)) from error
    if faults:
        says = f"{faults[0].says}; replay it with the version that it was flown with ({flown_with})"
        raise ConfigError(where, faults[0].key, "", "", says=says, more=len(faults) - 1)
    return config_of(Document(tables, where).overridden(overrides))


def config_of(document: Document) -> FleetConfig:
    """The checked configuration that a document describes; raises `ConfigError` for the first thing wrong with it."""
    config, errors = read(document)
    return _or_raise(config, errors)


def read(document: Document) -> tuple[FleetConfig | None, list[ConfigError]]:
    """The configuration and everything wrong with it.

    A setting that is wrong by itself is left out to see whether the rest goes together; where that cannot be, as the
    setting is required, there is no configuration.
    """
    config, faults = _separately(document)
    if config is None:
        config, _ = _separately(document.without(fault.key for fault in faults))
    if config is not None:
        wrong = {fault.key for fault in faults}
        faults += [fault for fault in faults_between(config) if fault.key not in wrong]
    return config, [document.error(explained(fault)) for fault in faults]


def load_estimator_settings(path: str | Path | None, overrides: Iterable[Override] = ()) -> EstimatorSettings:
    """Only the ``[estimator]`` table of a configuration (None: the defaults), with its overrides.

    The rest of the file is not looked at: a tick-level recording brings its own fleet. Raises `ConfigError`,
    also for an override outside the table.
    """
    document = Document({}, "defaults") if path is None else read_document(path)
    overrides = list(overrides)
    for override in overrides:
        key = override.partition("=")[0].strip() if isinstance(override, str) else override.key
        if not key.startswith("estimator."):
            expected = "a key of the table estimator (estimator.<name>=value)"
            raise ConfigError(SET, key, expected, repr(override))
    document = document.overridden(overrides)
    table, faults = read_struct(
        _estimator_table(document.tables.get("estimator", {})), EstimatorSettings, "estimator"
    )
    return _or_raise(table, [document.error(fault) for fault in faults])


@dataclass(frozen=True, slots=True)
class OtherTable(Generic[T]):
    """A table that another room than the agent reads, as strictly as the agent reads its own.

    ``check`` yields what does not go together in it, or with the rest of the configuration.
    """

    name: str
    struct: type[T]
    check: Callable[[T, FleetConfig], Iterator[Fault]]

    def of(self, config: FleetConfig) -> T:
        """The table of a configuration; raises `ConfigError`."""
        table, errors = self.read(config.others.document, config)
        return _or_raise(table, errors)

    def read(self, document: Document, config: FleetConfig | None) -> tuple[T | None, list[ConfigError]]:
        """The table, and everything wrong with it, as far as that can be told without a configuration."""
        table, faults = read_struct(document.tables.get(self.name, {}), self.struct, self.name)
        if table is not None and config is not None:
            faults = list(self.check(table, config))
        return table, [document.error(explained(fault)) for fault in faults]


def with_other_table(config: FleetConfig, name: str, table: msgspec.Struct) -> FleetConfig:
    """A configuration with one of the tables that others read put in or replaced."""
    document = config.others.document.with_table(name, msgspec.to_builtins(table))
    return msgspec.structs.replace(config, others=_others(document))


def effective(config: FleetConfig) -> dict[str, Any]:
    """All tables as plain values, defaults filled in; those of other rooms as far as they were written."""
    tables: dict[str, Any] = msgspec.to_builtins(config)
    return {name: table for name, table in tables.items() if name != "others"} | config.others.tables


def dump(config: FleetConfig) -> str:
    """The effective configuration as TOML; `load_config` reads it back unchanged."""
    lines: list[str] = []
    for name, table in effective(config).items():
        for entry in table if isinstance(table, list | tuple) else (table,):
            lines.append(f"[{name}]" if entry is table else f"[[{name}]]")
            lines += [f"{key} = {_toml(value)}" for key, value in entry.items() if value is not None]
            lines.append("")
    return "\n".join(lines)


def _separately(document: Document) -> tuple[FleetConfig | None, list[Fault]]:
    """Every setting by itself as it may be; what has to hold between them is not looked at."""
    own = {name: value for name, value in document.tables.items() if name not in READ_BY_OTHERS}
    if "estimator" in own:
        own["estimator"] = _estimator_table(own["estimator"])
    known = [*(name for name in keys_of(FleetConfig) if name != "others"), *READ_BY_OTHERS]
    unknown = [name for name in own if name not in known]
    faults = [Fault(name, one_of(known), "an unknown key", probably(name, known)) for name in unknown]
    config, more = read_struct({name: own[name] for name in own if name not in unknown}, FleetConfig)
    if "fleet" not in own and "agents" not in own:
        more = [Fault("fleet", "", "", says=NO_FLEET)]
    if config is None or faults:
        return None, [*faults, *map(_in_its_table, more)]
    return msgspec.structs.replace(config, others=_others(document)), []


def _in_its_table(fault: Fault) -> Fault:
    """A fault of a key that no key of its table is like, naming the table that has one of that name."""
    name = fault.key.partition(".")[2]
    if fault.found != "an unknown key" or fault.meant or "." in name:
        return fault
    tables = {field.name: field.type for field in msgspec.structs.fields(FleetConfig)}
    having = [each for each, kind in tables.items() if _is_table(kind) and name in keys_of(kind)]
    return replace(fault, meant=f"{having[0]}.{name}") if len(having) == 1 else fault


def _is_table(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _others(document: Document) -> OtherTables:
    tables = {name: document.tables[name] for name in READ_BY_OTHERS if name in document.tables}
    return OtherTables(tables, document)


def _estimator_table(table: Any) -> Any:
    return with_kind_defaults(table) if isinstance(table, dict) else table


def _or_raise(read_one: T | None, errors: list[ConfigError]) -> T:
    if errors:
        raise errors[0].beside(len(errors) - 1)
    assert read_one is not None
    return read_one


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
