"""What the agent raises.

AgentError
├── ConfigError        the configuration is wrong: file, key, what was expected, what was found
├── EndpointError      an address of a MAVLink link cannot be understood
├── LinkError          a MAVLink link cannot be opened (port taken, no such device)
├── NoAutopilotError   no autopilot appeared in time
├── RecordError        a record cannot be written or read
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

    ``where`` is the file or override, ``key`` the dotted key, e.g. ``agents[0].mavlink``.
    """

    def __init__(self, where: str, key: str, expected: str, found: str) -> None:
        super().__init__(f"{where}: {key}: expected {expected}, found {found}")
        self.where = where
        self.key = key
        self.expected = expected
        self.found = found


class EndpointError(AgentError, ValueError):
    """An address of a MAVLink link that cannot be understood."""


class LinkError(AgentError, OSError):
    """A MAVLink link that cannot be opened."""


class NoAutopilotError(AgentError):
    """No autopilot appeared on the link in time."""


class RecordError(AgentError):
    """A record that cannot be written or read."""


class SecurityError(AgentError, KeyFileError):
    """Something that the security profile promises is missing; ``faults`` has a line for each."""

    def __init__(self, profile: str, faults: tuple[str, ...]) -> None:
        begin = f"security profile {profile}: "
        super().__init__(begin + (faults[0] if len(faults) == 1 else "missing:\n- " + "\n- ".join(faults)))
        self.profile = profile
        self.faults = faults
