"""One agent of a fleet in virtual time: its core with everything that the daemon puts around it, but sockets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from agent.config.tables import FleetConfig
from agent.core import AgentCore, EstimatorFactory
from agent.mavlink.sample_adapter import SampleAdapter
from agent.mavlink.session import AutopilotSession, LinkState
from agent.radio.radio_faults import channel_settings
from agent.sensing.frames import FleetFrame
from agent.uwb.adapter import UwbAdapter
from transport.link.channel import Channel, Outage
from transport.link.streams import key_expression
from transport.messages.header import Kind
from transport.messages.information_body import Information
from transport.messages.uwb_body import UwbFrame
from transport.security.auth import UNSIGNED
from transport.security.opening import Opener, Received
from transport.security.sealing import Message, Sealer

Parcel = Any
"""What a member packs and another unpacks: a key with bytes, or a `Received`."""


class Member(ABC):
    """What both fidelities share; ``channel`` holds the configured loss and delay on the way in."""

    def __init__(self, config: FleetConfig, agent_id: int, make_estimator: EstimatorFactory) -> None:
        self.agent_id = agent_id
        self._config = config
        self.core = AgentCore(config, agent_id, make_estimator)
        self.uwb = UwbAdapter(agent_id, config.ids, config.sensors)
        self.channel = self._channel((), None)

    def set_outages(self, outages: tuple[Outage, ...], began_s: float) -> None:
        """What it cannot hear besides the configured faults, whose times count from ``began_s``.

        Before anything is offered to the channel.
        """
        self.channel = self._channel(outages, began_s)

    def _channel(self, outages: tuple[Outage, ...], began_s: float | None) -> Channel[Parcel]:
        transport = self._config.transport
        faults = channel_settings(
            transport.faults,
            self.agent_id,
            loss=transport.loss,
            delay_s=transport.delay_s,
            delay_jitter_s=transport.delay_jitter_s,
            began_s=began_s,
            more=outages,
        )
        neighbours = self._config.neighbours(self.agent_id)
        return Channel.seeded(faults, seed=transport.seed, receiver=self.agent_id, neighbours=neighbours)

    @abstractmethod
    def pack(self, message: Message, unix_ns: int) -> list[Parcel]:
        """What goes on the air for a message."""

    @abstractmethod
    def unpack(self, parcel: Parcel, now_s: float, unix_ns: int) -> Received | None:
        """The message in what came; ``None`` if there is none (yet)."""

    @abstractmethod
    def counters(self) -> dict[str, int]:
        """Those counters of a daemon that have a meaning here."""

    def _common_counters(self) -> dict[str, int]:
        counters = {"injected losses": sum(self.channel.lost.values()), **self.core.counters}
        for prefix, table in (
            ("skipped ", self.core.timeline.skipped),
            ("skipped uwb ", self.uwb.skipped),
            ("refused ", self.core.records.refused),
            ("rejected uwb ", self.uwb.intake.rejections.as_dict()),
        ):
            counters |= {f"{prefix}{name}": count for name, count in table.items()}
        return counters


class ObjectMember(Member):
    """Hands packets over as objects; its samples come ready made, as from the replay of a log."""

    def __init__(self, config: FleetConfig, agent_id: int, make_estimator: EstimatorFactory) -> None:
        super().__init__(config, agent_id, make_estimator)
        self.core.autopilot_state = str(LinkState.CONNECTED)
        self._sent = 0
        self._received = 0

    def pack(self, message: Message, unix_ns: int) -> list[Parcel]:
        self._sent += 1
        kind = Kind.INFO if isinstance(message, Information) else Kind.MEAS
        return [Received(self.agent_id, kind, self._sent, unix_ns, 0.0, message)]

    def unpack(self, parcel: Parcel, now_s: float, unix_ns: int) -> Received | None:
        self._received += 1
        received: Received = parcel
        return received

    def counters(self) -> dict[str, int]:
        counted = {"packets sent": self._sent, "packets received": self._received}
        return counted | self._common_counters()


class ValueMember(ObjectMember):
    """Takes samples, fixes and packets as objects; ``start_fleet_s`` is the fleet time of stamp zero."""

    def __init__(
        self, config: FleetConfig, agent_id: int, make_estimator: EstimatorFactory, start_fleet_s: float
    ) -> None:
        super().__init__(config, agent_id, make_estimator)
        self._samples = SampleAdapter(
            FleetFrame.of(config),
            config.sensors,
            config.fleet.epoch_unix_s,
            lambda boot_s, _arrival_s: start_fleet_s + boot_s,
        )

    def on_fix(self, message: Any, now_s: float) -> None:
        """A GPS_RAW_INT message; ``now_s`` fleet time."""
        sample = self._samples.convert(message, now_s)
        if sample is not None:
            self.core.on_sample(sample, now_s)

    def on_uwb(self, frame: UwbFrame, age_s: float, now_s: float) -> None:
        """A frame of the own UWB module; ``now_s`` fleet time."""
        for sample in self.uwb.samples_of(frame, age_s, now_s):
            self.core.on_range(sample, now_s)

    def counters(self) -> dict[str, int]:
        return super().counters() | _skipped(self._samples)


class ByteMember(Member):
    """Speaks MAVLink with its fake autopilot, seals and opens packets as the daemon does.

    ``boot`` counts its starts.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        make_estimator: EstimatorFactory,
        fleet_offset_s: float,
        boot: int = 1,
    ) -> None:
        super().__init__(config, agent_id, make_estimator)
        self._fleet = config.fleet.name
        self._fleet_offset_s = fleet_offset_s
        self._session = AutopilotSession(config, agent_id, datagrams=True)
        self._session.fleet_offset_s = fleet_offset_s
        self._sealer = Sealer(self._fleet, agent_id, boot=boot, signing=UNSIGNED)
        freshness_s = config.security.freshness_s
        self._opener = Opener(self._fleet, config.ids, UNSIGNED, own_id=agent_id, freshness_s=freshness_s)
        self._double = {"auto": None, "float32": False, "float64": True}[config.transport.information_format]

    def on_mavlink(self, data: bytes, host_s: float) -> None:
        """A datagram of the autopilot."""
        for sample in self._session.receive(data, host_s):
            self.core.on_sample(sample, host_s + self._fleet_offset_s)

    def to_autopilot(self, host_s: float) -> list[bytes]:
        """Frames due on the autopilot's link."""
        frames = self._session.to_send(host_s)
        self.core.autopilot_state = str(self._session.state)
        return frames

    def on_uwb(self, payload: bytes, now_s: float, host_s: float, unix_s: float) -> None:
        """A frame of the own UWB module; ``now_s`` fleet time."""
        for sample in self.uwb.receive(payload, now_s=now_s, host_s=host_s, unix_s=unix_s):
            self.core.on_range(sample, now_s)

    def pack(self, message: Message, unix_ns: int) -> list[Parcel]:
        packets = self._sealer.seal(message, t_ns=unix_ns, double=self._double)
        return [(key_expression(self._fleet, self.agent_id, packet.stream), packet.data) for packet in packets]

    def unpack(self, parcel: Parcel, now_s: float, unix_ns: int) -> Received | None:
        key, data = parcel
        return self._opener.open(key, data, now=now_s, unix_ns=unix_ns)

    def expire(self, now_s: float) -> None:
        """Give up what is incomplete for too long."""
        self._opener.expire(now_s)

    def counters(self) -> dict[str, int]:
        peers = [peer for _, peer in self._opener.peers.items()]
        counted = {
            "mavlink rx": self._session.decoder.received,
            "mavlink bad": self._session.decoder.bad.total(),
            "packets sent": self._sealer.sent,
            "packets received": sum(peer.received for peer in peers),
            "packets lost": sum(peer.lost for peer in peers),
        }
        rejected = {f"rejected {name}": count for name, count in self._opener.peers.rejections().items()}
        return counted | self._common_counters() | _skipped(self._session.samples) | rejected


def _skipped(samples: SampleAdapter) -> dict[str, int]:
    """Counters of the messages that gave no sample."""
    return {f"skipped {reason}": count for reason, count in samples.skipped.items()}
