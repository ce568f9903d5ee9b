"""What commands raise on purpose, and the exit codes of ``fleetloc``.

FleetlocError          exit code 1
├── InputError         2: a file or an option cannot be used
└── EnvironmentFault   3: the machine refuses (port taken, no such device, nobody answers)

`agent.exit_codes.ExitCode` says what each number means, for all commands.

An error class of another room may carry its own ``exit_code``; without one it is bad input (2), or the
machine's refusal (3) where it is an ``OSError``.
"""

from __future__ import annotations

from agent.exit_codes import ExitCode

FAILED: int = ExitCode.FAILURE
BAD_INPUT: int = ExitCode.BAD_INPUT
REFUSED: int = ExitCode.REFUSED
INTERRUPTED: int = ExitCode.INTERRUPTED


class FleetlocError(Exception):
    """Root of everything that commands raise on purpose; the message is one line a user can act on."""

    exit_code = FAILED


class InputError(FleetlocError):
    """A file or an option that cannot be used.

    ``where`` is the file or option, ``key`` the place in it (may be empty).
    """

    exit_code = BAD_INPUT

    def __init__(self, where: str, key: str, expected: str, found: str) -> None:
        place = f"{where}: {key}" if key else where
        super().__init__(f"{place}: expected {expected}, found {found}")


class EnvironmentFault(FleetlocError):
    """The machine or a peer does not give what the command needs."""

    exit_code = REFUSED
