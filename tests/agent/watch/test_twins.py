"""Two daemons of one id: who hears both says so, and both learn of it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from nacl.signing import SigningKey

from agent.config.agreement import shared_settings
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import Send
from estimators.factory import make_estimator
from transport.link.streams import Stream, key_expression
from transport.messages.agreement_body import Agreement, agreement_hash
from transport.messages.measurement_body import Measurements, SpeedMeasurement
from transport.security.auth import Identity
from transport.security.sealing import Sealer

KEYS = {agent_id: SigningKey(bytes([agent_id]) * 32) for agent_id in (1, 2, 3)}
TRUST = {agent_id: (key.verify_key,) for agent_id, key in KEYS.items()}
EARLIER, LATER = 100, 200
"""Boots of the two daemons."""
NS = 1_000_000_000


class Hearing:
    """Drone 1, who hears whoever sends as drone 2; its clocks are one."""

    def __init__(self, config: FleetConfig) -> None:
        self.config = config
        self.listener = self.agent_of(1, boot=50)
        self.voices = {boot: self.voice(boot) for boot in (EARLIER, LATER)}
        self.host_s = 0.0

    def agent_of(self, agent_id: int, *, boot: int) -> OnboardAgent:
        unix_s = self.config.fleet.epoch_unix_s
        identity = Identity(KEYS[agent_id], TRUST, boot)
        return OnboardAgent(
            self.config, agent_id, make_estimator, identity, unix_s=unix_s, host_s=0.0, linked=False
        )

    def voice(self, boot: int, key: SigningKey = KEYS[2]) -> Sealer:
        agreement = agreement_hash(shared_settings(self.config))
        return Sealer(self.config.fleet.name, 2, boot=boot, signing=key, agreement=agreement)

    def unix_ns(self, host_s: float) -> int:
        return round((self.config.fleet.epoch_unix_s + host_s) * NS)

    def say(self, voice: Sealer, sent_s: float | None = None) -> bytes:
        """A packet, made at an instant, reaches drone 1 now."""
        tick = round(self.host_s / self.config.fleet.period_s)
        records = (SpeedMeasurement(2, tick, 1.0 + self.host_s, 0.25),)
        sent_ns = self.unix_ns(self.host_s if sent_s is None else sent_s)
        (packet,) = voice.seal(Measurements(tick, records), t_ns=sent_ns)
        self.hear(packet.data)
        return packet.data

    def hear(self, data: bytes) -> None:
        key = key_expression(self.config.fleet.name, 2, Stream.MEAS)
        self.listener.on_packet(
            key, data, arrived_s=self.host_s, host_s=self.host_s, unix_ns=self.unix_ns(self.host_s)
        )

    def second(self) -> list[Send]:
        """The end of a second: what drone 1 sends then."""
        self.host_s += 1.0
        outputs = self.listener.keep_house(
            unix_s=self.config.fleet.epoch_unix_s + self.host_s, host_s=self.host_s
        )
        return [each for each in outputs if isinstance(each, Send)]

    def both_for(self, seconds: int, earlier: Sealer | None = None) -> list[Send]:
        sent: list[Send] = []
        for _ in range(seconds):
            self.say(self.voices[LATER])
            self.say(earlier or self.voices[EARLIER])
            sent += self.second()
        return sent


def reasons(agent: OnboardAgent) -> tuple[str, ...]:
    """What is wrong with a drone that has had no tick yet, less what follows from that."""
    agent.core.health.update((), 1e9)
    return agent.core.health.health.reasons


@pytest.fixture
def hearing(make_config: Callable[..., FleetConfig]) -> Hearing:
    return Hearing(make_config(3))


def test_who_hears_two_daemons_of_one_id_says_so_and_both_learn_of_it(hearing: Hearing) -> None:
    sent = hearing.both_for(6)
    assert reasons(hearing.listener) == ("two daemons run as 2",)
    told = sent[-1].message
    assert isinstance(told, Agreement)
    assert told.twice == (2,)
    for boot in (EARLIER, LATER):
        one = hearing.agent_of(2, boot=boot)
        key = key_expression(hearing.config.fleet.name, 1, Stream.AGREE)
        one.on_packet(key, sent[-1].packets[0].data, arrived_s=6.0, host_s=6.0, unix_ns=hearing.unix_ns(6.0))
        assert reasons(one) == ("another daemon runs with our id, says 1",)
        one.keep_house(unix_s=hearing.config.fleet.epoch_unix_s + 10.0, host_s=10.0)
        assert reasons(one) == ()
    # AND a third drone is not concerned
    third = hearing.agent_of(3, boot=60)
    third.on_packet(key, sent[-1].packets[0].data, arrived_s=6.0, host_s=6.0, unix_ns=hearing.unix_ns(6.0))
    assert reasons(third) == ()


def test_it_is_over_when_one_of_them_falls_silent(hearing: Hearing) -> None:
    hearing.both_for(6)
    for _ in range(5):
        hearing.say(hearing.voices[LATER])
        hearing.second()
    assert reasons(hearing.listener) == ()
    assert hearing.second() == []


def test_a_restart_is_no_second_daemon_though_its_last_packets_come_late(hearing: Hearing) -> None:
    for _ in range(5):
        hearing.say(hearing.voices[EARLIER])
        assert hearing.second() == []
    late = [hearing.voices[EARLIER].seal(Measurements(50, ()), t_ns=hearing.unix_ns(5.0))[0].data for _ in range(5)]
    for data in late:
        hearing.say(hearing.voices[LATER])
        hearing.hear(data)
        assert hearing.second() == []
    assert reasons(hearing.listener) == ()


def test_what_is_played_back_of_an_earlier_start_is_no_second_daemon(hearing: Hearing) -> None:
    recorded = []
    for _ in range(5):  # its clock was ahead then, by ten seconds
        recorded.append(hearing.say(hearing.voices[EARLIER], hearing.host_s + 10.0))
        hearing.second()
    for _ in range(20):
        hearing.say(hearing.voices[LATER])
        hearing.second()
    for data in recorded:
        hearing.say(hearing.voices[LATER])
        hearing.hear(data)
        assert hearing.second() == []
    assert reasons(hearing.listener) == ()


def test_a_stranger_cannot_make_a_second_daemon_of_it(hearing: Hearing) -> None:
    forged = hearing.voice(EARLIER, KEYS[3])
    assert hearing.both_for(6, forged) == []
    assert reasons(hearing.listener) == ()
    assert hearing.listener.opener.peers.rejections() == {"bad_signature": 6}
