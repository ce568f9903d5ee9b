"""How the daemon ends, for scripts and service managers."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit code of ``fleetloc agent``."""

    OK = 0
    """Stopped by SIGTERM or SIGINT."""
    FAILURE = 1
    """A fault of the program; the log has the trace."""
    USAGE = 2
    """The command line is wrong."""
    CONFIG = 3
    """The configuration cannot be used."""
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
