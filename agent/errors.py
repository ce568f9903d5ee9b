"""What the agent raises.

AgentError
├── ConfigError        the configuration is wrong: file, key, what was expected, what was found
├── EndpointError      an address of a MAVLink link cannot be understood
├── LinkError          a MAVLink link cannot be opened (port taken, no such device)
├── NoAutopilotError   no autopilot appeared in time
├── LogFileError        a record cannot be written or read
└── SecurityError      something that the security profile promises is missing
"""

from __future__ import annotations

from transport.errors import KeyFileError

OPENING_FAULTS = (OSError, OverflowError, ValueError)
"""What opening an address, port or path raises: refused by the system, out of range, or no name at all."""


def cause_of(error: Exception) -> str:
    """What is wrong, in the system's words where it has any."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


class AgentError(Exception):
    """Root of everything that the agent raises on purpose."""


class ConfigError(AgentError):
    """A configuration that cannot be used; the message is one line a user can act on.

    ``where`` is the file (``line`` the one in it) or the option that was typed, ``key`` the key in it as people read
    it, e.g. ``agent 1, mavlink`` (empty: the file as a whole); ``meant`` what was probably meant; ``says`` stands in
    place of expected and found where they do not fit; ``more`` mistakes were found beside this one.
    """

    def __init__(
        self,
        where: str,
        key: str,
        expected: str,
        found: str,
        *,
        line: int | None = None,
        meant: str = "",
        says: str = "",
        more: int = 0,
    ) -> None:
        self.where, self.line, self.key = where, line, key
        self.expected, self.found, self.meant, self.says, self.more = expected, found, meant, says, more
        place = where if line is None else f"{where}:{line}"
        sentence = says or f"expected {expected}, found {found}{f'; did you mean {meant}?' if meant else ''}"
        rest = f" (and {more} more: `fleetloc check` shows all)" if more else ""
        super().__init__(": ".join(part for part in (place, key, sentence) if part) + rest)

    def beside(self, more: int) -> ConfigError:
        """The same, saying how many mistakes were found beside it."""
        return ConfigError(
            self.where, self.key, self.expected, self.found,
            line=self.line, meant=self.meant, says=self.says, more=more,
        )  # fmt: skip


class EndpointError(AgentError, ValueError):
    """An address of a MAVLink link that cannot be understood."""


class LinkError(AgentError, OSError):
    """A MAVLink link that cannot be opened."""


class NoAutopilotError(AgentError):
    """No autopilot appeared on the link in time."""


class LogFileError(AgentError):
    """A record that cannot be written or read."""


class SecurityError(AgentError, KeyFileError):
    """Something that the security profile promises is missing; ``faults`` has a line for each."""

    def __init__(self, profile: str, faults: tuple[str, ...]) -> None:
        begin = f"security profile {profile}: "
        super().__init__(begin + (faults[0] if len(faults) == 1 else "missing:\n- " + "\n- ".join(faults)))
        self.profile = profile
        self.faults = faults
