"""What the profiles promise, and that nothing starts while any of it is missing; bundles for single drones."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.config.reading import load_config
from agent.daemon import run
from agent.errors import SecurityError
from agent.exit_codes import ExitCode
from agent.radio.security import (
    agents_here,
    credentials,
    expiry_warnings,
    new_salt,
    observer_credentials,
    observer_faults,
    require,
    security_faults,
    signs_mavlink,
    stamp_file,
    state_warnings,
)
from estimators.factory import make_estimator
from fleetloc import cli
from tests.security.conftest import PROFILES, MakeFleet
from transport.errors import KeyFileError
from transport.security.auth import UNSIGNED
from transport.security.shared_keys import load_mavlink_key

DAY_S = 86_400.0


def folder_of(base: Path, profile: str) -> Path:
    return base / "keys" / profile


@pytest.mark.parametrize("profile", ["lab", "field", "lossy_field"])
def test_with_the_keys_that_the_command_makes_nothing_is_missing(make_fleet: MakeFleet, profile: str) -> None:
    config, base = make_fleet(profile)
    for agent_id in config.ids:
        assert security_faults(config, agent_id, base, unix_s=time.time()) == []
    assert observer_faults(config, base, unix_s=time.time()) == []


@pytest.mark.parametrize("profile", ["lab", "field", "lossy_field"])
def test_without_keys_the_folder_is_what_is_missing(make_fleet: MakeFleet, profile: str) -> None:
    config, base = make_fleet(profile, keys=False)
    (fault,) = security_faults(config, 1, base, unix_s=time.time())
    assert fault == f"{folder_of(base, profile)}: no such key directory; make one with `fleetloc keys init`"


NEEDED = {
    "field": ("agent_001.key", "agent_003.pub", "ca.pem", "agent_001.pem", "agent_001.tls", "agent_001.mavlink"),
    "lossy_field": ("agent_001.key", "agent_003.pub", "group.key", "agent_001.mavlink"),
}


@pytest.mark.parametrize(("profile", "name"), [(p, name) for p, names in NEEDED.items() for name in names])
def test_each_missing_file_is_named_with_a_remedy(make_fleet: MakeFleet, profile: str, name: str) -> None:
    config, base = make_fleet(profile)
    (folder_of(base, profile) / name).unlink()
    (fault,) = security_faults(config, 1, base, unix_s=time.time())
    assert fault.startswith(f"{folder_of(base, profile) / name}: no such")
    assert "fleetloc keys" in fault
    with pytest.raises(SecurityError, match=name):
        require(config, 1, base, unix_s=time.time())


@pytest.mark.parametrize("name", ["agent_001.key", "agent_001.tls", "agent_001.mavlink"])
def test_secrets_that_others_can_read_are_refused(make_fleet: MakeFleet, name: str) -> None:
    config, base = make_fleet("field")
    (folder_of(base, "field") / name).chmod(0o644)
    (fault,) = security_faults(config, 1, base, unix_s=time.time())
    assert "mode 0644 lets others at it; do `chmod 600" in fault


def test_several_things_missing_have_a_line_each(make_fleet: MakeFleet) -> None:
    config, base = make_fleet("field")
    for name in ("agent_001.key", "agent_001.mavlink", "agent_001.pem"):
        (folder_of(base, "field") / name).unlink()
    with pytest.raises(SecurityError) as caught:
        require(config, 1, base, unix_s=time.time())
    assert len(caught.value.faults) == 3
    assert str(caught.value).startswith("security profile field: missing:\n- ")


@pytest.mark.parametrize(
    ("profile", "override", "says"),
    [
        ("field", "security.mode=unsigned", 'security.mode: expected "signed" in profile field'),
        ("lossy_field", "security.mode=unsigned", 'security.mode: expected "signed" in profile lossy_field'),
        ("field", 'agents.1.listen=["tcp/10.0.0.1:7447"]', "expected tls/HOST:PORT in profile field"),
        ("field", 'agents.1.listen=["udp/224.0.0.225:7447"]', "expected tls/HOST:PORT in profile field"),
        ("field", 'agents.1.connect=["tcp/10.0.0.1:7447"]', "agents.1.connect: 'tcp/10.0.0.1:7447'"),
        ("lossy_field", 'agents.1.listen=["tls/10.0.0.1:7447"]', "field is the one with TLS"),
        ("lab", "security.encrypt=true", 'expected security.mode = "signed" with it'),
    ],
)
def test_settings_against_the_profile_are_named(
    make_fleet: MakeFleet, profile: str, override: str, says: str
) -> None:
    extra = {"lab": ["security.mode=unsigned"], "lossy_field": ["transport.link=tcp"], "field": []}[profile]
    config, base = make_fleet(profile, override, *extra)
    faults = security_faults(config, 1, base, unix_s=time.time())
    assert any(says in fault for fault in faults), faults


@pytest.mark.parametrize(
    ("override", "link", "says", "signed"),
    [
        ("off", "udpin:192.168.7.3:14550", "which leaves the machine", False),
        ("off", "udpin:0.0.0.0:14550", "which leaves the machine", False),
        ("off", "udpin:127.0.0.1:14550", "", False),
        ("auto", "serial:/dev/ttyAMA0:921600", "", False),
        ("auto", "udpin:192.168.7.3:14550", "", True),
        ("on", "serial:/dev/ttyAMA0:921600", "", True),
    ],
)
def test_mavlink_is_signed_unless_it_stays_on_the_machine(
    make_fleet: MakeFleet, override: str, link: str, says: str, signed: bool
) -> None:
    config, base = make_fleet("field", f"mavlink.signing={override}", f"agents.1.mavlink={link}")
    faults = security_faults(config, 1, base, unix_s=time.time())
    assert [says in fault for fault in faults] == ([True] if says else [])
    assert signs_mavlink(config, 1) is signed


def test_certificates_out_of_date_or_for_other_addresses(make_fleet: MakeFleet) -> None:
    config, base = make_fleet("field")
    now_s = time.time()
    (late,) = security_faults(config, 1, base, unix_s=now_s + 91 * DAY_S)
    assert "agent_001.pem: valid from" in late
    assert expiry_warnings(config, 1, base, unix_s=now_s) == []
    (warning,) = expiry_warnings(config, 1, base, unix_s=now_s + 80 * DAY_S)
    assert "agent_001.pem: expires on" in warning
    early = security_faults(config, 1, base, unix_s=now_s - 2 * DAY_S)
    assert [fault.partition(":")[0][-6:] for fault in early] == ["01.pem", "ca.pem"]
    moved = load_config(base / "fleet.toml", ["agents.1.radio=10.1.2.3"])
    (elsewhere,) = security_faults(moved, 1, base, unix_s=now_s)
    assert "does not name 10.1.2.3" in elsewhere
    assert "fleetloc keys rotate --id 1" in elsewhere


def test_another_drones_certificate_is_refused(make_fleet: MakeFleet) -> None:
    config, base = make_fleet("field")
    folder = folder_of(base, "field")
    for suffix in ("pem", "tls"):
        (folder / f"agent_002.{suffix}").replace(folder / f"agent_001.{suffix}")
    faults = security_faults(config, 1, base, unix_s=time.time())
    assert any("common name 'field.agent.002', expected 'field.agent.001'" in fault for fault in faults)


def test_the_daemon_refuses_to_start(make_fleet: MakeFleet, caplog: pytest.LogCaptureFixture) -> None:
    config, base = make_fleet("field")
    (folder_of(base, "field") / "agent_001.pem").unlink()
    assert run(config, 1, make_estimator, base=base) is ExitCode.KEYS
    assert "agent_001.pem: no such certificate" in caplog.records[-1].getMessage()


def test_a_start_number_that_cannot_be_written_is_no_fault_of_the_keys(
    make_fleet: MakeFleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A service manager tries again: the disk may have room then."""
    config, base = make_fleet("lossy_field", "mavlink.appear_timeout_s=0.1")

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert run(config, 1, make_estimator, base=base) is ExitCode.STATE
    assert "agent_001.boot: cannot be written: No space left on device" in caplog.records[-1].getMessage()


def test_what_outlives_a_restart_can_be_kept_outside_a_folder_of_keys_that_is_read_only(
    make_fleet: MakeFleet, tmp_path: Path
) -> None:
    config, base = make_fleet("field", f"security.state={tmp_path}")
    before = sorted(path.name for path in folder_of(base, "field").iterdir())
    now_s = time.time()
    first, second = (credentials(config, 1, base, unix_s=now_s, salt=new_salt()).boot for _ in range(2))
    assert second == first + 1
    assert (tmp_path / "agent_001.boot").exists()
    assert stamp_file(config, 1, base).path.parent == tmp_path
    assert sorted(path.name for path in folder_of(base, "field").iterdir()) == before


def test_lab_is_unsigned_only_when_asked_for(make_fleet: MakeFleet) -> None:
    config, base = make_fleet("lab", "security.mode=unsigned", keys=False)
    own = credentials(config, 1, base, unix_s=time.time(), salt=new_salt())
    assert (own.signing, own.trust, own.envelopes) == (UNSIGNED, UNSIGNED, None)
    assert load_config(PROFILES / "lab.toml").security.mode == "signed"


def test_check_says_what_is_missing(make_fleet: MakeFleet, capsys: pytest.CaptureFixture[str]) -> None:
    _, base = make_fleet("field")
    file = str(base / "fleet.toml")
    assert cli.main(["check", file]) == 0
    (folder_of(base, "field") / "agent_002.tls").unlink()
    (folder_of(base, "field") / "agent_003.mavlink").unlink()
    capsys.readouterr()
    assert cli.main(["check", file]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.startswith(f"fleetloc: error: {file}: security: ") for line in lines] == [True, True]
    assert ["agent_002.tls: no such" in lines[0], "agent_003.mavlink: no such" in lines[1]] == [True, True]
    assert cli.main(["check", file, "--id", "1"]) == 0


# --- bundles ------------------------------------------------------------------------------------------------


def test_a_drone_gets_what_it_needs_and_nothing_else(
    make_fleet: MakeFleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, base = make_fleet("field", "security.encrypt=true")
    out = tmp_path / "drone2" / "keys" / "field"
    assert cli.main(["keys", "export", str(base / "fleet.toml"), "--id", "2", "--out", str(out)]) == 0
    secrets = {path.name for path in out.iterdir() if stat.S_IMODE(path.stat().st_mode) == 0o600}
    assert secrets == {"agent_002.key", "agent_002.tls", "agent_002.mavlink", "group.key"}
    public = {"agent_001.pub", "agent_002.pub", "agent_003.pub", "agent_002.pem", "ca.pem"}
    assert {path.name for path in out.iterdir()} == secrets | public
    assert stat.S_IMODE(out.stat().st_mode) == 0o700
    drone = tmp_path / "drone2"
    assert security_faults(config, 2, drone, unix_s=time.time()) == []
    assert security_faults(config, 1, drone, unix_s=time.time()) != []
    assert agents_here(config, drone) == (2,)
    assert agents_here(config, base) == config.ids
    assert cli.main(["keys", "export", str(base / "fleet.toml"), "--id", "2", "--out", str(out)]) == 2
    assert "expected a folder that does not exist yet" in capsys.readouterr().err


def test_an_observer_gets_no_signing_key(make_fleet: MakeFleet, tmp_path: Path) -> None:
    config, base = make_fleet("field")
    out = tmp_path / "laptop" / "keys" / "field"
    assert cli.main(["keys", "export", str(base / "fleet.toml"), "--observer", "--out", str(out)]) == 0
    assert not [path.name for path in out.iterdir() if path.suffix in (".key", ".mavlink") and "agent" in path.name]
    trust, envelopes = observer_credentials(config, tmp_path / "laptop", unix_s=time.time())
    assert isinstance(trust, dict)
    assert sorted(trust) == [1, 2, 3]
    assert envelopes is None


# --- the command --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "check"),
    [
        (("rotate", "--group"), lambda lines: lines[-1].startswith("group  key ") and "  former key " in lines[-1]),
        (("rotate", "--observer"), lambda lines: "observer valid until" in lines[-2]),
        (("rotate", "--id", "2", "--days", "5"), lambda lines: "certificate expires soon, on" in lines[1]),
    ],
)
def test_keys_are_replaced(
    make_fleet: MakeFleet,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    check: Callable[[list[str]], bool],
) -> None:
    config, base = make_fleet("field", "security.encrypt=true")
    command, *options = arguments
    assert cli.main(["keys", command, str(base / "fleet.toml"), *options]) == 0
    assert check(capsys.readouterr().out.splitlines())
    for agent_id in config.ids:
        assert security_faults(config, agent_id, base, unix_s=time.time()) == []


def test_rotating_takes_one_thing_at_a_time(make_fleet: MakeFleet, capsys: pytest.CaptureFixture[str]) -> None:
    _, base = make_fleet("field")
    assert cli.main(["keys", "rotate", str(base / "fleet.toml"), "--group", "--id", "1"]) == 2
    assert "expected one of --id, --group, --observer" in capsys.readouterr().err


def test_older_key_folders_are_completed(make_fleet: MakeFleet, capsys: pytest.CaptureFixture[str]) -> None:
    config, base = make_fleet("field")
    folder = folder_of(base, "field")
    kept = (folder / "agent_001.key").read_text()
    for path in folder.iterdir():
        if path.suffix not in (".key", ".pub") or path.stem in ("ca", "group"):
            path.unlink()
    assert cli.main(["keys", "init", str(base / "fleet.toml"), "--missing"]) == 0
    capsys.readouterr()
    assert (folder / "agent_001.key").read_text() == kept
    assert security_faults(config, 1, base, unix_s=time.time()) == []


def test_the_passphrase_is_what_the_key_is_made_of(
    make_fleet: MakeFleet, capsys: pytest.CaptureFixture[str]
) -> None:
    _, base = make_fleet("field")
    assert cli.main(["keys", "passphrase", str(base / "fleet.toml"), "--id", "3"]) == 0
    text = capsys.readouterr().out.strip()
    assert hashlib.sha256(text.encode()).digest() == load_mavlink_key(folder_of(base, "field"), 3)


def test_the_state_folder_is_made_where_only_itself_is_missing(make_fleet: MakeFleet) -> None:
    config, base = make_fleet("lab", "security.state=state")
    assert state_warnings(config, base) == []
    own = credentials(config, 1, base, unix_s=time.time(), salt=new_salt())
    assert stat.S_IMODE((base / "state").stat().st_mode) == 0o700
    assert (base / "state" / "agent_001.boot").read_text() == f"{own.boot}\n"


def test_a_state_folder_without_a_place_is_named(make_fleet: MakeFleet, capsys: pytest.CaptureFixture[str]) -> None:
    config, base = make_fleet("lab", "security.state=run/state")
    with pytest.raises(KeyFileError, match=f"security.state: {base}/run, in which it would be made, is not there"):
        credentials(config, 1, base, unix_s=time.time(), salt=new_salt())
    assert cli.main(["check", str(base / "fleet.toml"), "--set", "security.state=run/state"]) == 0
    assert f"warning: security.state: neither {base}/run/state nor the folder" in capsys.readouterr().err
