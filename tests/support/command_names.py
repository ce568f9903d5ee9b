"""Whether the commands and options that a page or a recipe names exist."""

from __future__ import annotations

import re
import shlex
from typing import Any

CONTROL = ("|", "&", "&&", "||", ";", ">", "<", "2>", "#", "\\")


def complaint(app: Any, text: str) -> str | None:
    """What is wrong with the names of commands and options in a line; ``None`` if nothing is.

    Only names are looked at, so that a synopsis (``fleetloc check CONFIG [--print]``) passes too.
    """
    command = app
    try:
        words = shlex.split(re.sub(r"[\[\]]", " ", text).replace("\\|", "|"), comments=True)
    except ValueError as error:
        return str(error)
    for word in words:
        if word in CONTROL:
            break
        subcommands: dict[str, Any] | None = getattr(command, "commands", None)
        if re.match(r"--?[a-z]", word):
            options = {name for each in command.params for name in (*each.opts, *each.secondary_opts)} | {"--help"}
            if word.partition("=")[0] not in options:
                return f"{command.name} has no option {word}; it has {sorted(options)}"
        elif subcommands is not None:
            for name in re.split(r"[|,]", word.strip("{}")):
                if re.fullmatch(r"[a-z]\w*", name) and name not in subcommands:
                    return f"{command.name} has no command {name}; it has {sorted(subcommands)}"
            command = subcommands.get(word, command)
    return None
