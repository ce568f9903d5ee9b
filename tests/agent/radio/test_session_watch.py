"""Sessions that went deaf: when they are opened anew, and that a radio is heard again after it."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh

from agent.config.tables import FleetConfig
from agent.radio import radio as radio_module
from agent.radio.radio import Listener, Radio
from agent.radio.session_watch import LONGEST_PAUSE_HEARING_S, LONGEST_PAUSE_S, SILENT_S, SessionWatch
from tests.support.awaiting import until
from transport.link import session as session_module
from transport.link import session_settings
from transport.link.session import Handlers, Session, open_session
from transport.link.session_settings import SessionSettings
from transport.link.streams import Stream
from transport.security.sealing import Packet

PATIENCE_S = 30.0


def due(watch: SessionWatch, heard_s: Callable[[float], dict[int, float]], until_s: float) -> list[float]:
    return [now_s for now_s in map(float, range(round(until_s))) if watch.is_due(now_s, heard_s(now_s))]


def test_while_all_are_heard_or_nobody_ever_was_nothing_is_opened() -> None:
    assert due(SessionWatch(frozenset({2, 3})), lambda now_s: {2: now_s, 3: now_s - 4.0}, 100.0) == []
    assert due(SessionWatch(frozenset({2, 3})), lambda _: {}, 100.0) == []


def test_while_nobody_is_heard_it_is_tried_at_growing_intervals() -> None:
    found = due(SessionWatch(frozenset()), lambda _: {1: 0.0, 3: 0.0}, 300.0)
    pauses = [later - earlier for earlier, later in pairwise(found)]
    assert found[0] == SILENT_S
    assert pauses == [5.0, 10.0, 20.0, 40.0, 60.0, 60.0, 60.0]
    assert max(pauses) == LONGEST_PAUSE_S


def test_for_one_of_several_it_is_tried_less_often_and_only_where_it_dials_us() -> None:
    def one_silent(now_s: float) -> dict[int, float]:
        return {1: now_s, 3: 0.0}

    found = due(SessionWatch(frozenset({3})), one_silent, 2000.0)
    assert found[:4] == [5.0, 10.0, 20.0, 40.0]
    assert found[-1] - found[-2] == LONGEST_PAUSE_HEARING_S
    assert due(SessionWatch(frozenset()), one_silent, 2000.0) == []


def test_after_all_have_been_heard_it_begins_anew() -> None:
    watch = SessionWatch(frozenset({2}))
    assert due(watch, lambda _: {2: 0.0}, 50.0)
    assert not watch.is_due(51.0, {2: 51.0})
    assert [t for t in (52.0, 55.9, 56.0, 57.0, 61.0) if watch.is_due(t, {2: 51.0})] == [56.0, 61.0]


async def test_a_radio_whose_neighbour_fell_silent_is_opened_anew_and_heard_again(
    config_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a radio that goes by what its neighbour's last authentic packet was, and a neighbour
    monkeypatch.setattr(radio_module, "REDECLARE_AFTER_S", 0.05)
    config, heard_s = config_of(2, "security.mode=unsigned"), [time.monotonic()]
    listener = Listener(lambda *_: None, lambda *_: None, lambda *_: None, lambda *_: None, lambda _: heard_s[0])
    radio, got = Radio(config, 1, Path(), listener), []
    await radio.open()
    settings = SessionSettings(connect=config.listen(1))
    handlers = Handlers(lambda *each: got.append(each))
    neighbour = await open_session(settings, config.fleet.name, 2, config.ids, handlers)
    neighbour.subscribe(1, (Stream.MEAS,))
    neighbour.announce()
    try:
        # WHEN that is long ago
        heard_s[0] -= SILENT_S
        monkeypatch.setattr(radio, "_opened_s", radio._opened_s - SILENT_S)
        await until(lambda: radio.counters()["sessions opened anew"] >= 1, "a new session")
        heard_s[0] = time.monotonic() + 1000.0
        # THEN the neighbour finds the new session by itself, and hears it
        got.clear()

        def is_heard() -> bool:
            radio.send([Packet(Stream.MEAS, b"again")])
            return any(payload == b"again" for _, payload, _ in got)

        await until(is_heard, "a packet of the new session")
    finally:
        await neighbour.close()
        await radio.close()


def idle_stranger(config: FleetConfig) -> zenoh.Session:
    """A session that takes a slot, says nothing, and does not come back when it is thrown out."""
    table = {
        "mode": "peer",
        "connect": {"endpoints": list(config.listen(1)), "retry": {"period_init_ms": 600_000}},
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(table)))


async def test_strangers_who_take_all_slots_do_not_lock_a_member_out_for_good(
    config_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a radio with four slots, of whose neighbour nothing is heard for long
    monkeypatch.setattr(session_settings, "STRANGERS", 2)
    monkeypatch.setattr(radio_module, "REDECLARE_AFTER_S", 0.05)
    config, heard_s = config_of(2, "security.mode=unsigned"), [time.monotonic() + 1000.0]
    listener = Listener(lambda *_: None, lambda *_: None, lambda *_: None, lambda *_: None, lambda _: heard_s[0])
    radio, got = Radio(config, 1, Path(), listener), []
    await radio.open()
    strangers = [await asyncio.to_thread(idle_stranger, config) for _ in range(5)]
    session = radio._session
    assert session is not None
    await until(lambda: session.connected() == 4, "strangers in all slots")
    # WHEN it comes back, THEN there is no room for it
    settings = SessionSettings(connect=config.listen(1))
    handlers = Handlers(lambda *each: got.append(each))
    neighbour = await open_session(settings, config.fleet.name, 2, config.ids, handlers)
    try:
        assert neighbour.connected() == 0
        neighbour.subscribe(1, (Stream.MEAS,))
        neighbour.announce()

        def is_heard() -> bool:
            radio.send([Packet(Stream.MEAS, b"hello")])
            return bool(got)

        assert not is_heard()
        # UNTIL the radio looks for the neighbour that it misses
        heard_s[0] = time.monotonic() - SILENT_S
        monkeypatch.setattr(radio, "_opened_s", radio._opened_s - SILENT_S)
        await until(is_heard, "the member in a slot")
        heard_s[0] = time.monotonic() + 1000.0
    finally:
        await neighbour.close()
        await radio.close()
        for stranger in strangers:
            await asyncio.to_thread(stranger.close)


class Stuck:
    """A Zenoh session that does not close before it is let go."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.closed = threading.Event()

    def close(self) -> None:
        self.go.wait(PATIENCE_S)
        self.closed.set()


async def test_closing_does_not_wait_for_a_session_that_is_stuck(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "CLOSE_S", 0.05)
    stuck = Stuck()
    session = Session(stuck, "test", 1, Handlers(lambda *_: None), 16)  # type: ignore[arg-type]
    assert not await session.close()
    assert not stuck.closed.is_set()
    stuck.go.set()
    assert await asyncio.to_thread(stuck.closed.wait, PATIENCE_S)
    assert await session.close()  # a second time there is nothing to be done
