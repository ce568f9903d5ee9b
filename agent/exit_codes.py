"""How every command of fleetloc ends, for scripts and service managers: one number, one meaning."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of ``fleetloc``; 4 to 9 are the daemon's own, finer words for 2 and 3."""

    OK = 0
    """Done; of a daemon: stopped by SIGTERM or SIGINT."""
    FAILURE = 1
    """The run failed; or a fault of the program, whose trace is on stderr."""
    BAD_INPUT = 2
    """The command line, the configuration or another file cannot be used; the line says what was expected."""
    REFUSED = 3
    """The machine refuses: a file, port or device cannot be opened, a peer never appeared."""
    LINK = 4
    """The autopilot's link, the health socket or the metrics' port cannot be opened: taken, no such device."""
    KEYS = 5
    """A key file is missing, malformed or readable by others."""
    SESSION = 6
    """The session with the other agents cannot be opened: port taken, address not ours."""
    NO_AUTOPILOT = 7
    """No autopilot appeared within ``mavlink.appear_timeout_s``."""
    RECORD = 8
    """The record cannot be written."""
    STATE = 9
    """What has to outlive a restart cannot be written (a full disk); worth another try."""
    INTERRUPTED = 130
    """Ctrl-C."""
