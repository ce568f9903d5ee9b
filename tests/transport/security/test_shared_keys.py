"""Group and MAVLink keys on disk: made, rotated, retired; and files that are not to be trusted."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from transport.errors import KeyFileError
from transport.security.shared_keys import (
    group_path,
    key_fingerprint,
    load_group_keys,
    load_mavlink_key,
    load_mavlink_passphrase,
    make_group_key,
    make_mavlink_key,
    mavlink_path,
    replace_mavlink_key,
    retire_group_key,
    rotate_group_key,
)


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    place = tmp_path / "keys"
    place.mkdir(mode=0o700)
    make_group_key(place)
    make_mavlink_key(place, 1)
    return place


def test_secrets_are_private_and_of_the_right_size(directory: Path) -> None:
    for path in (group_path(directory), mavlink_path(directory, 1)):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [len(key) for key in load_group_keys(directory)] == [32]
    assert len(load_mavlink_key(directory, 1)) == 32


def test_a_rotated_group_key_is_sent_with_first_and_the_old_one_goes_when_it_is_retired(directory: Path) -> None:
    (old,) = load_group_keys(directory)
    rotate_group_key(directory)
    new, still = load_group_keys(directory)
    assert (still, new != old) == (old, True)
    rotate_group_key(directory)
    assert load_group_keys(directory)[1] == new  # never more than two
    newest = load_group_keys(directory)[0]
    retire_group_key(directory)
    assert load_group_keys(directory) == (newest,)


def test_nothing_is_overwritten_unless_it_is_asked_for(directory: Path) -> None:
    with pytest.raises(KeyFileError, match="exists already; use `rotate --group`"):
        make_group_key(directory)
    with pytest.raises(KeyFileError, match="exists already; use `rotate --mavlink`"):
        make_mavlink_key(directory, 1)
    before = load_mavlink_passphrase(directory, 1)
    replace_mavlink_key(directory, 1)
    assert load_mavlink_passphrase(directory, 1) != before


@pytest.mark.parametrize("text", ["", "nonsense\n", "fleetloc-group-secret-1 12\n", "fleetloc-group-secret-1 zz\n"])
def test_malformed_files_are_named(directory: Path, text: str) -> None:
    for path in (group_path(directory), mavlink_path(directory, 1)):
        path.write_text(text)
    with pytest.raises(KeyFileError, match=r"group\.key: .*expected"):
        load_group_keys(directory)
    with pytest.raises(KeyFileError, match=r"agent_001\.mavlink: .*expected"):
        load_mavlink_key(directory, 1)


def test_secrets_that_others_can_read_are_refused(directory: Path) -> None:
    group_path(directory).chmod(0o640)
    with pytest.raises(KeyFileError, match="do `chmod 600"):
        load_group_keys(directory)


def test_a_fingerprint_is_not_the_key(directory: Path) -> None:
    (key,) = load_group_keys(directory)
    assert key_fingerprint(key) not in key.hex()
    assert len(key_fingerprint(key)) == 16
