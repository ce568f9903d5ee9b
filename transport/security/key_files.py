"""Files that hold keys: written whole and with their permissions, read only where nobody else gets at them.

Asked for with `os.path`, which answers "no" where `Path` raises for what we may not see.
"""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

from transport.errors import KeyFileError, UnwritableError

PRIVATE, PUBLIC = 0o600, 0o644
"""Permissions of secrets and of what everybody may read."""
OTHERS, OTHERS_WRITE = 0o077, 0o022
"""Permissions that others may not have on secrets, and on what everybody may read."""


def write_text(path: Path, text: str, mode: int) -> None:
    """Replace a file as a whole, with its mode from the first moment on; raises `UnwritableError`."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.unlink(missing_ok=True)
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            os.fchmod(descriptor, mode)
            file.write(text)
            file.flush()
            os.fsync(descriptor)
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):  # what is wrong is said below
            temporary.unlink(missing_ok=True)
        raise UnwritableError(f"{path}: cannot be written: {error.strerror}") from None


def check_directory(directory: Path) -> None:
    """Refuse a key directory that is not there or that others may write to; raises `KeyFileError`."""
    if not os.path.isdir(directory):
        raise KeyFileError(f"{directory}: no such key directory; make one with `fleetloc keys init`")
    check_mode(directory, forbidden=OTHERS_WRITE, remedy=f"chmod 700 {directory}")


def check_mode(path: Path, *, forbidden: int, remedy: str) -> None:
    """Refuse a file of another user, or with one of the ``forbidden`` permissions; raises `KeyFileError`."""
    status = path.stat()
    if status.st_uid not in (os.geteuid(), 0):
        raise KeyFileError(f"{path}: belongs to user {status.st_uid}, expected {os.geteuid()} or root")
    if status.st_mode & forbidden:
        mode = stat.S_IMODE(status.st_mode)
        raise KeyFileError(f"{path}: mode {mode:04o} lets others at it; do `{remedy}`")


def read_lines(path: Path, *, forbidden: int, remedy: str) -> list[str]:
    """The lines of a key file with the right permissions; raises `KeyFileError`."""
    if not os.path.isfile(path):
        raise KeyFileError(f"{path}: no such key file; make it with `fleetloc keys init --missing` or copy it here")
    check_mode(path, forbidden=forbidden, remedy=remedy)
    return read_text(path).splitlines()


def read_text(path: Path) -> str:
    """What is in a file of ASCII text; raises `KeyFileError`."""
    try:
        return path.read_text(encoding="ascii")
    except UnicodeDecodeError:
        raise KeyFileError(f"{path}: not a text file") from None
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}") from None
