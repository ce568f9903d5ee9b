"""Secrets that two sides share: the fleet's group key, and the key of each drone's MAVLink link.

``group.key`` encrypts payloads: one line, or two after a rotation, the one to send with first; the other is
still accepted. Whoever holds it is inside; who of the fleet sent a packet is what signatures say.

``agent_001.mavlink`` holds a passphrase, since that is what ground stations ask for when they set signing up on
an autopilot; the key of MAVLink 2 is its SHA-256, as MAVProxy and Mission Planner make it.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from pathlib import Path

from transport.errors import KeyFileError
from transport.link.streams import check_agent_id
from transport.security.key_files import OTHERS, PRIVATE, check_directory, read_lines, write_text

KEY_BYTES = 32
MAX_GROUP_KEYS = 2
_GROUP_TAG = "fleetloc-group-secret-1"
_MAVLINK_TAG = "fleetloc-mavlink-passphrase-1"
_HEX = re.compile(r"[0-9a-f]{64}")


def group_path(directory: Path) -> Path:
    """Where the group key is."""
    return directory / "group.key"


def mavlink_path(directory: Path, agent_id: int) -> Path:
    """Where the passphrase of an agent's MAVLink link is."""
    return directory / f"agent_{check_agent_id(agent_id):03d}.mavlink"


def make_group_key(directory: Path) -> None:
    """Make the fleet's group key; raises `KeyFileError` if there is one."""
    _refuse_existing(group_path(directory), "rotate --group")
    _write_group(directory, (secrets.token_bytes(KEY_BYTES),))


def rotate_group_key(directory: Path) -> None:
    """Send with a new group key from now on; the present one is accepted until `retire_group_key`."""
    _write_group(directory, (secrets.token_bytes(KEY_BYTES), load_group_keys(directory)[0]))


def retire_group_key(directory: Path) -> None:
    """Stop accepting the group key from before the last rotation."""
    _write_group(directory, load_group_keys(directory)[:1])


def load_group_keys(directory: Path) -> tuple[bytes, ...]:
    """The group keys of 32 bytes, the one to send with first; raises `KeyFileError`."""
    check_directory(directory)
    path = group_path(directory)
    lines = read_lines(path, forbidden=OTHERS, remedy=f"chmod 600 {path}")
    if not 1 <= len(lines) <= MAX_GROUP_KEYS:
        raise KeyFileError(f"{path}: {len(lines)} lines, expected 1 to {MAX_GROUP_KEYS} group keys")
    return tuple(bytes.fromhex(_digits(path, line, _GROUP_TAG)) for line in lines)


def make_mavlink_key(directory: Path, agent_id: int) -> None:
    """Make the passphrase of an agent's MAVLink link; raises `KeyFileError` if there is one."""
    _refuse_existing(mavlink_path(directory, agent_id), "rotate --mavlink")
    replace_mavlink_key(directory, agent_id)


def replace_mavlink_key(directory: Path, agent_id: int) -> None:
    """Give an agent's MAVLink link a new passphrase; its autopilot has to be told."""
    check_directory(directory)
    path = mavlink_path(directory, agent_id)
    write_text(path, f"{_MAVLINK_TAG} {secrets.token_hex(KEY_BYTES)}\n", PRIVATE)


def load_mavlink_passphrase(directory: Path, agent_id: int) -> str:
    """What to type into a ground station to set signing up on the autopilot; raises `KeyFileError`."""
    check_directory(directory)
    path = mavlink_path(directory, agent_id)
    lines = read_lines(path, forbidden=OTHERS, remedy=f"chmod 600 {path}")
    if len(lines) != 1:
        raise KeyFileError(f"{path}: {len(lines)} lines, expected 1 with a passphrase")
    return _digits(path, lines[0], _MAVLINK_TAG)


def load_mavlink_key(directory: Path, agent_id: int) -> bytes:
    """The 32 bytes that sign an agent's MAVLink frames; raises `KeyFileError`."""
    return hashlib.sha256(load_mavlink_passphrase(directory, agent_id).encode("ascii")).digest()


def key_fingerprint(key: bytes) -> str:
    """Sixteen hexadecimal digits that tell secrets apart for people and give nothing of them away."""
    return hashlib.blake2b(key, digest_size=8, person=b"fleetloc").hexdigest()


def _refuse_existing(path: Path, command: str) -> None:
    check_directory(path.parent)
    if os.path.exists(path):
        raise KeyFileError(f"{path} exists already; use `{command}` to replace it")


def _write_group(directory: Path, keys: tuple[bytes, ...]) -> None:
    check_directory(directory)
    write_text(group_path(directory), "".join(f"{_GROUP_TAG} {key.hex()}\n" for key in keys), PRIVATE)


def _digits(path: Path, line: str, tag: str) -> str:
    found, _, digits = line.partition(" ")
    if found != tag or not _HEX.fullmatch(digits):
        raise KeyFileError(f"{path}: expected a line `{tag}` and 64 hexadecimal digits")
    return digits
