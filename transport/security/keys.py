"""Signing keys on disk: what is behind ``fleetloc keys init | add | list | rotate``.

One directory per fleet. ``agent_001.key`` holds an agent's secret and belongs on its own drone only;
``agent_001.pub`` its public key, one line each, newest first; every drone has all of these. After a rotation
the public file holds the old key too, so that drones can be brought over one by one: first hand out the
public files, then the secret, then `retire` the old key.

Secrets must be readable by their owner only, and nobody else may be able to write public keys or the
directory, since who can write them decides who is trusted.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from nacl.signing import SigningKey, VerifyKey

from transport.errors import KeyFileError
from transport.link.streams import check_agent_id
from transport.security.auth import fingerprint, public_hex
from transport.security.key_files import check_directory, read_lines, read_text, write_text

_SECRET_TAG = "fleetloc-ed25519-secret-1"
_PUBLIC_TAG = "fleetloc-ed25519-public-1"
_HEX_KEY = re.compile(r"[0-9a-f]{64}")
_PUBLIC_NAME = re.compile(r"agent_([0-9]{3})\.pub")
MAX_PUBLIC_KEYS = 2
MAX_BOOT = 2**32 - 1


@dataclass(frozen=True, slots=True)
class KeyInfo:
    """One agent's keys in a directory; fingerprints newest first, ``has_secret`` if its secret is here."""

    agent_id: int
    fingerprints: tuple[str, ...]
    has_secret: bool


def secret_path(directory: Path, agent_id: int) -> Path:
    """Where an agent's secret is."""
    return directory / f"agent_{check_agent_id(agent_id):03d}.key"


def public_path(directory: Path, agent_id: int) -> Path:
    """Where an agent's public keys are."""
    return directory / f"agent_{check_agent_id(agent_id):03d}.pub"


def init_keys(directory: Path, agent_ids: Iterable[int]) -> list[KeyInfo]:
    """Make the directory (mode 0700) and a key pair for each agent; raises `KeyFileError` if any is there."""
    ids = sorted({check_agent_id(agent_id) for agent_id in agent_ids})
    for agent_id in ids:
        _refuse_existing(directory, agent_id)
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise KeyFileError(f"{directory}: cannot make the key directory: {error.strerror}") from None
    return [add_key(directory, agent_id) for agent_id in ids]


def add_key(directory: Path, agent_id: int) -> KeyInfo:
    """Make a key pair for one more agent; raises `KeyFileError` if it has one already."""
    check_directory(directory)
    _refuse_existing(directory, agent_id)
    signing = SigningKey.generate()
    _write_pair(directory, agent_id, signing, (signing.verify_key,))
    return _info(directory, agent_id)


def rotate_key(directory: Path, agent_id: int) -> KeyInfo:
    """Give an agent a new pair; its present public key stays accepted until `retire_key`."""
    present = load_public_keys(directory, agent_id)
    signing = SigningKey.generate()
    _write_pair(directory, agent_id, signing, (signing.verify_key, present[0]))
    return _info(directory, agent_id)


def retire_key(directory: Path, agent_id: int) -> KeyInfo:
    """Stop accepting an agent's key from before its last rotation."""
    newest = load_public_keys(directory, agent_id)[0]
    write_text(public_path(directory, agent_id), f"{_PUBLIC_TAG} {public_hex(newest)}\n", 0o644)
    return _info(directory, agent_id)


def list_keys(directory: Path) -> list[KeyInfo]:
    """All agents with a public key in the directory, by id."""
    check_directory(directory)
    try:
        names = [_PUBLIC_NAME.fullmatch(name) for name in os.listdir(directory)]
    except OSError as error:
        raise KeyFileError(f"{directory}: cannot be listed: {error.strerror}") from None
    return [_info(directory, agent_id) for agent_id in sorted(int(name[1]) for name in names if name)]


def load_secret(directory: Path, agent_id: int) -> SigningKey:
    """An agent's signing key; raises `KeyFileError` if it is missing, malformed or not private."""
    check_directory(directory)
    path = secret_path(directory, agent_id)
    lines = read_lines(path, forbidden=0o077, remedy=f"chmod 600 {path}")
    if len(lines) != 1:
        raise KeyFileError(f"{path}: {len(lines)} lines, expected 1 with a secret key")
    return SigningKey(_key_bytes(path, lines[0], _SECRET_TAG))


def load_public_keys(directory: Path, agent_id: int) -> tuple[VerifyKey, ...]:
    """An agent's public keys, newest first; raises `KeyFileError`."""
    check_directory(directory)
    path = public_path(directory, agent_id)
    lines = read_lines(path, forbidden=0o022, remedy=f"chmod 644 {path}")
    if not 1 <= len(lines) <= MAX_PUBLIC_KEYS:
        raise KeyFileError(f"{path}: {len(lines)} lines, expected 1 to {MAX_PUBLIC_KEYS} public keys")
    return tuple(VerifyKey(_key_bytes(path, line, _PUBLIC_TAG)) for line in lines)


def load_trust(directory: Path, agent_ids: Iterable[int]) -> dict[int, tuple[VerifyKey, ...]]:
    """Public keys of a whole fleet; raises `KeyFileError` naming the first that cannot be used."""
    return {agent_id: load_public_keys(directory, agent_id) for agent_id in sorted(agent_ids)}


def next_boot(path: Path, unix_s: float) -> int:
    """The number of this start, greater than that of every earlier one, kept in ``path``.

    The greater of the last number plus one and the time: a clock that went back and a lost file are both
    survived, though not both at once. Raises `KeyFileError`, `UnwritableError` if the file cannot be written.
    """
    last = 0
    if os.path.exists(path):
        text = read_text(path).strip()
        if not text.isascii() or not text.isdigit() or int(text) > MAX_BOOT:
            found = text[:20]
            raise KeyFileError(f"{path}: {found!r}, expected the number of the last start; remove the file")
        last = int(text)
    boot = max(last + 1, int(unix_s))
    if boot > MAX_BOOT:
        raise KeyFileError(f"{path}: start numbers are used up at {last}; make new keys and remove the file")
    write_text(path, f"{boot}\n", 0o600)
    return boot


# --- common -------------------------------------------------------------------------------------------------


def _refuse_existing(directory: Path, agent_id: int) -> None:
    for path in (secret_path(directory, agent_id), public_path(directory, agent_id)):
        if os.path.exists(path):
            raise KeyFileError(f"{path} exists already; use `rotate` to replace the key of agent {agent_id}")


def _info(directory: Path, agent_id: int) -> KeyInfo:
    prints = tuple(fingerprint(key) for key in load_public_keys(directory, agent_id))
    return KeyInfo(agent_id, prints, os.path.exists(secret_path(directory, agent_id)))


def _write_pair(
    directory: Path, agent_id: int, signing: SigningKey, public_keys: tuple[VerifyKey, ...]
) -> None:
    # the public file first: were we stopped in between, the old secret still has its public key
    lines = "".join(f"{_PUBLIC_TAG} {public_hex(key)}\n" for key in public_keys)
    write_text(public_path(directory, agent_id), lines, 0o644)
    write_text(secret_path(directory, agent_id), f"{_SECRET_TAG} {signing.encode().hex()}\n", 0o600)


def _key_bytes(path: Path, line: str, tag: str) -> bytes:
    found, _, key = line.partition(" ")
    if found != tag or not _HEX_KEY.fullmatch(key):
        raise KeyFileError(f"{path}: expected a line `{tag}` and 64 hexadecimal digits")
    return bytes.fromhex(key)
