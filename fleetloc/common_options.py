"""What every command has without saying so: -h, -q, -v, and a help in words instead of types."""

from __future__ import annotations

import copy
import functools
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand
from typer.models import ArgumentInfo, OptionInfo

from fleetloc.verbosity import set_verbosity

Verbose = Annotated[int, typer.Option("--verbose", "-v", count=True, show_default=False, help="Say more on stderr.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say on stderr what is wrong, nothing else.")]
ARGUMENT_TYPE = re.compile(r"(?<=[A-Z]) <[^ >|]+>(?= )")
LISTS = (
    "losses", "delays", "channels", "methods", "agents", "gps-shares", "start-offsets", "sizes", "cases", "rows",
    "fleets", "kinds",
)  # fmt: skip
BY_NAME = {
    **dict.fromkeys(("--out", "--copy"), "FOLDER"),
    **dict.fromkeys(("--duration", "--timeout", "--wait", "--from", "--to"), "S"),
    **dict.fromkeys(("--ranges", "--truth", "--mission"), "FILE"),
    **dict.fromkeys(("--connect", "--router"), "ENDPOINT"),
    **dict.fromkeys(("--namespace", "--frame"), "NAME"),
    **dict.fromkeys((f"--{name}" for name in LISTS), "LIST"),
    **dict.fromkeys(("--drop-gps", "--autopilot-gps"), "ID[:FROM,TO]"),
    "--estimator": "KIND",
    "--arrival": "WHEN",
    "--graph": "GRAPH",
    "--acados": "PYTHON",
}
"""What stands for a value in help, by the option."""
PLACEHOLDERS: dict[Any, str] = {int: "N", float: "NUMBER", Path: "FILE", str: "TEXT"}
"""What stands for a value in help, by its type, where the option says nothing better."""


class PlainCommand(TyperCommand):
    """A command whose help shows no braces and types around ``CONFIG`` and ``FILE``, as typer would."""

    def get_help(self, ctx: Any) -> str:
        """The help; a type behind an argument gives way to blanks, so that the columns stand."""
        return ARGUMENT_TYPE.sub(lambda found: " " * len(found.group()), super().get_help(ctx))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The words of the usage line, braces of required arguments left out."""
        return [piece.replace("{", "").replace("}", "") for piece in super().collect_usage_pieces(ctx)]


def complete(app: typer.Typer) -> None:
    """Give every command of an application, and of the groups in it, what all of them have."""
    for info in app.registered_commands:
        info.cls = PlainCommand
        if info.callback is not None:
            info.callback = _with_verbosity(info.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            complete(group.typer_instance)


def _with_verbosity(command: Callable[..., Any]) -> Callable[..., Any]:
    """The same command with -v and -q, which it may take itself."""
    signature, hints = inspect.signature(command), get_type_hints(command, include_extras=True)
    own = signature.parameters.keys()

    @functools.wraps(command)
    def run(**given: Any) -> Any:
        set_verbosity(-1 if given["quiet"] else given["verbose"])
        return command(**{name: value for name, value in given.items() if name in own})

    parameters = [
        each.replace(annotation=_in_words(each.name, hints.get(each.name, each.annotation)))
        for each in _all(signature)
    ]
    run.__dict__.pop("__wrapped__")
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def _all(signature: inspect.Signature) -> Iterator[inspect.Parameter]:
    yield from signature.parameters.values()
    for name, annotation, default in (("verbose", Verbose, 0), ("quiet", Quiet, False)):
        if name not in signature.parameters:
            yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _in_words(name: str, annotation: Any) -> Any:
    """The annotation of a parameter, saying what stands for its value in help where it does not say so itself."""
    said = []
    for each in getattr(annotation, "__metadata__", ()):
        if isinstance(each, ArgumentInfo | OptionInfo) and each.metavar is None:
            each = copy.copy(each)
            each.metavar = name.upper() if isinstance(each, ArgumentInfo) else _placeholder(name, annotation, each)
        said.append(each)
    return Annotated[annotation.__origin__, *said] if said else annotation


def _placeholder(name: str, annotation: Any, option: OptionInfo) -> str | None:
    """What stands for an option's value; none for a flag, which has no value, and a choice, which lists them."""
    kind = annotation.__origin__
    while get_args(kind) and get_origin(kind) is not Literal:  # of what an optional value or a list holds
        kind = next(each for each in get_args(kind) if each is not type(None))
    if option.count or kind is bool or get_origin(kind) is Literal:
        return None
    given = (option.default, *(option.param_decls or ()))  # in an annotation the first name stands for a default
    spelled = [each for each in given if str(each).startswith("--")] or [f"--{name.replace('_', '-')}"]
    return next((BY_NAME[each] for each in spelled if each in BY_NAME), PLACEHOLDERS.get(kind, "VALUE"))
