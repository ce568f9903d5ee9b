"""Key files: made, listed, rotated, retired; and every way in which they are not to be trusted."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest
from nacl.signing import SigningKey

from transport.errors import KeyFileError, Rejected, SettingsError, UnwritableError
from transport.security.auth import fingerprint, sign, verify
from transport.security.key_files import write_text
from transport.security.keys import (
    add_key,
    init_keys,
    list_keys,
    load_public_keys,
    load_secret,
    load_trust,
    next_boot,
    public_path,
    retire_key,
    rotate_key,
    secret_path,
)


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    place = tmp_path / "keys"
    init_keys(place, [1, 2])
    return place


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def accepts(directory: Path, agent_id: int, signing: SigningKey) -> bool:
    header, body = bytes(40), b"body"
    packet = header + body + sign(signing, "key", header, body)
    try:
        verify(load_public_keys(directory, agent_id), "key", packet)
    except Rejected:
        return False
    return True


def test_made_keys_are_private_from_the_first_moment_and_fit_each_other(directory: Path) -> None:
    assert (mode(directory), mode(secret_path(directory, 1)), mode(public_path(directory, 1))) == (
        0o700, 0o600, 0o644,
    )  # fmt: skip
    assert accepts(directory, 1, load_secret(directory, 1))
    assert not accepts(directory, 1, load_secret(directory, 2))
    assert sorted(load_trust(directory, [2, 1])) == [1, 2]
    assert sorted(path.name for path in directory.iterdir()) == [
        "agent_001.key", "agent_001.pub", "agent_002.key", "agent_002.pub",
    ]  # fmt: skip


def test_listing_says_whose_secrets_are_here(directory: Path) -> None:
    secret_path(directory, 2).unlink()
    infos = list_keys(directory)
    assert [(info.agent_id, info.has_secret) for info in infos] == [(1, True), (2, False)]
    assert infos[0].fingerprints == (fingerprint(load_secret(directory, 1).verify_key),)


def test_adding_never_overwrites(directory: Path) -> None:
    assert add_key(directory, 3).agent_id == 3
    before = secret_path(directory, 3).read_bytes()
    with pytest.raises(KeyFileError, match=r"agent_003\.key exists already; use `rotate`"):
        add_key(directory, 3)
    with pytest.raises(KeyFileError, match=r"agent_003\.key exists already"):
        init_keys(directory, [4, 3])
    assert secret_path(directory, 3).read_bytes() == before
    assert not secret_path(directory, 4).exists()


def test_rotation_keeps_the_fleet_talking(directory: Path) -> None:
    old = load_secret(directory, 1)
    # WHEN a key is rotated THEN old and new are accepted
    assert len(rotate_key(directory, 1).fingerprints) == 2
    new = load_secret(directory, 1)
    assert new != old
    assert accepts(directory, 1, new)
    assert accepts(directory, 1, old)
    # until the old one is retired
    assert retire_key(directory, 1).fingerprints == (fingerprint(new.verify_key),)
    assert accepts(directory, 1, new)
    assert not accepts(directory, 1, old)
    # and never more than two
    rotate_key(directory, 1)
    assert len(rotate_key(directory, 1).fingerprints) == 2
    assert not accepts(directory, 1, new)


@pytest.mark.parametrize("bits", [0o640, 0o604, 0o660, 0o644])
def test_a_secret_that_others_can_read_is_not_used(directory: Path, bits: int) -> None:
    path = secret_path(directory, 1)
    path.chmod(bits)
    with pytest.raises(KeyFileError, match=rf"mode 0{bits:o} lets others at it; do `chmod 600 {path}`"):
        load_secret(directory, 1)


def test_public_keys_that_others_can_write_are_not_trusted(directory: Path) -> None:
    public_path(directory, 1).chmod(0o664)
    with pytest.raises(KeyFileError, match="mode 0664 lets others at it"):
        load_trust(directory, [1])
    public_path(directory, 1).chmod(0o644)
    directory.chmod(0o777)
    with pytest.raises(KeyFileError, match="mode 0777 lets others at it; do `chmod 700"):
        load_trust(directory, [1])


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_keys_of_another_user_are_not_used(directory: Path) -> None:
    os.chown(secret_path(directory, 1), 12345, -1)
    with pytest.raises(KeyFileError, match="belongs to user 12345"):
        load_secret(directory, 1)


@pytest.mark.parametrize(
    "text", ["", "\n", "fleetloc-ed25519-secret-1 00\n", "x " + "0" * 64, "fleetloc-ed25519-secret-1 " + "g" * 64]
)
def test_malformed_files_are_named(directory: Path, text: str) -> None:
    path = secret_path(directory, 1)
    path.write_text(text)
    with pytest.raises(KeyFileError, match=rf"{path}: .*expected"):
        load_secret(directory, 1)
    public_path(directory, 1).write_text(text)
    with pytest.raises(KeyFileError, match=r"agent_001\.pub: .*expected"):
        load_public_keys(directory, 1)


def test_a_secret_in_place_of_a_public_key_is_refused(directory: Path) -> None:
    public_path(directory, 1).write_text(secret_path(directory, 1).read_text())
    with pytest.raises(KeyFileError, match="expected a line `fleetloc-ed25519-public-1`"):
        load_public_keys(directory, 1)


def test_binary_and_missing_files_are_named(directory: Path, tmp_path: Path) -> None:
    secret_path(directory, 1).write_bytes(b"\xff\x00")
    with pytest.raises(KeyFileError, match=r"agent_001\.key: not a text file"):
        load_secret(directory, 1)
    with pytest.raises(KeyFileError, match=r"agent_009\.key: no such key file; make it with"):
        load_secret(directory, 9)
    with pytest.raises(KeyFileError, match=r"agent_009\.pub: no such key file"):
        rotate_key(directory, 9)
    with pytest.raises(KeyFileError, match="no such key directory; make one with `fleetloc keys init`"):
        list_keys(tmp_path / "nowhere")
    with pytest.raises(SettingsError, match="agent id 0"):
        add_key(directory, 0)
    (tmp_path / "file").write_text("")
    with pytest.raises(KeyFileError, match="cannot make the key directory"):
        init_keys(tmp_path / "file", [1])


def test_starts_are_numbered_upwards_whatever_the_clock_does(tmp_path: Path) -> None:
    path = tmp_path / "boot"
    assert next_boot(path, 1000.9) == 1000
    assert next_boot(path, 1000.9) == 1001
    assert next_boot(path, 10.0) == 1002
    assert next_boot(path, 2000.0) == 2000
    path.unlink()
    assert next_boot(path, 2001.0) == 2001


def test_a_full_disk_leaves_the_last_start_number_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN the number of a start, and a disk that has filled up since
    path = tmp_path / "boot"
    next_boot(path, 1000.0)

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full)
        with pytest.raises(UnwritableError, match=r"boot: cannot be written: No space left on device"):
            next_boot(path, 1000.0)
    # THEN the number is as it was, no file was left behind, and the start after the next tidying up counts on
    assert [file.name for file in tmp_path.iterdir()] == ["boot"]
    assert next_boot(path, 1000.0) == 1001


def test_a_spoilt_start_number_is_named(tmp_path: Path) -> None:
    path = tmp_path / "boot"
    for text in ("", "-1", "x", "9" * 12):
        path.write_text(text)
        with pytest.raises(KeyFileError, match="expected the number of the last start"):
            next_boot(path, 1.0)
    path.write_text(str(2**32 - 1))
    with pytest.raises(KeyFileError, match="used up"):
        next_boot(path, 1.0)
    with pytest.raises(KeyFileError, match="cannot be written"):
        next_boot(tmp_path / "nowhere" / "boot", 1.0)


def test_a_file_planted_where_a_key_is_about_to_be_written_is_not_written_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN somebody who plants a link right after the temporary file's place was cleared
    secret, elsewhere = tmp_path / "agent_001.key", tmp_path / "elsewhere"
    elsewhere.write_text("untouched")
    cleared = Path.unlink

    def clear_and_plant(path: Path, missing_ok: bool = False) -> None:
        cleared(path, missing_ok=missing_ok)
        path.symlink_to(elsewhere)

    monkeypatch.setattr(Path, "unlink", clear_and_plant)
    with pytest.raises(UnwritableError, match=r"agent_001\.key"):
        write_text(secret, "secret", 0o600)
    assert elsewhere.read_text() == "untouched"
    assert not secret.exists()


def test_a_secret_is_private_before_anything_is_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # GIVEN a process that lets everybody read what it makes
    found: list[tuple[int, int]] = []
    make_private = os.fchmod

    def look_first(descriptor: int, bits: int) -> None:
        status = os.fstat(descriptor)
        found.append((stat.S_IMODE(status.st_mode), status.st_size))
        make_private(descriptor, bits)

    monkeypatch.setattr(os, "fchmod", look_first)
    before = os.umask(0)
    try:
        write_text(tmp_path / "agent_001.key", "secret", 0o600)
    finally:
        os.umask(before)
    assert found == [(0o600, 0)]
