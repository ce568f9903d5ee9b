"""Packets that were taken before a restart are not taken after it."""

from __future__ import annotations

from pathlib import Path

import pytest
from nacl.signing import SigningKey

from agent.radio.earlier_packets import EarlierPackets
from agent.watch.health import Health, State
from agent.watch.observers import DaemonState
from transport.errors import KeyFileError
from transport.link.streams import Stream, key_expression
from transport.messages.measurement_body import Measurements
from transport.security.opening import Opener
from transport.security.sealing import Sealer

KEYS = {agent: SigningKey(bytes([agent]) * 32) for agent in (1, 2)}
TRUST = {agent: (key.verify_key,) for agent, key in KEYS.items()}
STATE = DaemonState(1, 0.0, Health(State.OK, ()), {}, {}, {})


def packets(sealer: Sealer, first_tick: int) -> list[bytes]:
    return [sealer.seal(Measurements(tick, ()), t_ns=0)[0].data for tick in range(first_tick, first_tick + 100)]


def opener() -> Opener:
    return Opener("test", (1, 2), TRUST, own_id=1)


async def test_what_was_taken_before_a_restart_is_refused_after_it_and_nothing_else(tmp_path: Path) -> None:
    # GIVEN a daemon that has taken packets of its neighbour, and ends
    path, sealer, first = tmp_path / "agent_001.seen", Sealer("test", 2, boot=7, signing=KEYS[2]), opener()
    key, old = key_expression("test", 2, Stream.MEAS), packets(sealer, 1000)
    kept = EarlierPackets(path, "test", lambda: first.replay.state)
    assert not any(kept.has(data) for data in old)
    assert all(first.open(key, data, now=0.0, unix_ns=0) for data in old)
    await kept.close(STATE)
    assert path.stat().st_mode & 0o777 == 0o600
    # WHEN the next one is sent the same again
    second = opener()
    again = EarlierPackets(path, "test", lambda: second.replay.state)
    assert all(again.has(data) for data in old)
    assert again.refused == len(old)
    # THEN what is new is taken, of this life of the neighbour and of its next one
    assert not any(again.has(data) for data in packets(sealer, 2000))
    assert not any(again.has(data) for data in packets(Sealer("test", 2, boot=8, signing=KEYS[2]), 3000))
    assert all(again.has(data) for data in packets(Sealer("test", 2, boot=6, signing=KEYS[2]), 3000))
    assert not again.has(b"")
    assert not again.has(old[0][:40])
    # AND a daemon that heard nothing forgets nothing
    await again.close(STATE)
    assert all(EarlierPackets(path, "test", dict).has(data) for data in old)


def test_a_damaged_file_is_said_and_begun_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "agent_001.seen"
    for text in ("", "{", '[{"sender":1}]', '[{"sender":1,"kind":99,"boot":1,"newest":1,"window":"1"}]'):
        path.write_text(text)
        path.chmod(0o600)
        assert not EarlierPackets(path, "test", dict).has(packets(Sealer("test", 2, boot=6, signing=KEYS[2]), 1)[0])
    assert caplog.text.count("cannot be used") == 4


def test_one_that_others_may_write_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "agent_001.seen"
    path.write_text("[]")
    path.chmod(0o666)
    with pytest.raises(KeyFileError):
        EarlierPackets(path, "test", dict)


async def test_a_full_disk_does_not_end_a_flight(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kept = EarlierPackets(tmp_path / "gone" / "agent_001.seen", "test", dict)
    await kept.close(STATE)
    assert "packets seen: " in caplog.text
