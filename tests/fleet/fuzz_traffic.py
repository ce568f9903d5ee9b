"""Hostile traffic for one daemon: packets, range frames, clock questions and MAVLink datagrams, by class.

Whoever makes it has heard the fleet but holds none of its keys. Every class says where the daemon has to count it.
"""

from __future__ import annotations

import itertools
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from nacl.signing import SigningKey

from agent.mavlink.codec import Decoder, Encoder, mavlink
from transport.link.streams import Stream, key_expression
from transport.messages.header import HEADER, HEADER_BYTES, MAX_PACKET_BYTES, SIGNATURE_BYTES, fleet_hash
from transport.messages.uwb_body import UwbFrame, UwbRange, encode_uwb_binary, encode_uwb_json
from transport.security.auth import UNSIGNED, Signing, sign

TARGET, NEIGHBOURS = 2, (1, 3)
HEARD = (Stream.MEAS, Stream.INFO)
UNHEARD = (Stream.EST, Stream.CLOCK, Stream.DIAG)
CAPTURED_FOR_S = 3.0
"""A captured packet has reached the daemon long before it is sent again."""
ENOUGH = 30
"""Captured packets of each source to choose among; every neighbour measures ten times a second."""
LONG_AGO_S = 1_234_567.0
"""No few flipped bits of a time written in digits make it the present."""
STRANGER_SYSTEM = 77
HEADER_FIELDS = ("magic", "version", "kind", "sender", "flags", "round", "boot", "seq", "tick", "n",
                 "body_bytes", "t_ns", "fleet", "agreement")  # fmt: skip
REJECTED, REJECTED_UWB = "rejected", "rejected uwb"
NOBODY, OVER_LIMIT = "no subscriber", "over the link's size limit"
NEVER_ARRIVE = (NOBODY, OVER_LIMIT)
"""Not counters of the daemon: Zenoh does not send to nobody, and its size filter drops what is far too large."""

Shot = tuple[str, bytes]
"""(key expression, payload)."""


def flipped(data: bytes, rng: np.random.Generator, bits: int) -> bytes:
    """The same bytes with 1 to ``bits`` different bits flipped."""
    changed = bytearray(data)
    for bit in rng.choice(8 * len(data), rng.integers(1, bits + 1), replace=False):
        changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


# --- packets ------------------------------------------------------------------------------------------------


class Captured:
    """What the neighbours really sent, by (sender, stream), kept for half a minute; filled on Zenoh's threads."""

    def __init__(self) -> None:
        self._packets: dict[tuple[int, Stream], deque[tuple[float, bytes]]] = {
            source: deque(maxlen=300) for source in itertools.product(NEIGHBOURS, HEARD)
        }
        self._changed = threading.Condition()

    def add(self, agent_id: int, stream: Stream, packet: bytes) -> None:
        """Note a packet that has just come."""
        with self._changed:
            self._packets[agent_id, stream].append((time.monotonic(), packet))
            self._changed.notify_all()

    def wait_for_one(self, patience_s: float) -> None:
        """Until the next packet comes."""
        with self._changed:
            assert self._changed.wait(patience_s), f"no packet of the fleet in {patience_s:g} s"

    def enough(self) -> bool:
        """Whether there are `ENOUGH` of each source that may be sent again."""
        with self._changed:
            return all(self._old(kept) >= ENOUGH for kept in self._packets.values())

    def pick(self, rng: np.random.Generator, agent_id: int, stream: Stream) -> bytes:
        """One that came more than ``CAPTURED_FOR_S`` ago."""
        with self._changed:
            kept = self._packets[agent_id, stream]
            return kept[int(rng.integers(self._old(kept)))][1]

    def _old(self, kept: deque[tuple[float, bytes]]) -> int:
        """How many at the beginning may be sent again."""
        return len(kept) - sum(1 for _ in itertools.takewhile(self._is_young, reversed(kept)))

    @staticmethod
    def _is_young(entry: tuple[float, bytes]) -> bool:
        return time.monotonic() - entry[0] < CAPTURED_FOR_S


class PacketMaker:
    """Hostile packets; ``CLASSES`` with weights. None of them may be accepted: the hostile peer has no key."""

    def __init__(self, fleet: str, captured: Captured, rng: np.random.Generator) -> None:
        self._fleet, self._captured, self._rng = fleet, captured, rng
        self._stranger = SigningKey(rng.bytes(32))
        self._numbers = itertools.count(1 << 31)

    def _source(self) -> tuple[int, Stream]:
        return NEIGHBOURS[self._rng.integers(2)], HEARD[self._rng.integers(2)]

    def _key(self, agent_id: int, stream: Stream) -> str:
        return key_expression(self._fleet, agent_id, stream)

    def _mutated(self, change: Callable[[bytes], bytes]) -> Shot:
        source = self._source()
        return self._key(*source), change(self._captured.pick(self._rng, *source))

    def _forged(self, signing: Signing, body: Callable[[bytes], bytes] = bytes, **fields: Any) -> Shot:
        """A captured packet with a fresh number and time, changed fields and body, sealed anew."""
        source = self._source()
        packet = self._captured.pick(self._rng, *source)
        header = dict(zip(HEADER_FIELDS, HEADER.unpack_from(packet), strict=True))
        content = body(packet[HEADER_BYTES:-SIGNATURE_BYTES])
        header |= {"seq": next(self._numbers), "t_ns": time.time_ns(), "body_bytes": len(content)}
        raw = HEADER.pack(*(header | fields).values())
        key = self._key(*source)
        seal = b"" if signing is UNSIGNED else sign(self._stranger, key, raw, content)
        return key, raw + content + seal

    def random_bytes(self) -> Shot:
        junk = self._rng.bytes(int(self._rng.integers(0, 1300)))
        start = self._captured.pick(self._rng, *self._source())[:HEADER_BYTES] if self._rng.random() < 0.5 else b""
        return self._key(*self._source()), start + junk

    def bit_flips(self) -> Shot:
        return self._mutated(lambda packet: flipped(packet, self._rng, 4))

    def truncated(self) -> Shot:
        return self._mutated(lambda packet: packet[: self._rng.integers(len(packet))])

    def extended(self) -> Shot:
        return self._mutated(lambda packet: packet + self._rng.bytes(int(self._rng.integers(1, 200))))

    def replay(self) -> Shot:
        return self._mutated(bytes)

    def wrong_key(self) -> Shot:
        sender, stream = self._source()
        other = (NEIGHBOURS[sender == NEIGHBOURS[0]], stream) if self._rng.random() < 0.5 else (
            sender, HEARD[stream is HEARD[0]])  # fmt: skip
        return self._key(*other), self._captured.pick(self._rng, sender, stream)

    def wrong_fleet(self) -> Shot:
        return self._forged(self._stranger, fleet=fleet_hash("another"))

    def wrong_sender(self) -> Shot:
        return self._forged(self._stranger, sender=int(self._rng.choice((0, 2, 4, 999, 65535))))

    def wrong_version(self) -> Shot:
        return self._forged(self._stranger, version=int(self._rng.choice((0, 1, 3, 255))))

    def wrong_kind_or_flags(self) -> Shot:
        if self._rng.random() < 0.5:
            return self._forged(self._stranger, kind=int(self._rng.choice((0, 3, 6, 7, 255))))
        return self._forged(self._stranger, flags=int(self._rng.integers(2, 256)))

    def wrong_length(self) -> Shot:
        return self._forged(self._stranger, body_bytes=int(self._rng.choice((0, 1, 2**15, 2**16 - 1))))

    def too_long(self) -> Shot:
        junk = bytes(MAX_PACKET_BYTES + int(self._rng.integers(1, 2000)))
        return self._mutated(lambda packet: packet[:HEADER_BYTES] + junk)

    def far_too_long(self) -> Shot:
        return self._key(*self._source()), bytes(2 * MAX_PACKET_BYTES + int(self._rng.integers(1, 10**6)))

    def unsigned(self) -> Shot:
        return self._forged(UNSIGNED)

    def forged_signature(self) -> Shot:
        return self._forged(self._stranger)

    def forged_next_start(self) -> Shot:
        return self._forged(self._stranger, boot=2**32 - 1)

    def forged_stale(self) -> Shot:
        return self._forged(self._stranger, t_ns=time.time_ns() + int(self._rng.choice((-1, 1)) * 3600e9))

    def forged_nan(self) -> Shot:
        return self._forged(self._stranger, lambda body: body[:16] + b"\xff" * (len(body) - 16))

    def unheard_stream(self) -> Shot:
        """Junk where no daemon listens: other streams, and clock answers that nobody asked for."""
        agent_id, _ = self._source()
        return self._key(agent_id, UNHEARD[self._rng.integers(len(UNHEARD))]), self.bit_flips()[1]

    def uwb_random_bytes(self) -> Shot:
        start = (b"", b"UWB1", b'{"v":1,')[self._rng.integers(3)]
        return self._uwb(start + self._rng.bytes(int(self._rng.integers(1, 200))))

    def uwb_mutated(self) -> Shot:
        frame = self._frame(LONG_AGO_S)
        whole = encode_uwb_json(frame) if self._rng.random() < 0.5 else encode_uwb_binary(frame)
        if self._rng.random() < 0.3:
            return self._uwb(whole[: self._rng.integers(len(whole))])
        return self._uwb(flipped(whole, self._rng, 4))

    def uwb_wrong_time(self) -> Shot:
        return self._uwb(encode_uwb_json(self._frame(float(self._rng.choice((-1, 1)) * self._rng.uniform(2, 1e4)))))

    def uwb_wrong_observer(self) -> Shot:
        return self._uwb(encode_uwb_json(self._frame(0.0, observer=NEIGHBOURS[1])))

    def uwb_absurd(self) -> Shot:
        """Fresh, with one range that cannot be: not finite, negative or of no length, or too long."""
        absurd = struct.pack("<f", self._rng.choice((np.nan, np.inf, -np.inf, -5.0, 0.0, 1e9, 1e38)))
        return self._uwb(encode_uwb_binary(self._frame(0.0)).replace(struct.pack("<f", 5.0), absurd))

    def uwb_unknown_target(self) -> Shot:
        return self._uwb(encode_uwb_json(self._frame(0.0, target=int(self._rng.integers(4, 60_000)))))

    def clock_question(self) -> Shot:
        size = int(self._rng.choice((0, 1, 7, 9, 64, 2000)))
        return key_expression(self._fleet, TARGET, Stream.CLOCK), self._rng.bytes(size)

    def _uwb(self, payload: bytes) -> Shot:
        return key_expression(self._fleet, TARGET, Stream.UWB), payload

    def _frame(self, age_s: float, *, observer: int = TARGET, target: int = NEIGHBOURS[0]) -> UwbFrame:
        number, t_ns = next(self._numbers), time.time_ns() - round(age_s * 1e9)
        return UwbFrame(number, "unix", t_ns, (UwbRange(target, 5.0, 0.1),), observer)

    CLASSES: ClassVar[dict[Callable[[PacketMaker], Shot], tuple[float, str]]] = {
        random_bytes: (12, REJECTED), bit_flips: (14, REJECTED), truncated: (8, REJECTED), extended: (4, REJECTED),
        replay: (10, REJECTED), wrong_key: (5, REJECTED), wrong_fleet: (3, REJECTED), wrong_sender: (3, REJECTED),
        wrong_version: (3, REJECTED), wrong_kind_or_flags: (4, REJECTED), wrong_length: (3, REJECTED),
        too_long: (0.1, REJECTED), far_too_long: (0.03, OVER_LIMIT), unsigned: (4, REJECTED),
        forged_signature: (8, REJECTED), forged_next_start: (2, REJECTED), forged_stale: (2, REJECTED),
        forged_nan: (4, REJECTED),
        unheard_stream: (3, NOBODY), clock_question: (1, "packets unsent"),
        uwb_random_bytes: (2, REJECTED_UWB), uwb_mutated: (4, REJECTED_UWB), uwb_wrong_time: (1, REJECTED_UWB),
        uwb_wrong_observer: (1, REJECTED_UWB), uwb_absurd: (1, "uwb unusable"),
        uwb_unknown_target: (1, "skipped uwb not a neighbour"),
    }  # fmt: skip
    """Relative weight, and under which of the daemon's counters it has to appear."""

    def make(self, count: int) -> Iterator[tuple[str, Shot]]:
        """Class names and shots, in random order."""
        makers = list(self.CLASSES)
        weights = np.array([weight for weight, _ in self.CLASSES.values()])
        for index in self._rng.choice(len(makers), count, p=weights / weights.sum()):
            yield makers[index].__name__, makers[index](self)

    @classmethod
    def expected(cls, sent: Counter[str]) -> Counter[str]:
        """The daemon's counters that follow from what was sent by class."""
        total: Counter[str] = Counter()
        for maker, (_, counter) in cls.CLASSES.items():
            total[counter] += sent[maker.__name__]
        return total


# --- MAVLink ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Datagram:
    """Bytes, and the daemon's counters that they have to raise, by how much."""

    kind: str
    data: bytes
    counts: dict[str, int]


class DatagramMaker:
    """Hostile datagrams. A frame of the autopilot's own system with a good checksum is the autopilot as far as
    MAVLink can tell, so those sent here are absurd in a way that can be told; nothing may become a sample."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._ours, self._stranger = Encoder(TARGET, 1), Encoder(STRANGER_SYSTEM, 1)

    def make(self, count: int) -> Iterator[Datagram]:
        """Datagrams in random order."""
        makers = list(self.CLASSES)
        weights = np.array(list(self.CLASSES.values()))
        for index in self._rng.choice(len(makers), count, p=weights / weights.sum()):
            yield makers[index](self)

    def _sound(self, time_usec: int = 1 << 45) -> list[Any]:
        """Messages that would become samples if their time and sender were right."""
        n = self._rng.normal(size=9)
        return [
            mavlink.MAVLink_highres_imu_message(
                time_usec, *n[:2], -9.8, *n[3:6], *n[6:], 950, 0, 500, 35, 0x1FFF, 0),
            mavlink.MAVLink_gps_raw_int_message(
                time_usec, 3, 473977420, 85455940, 490_000, 80, 120, 500, 9000, 14, 0, 300, 500, 200, 0, 0),
        ]  # fmt: skip

    def _any(self) -> Any:
        """A message of a stranger that is not a heartbeat."""
        boot_ms = int(self._rng.integers(1 << 32))
        messages = [
            *self._sound(),
            mavlink.MAVLink_attitude_quaternion_message(boot_ms, 1, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_local_position_ned_message(boot_ms, *self._rng.normal(size=6)),
            mavlink.MAVLink_system_time_message(1 << 50, boot_ms),
            mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 4),
        ]
        return messages[self._rng.integers(len(messages))]

    def _refused(self, kind: str, data: bytes) -> Datagram | None:
        """What a decoder counts; ``None`` if there is a sound frame in it after all."""
        decoder = Decoder(datagrams=True)
        good = decoder.feed(data)
        counts = {f"mavlink bad {reason}": times for reason, times in decoder.bad.items()}
        return None if good else Datagram(kind, data, counts)

    def _until_refused(self, kind: str, make: Callable[[], bytes]) -> Datagram:
        """The first that holds no sound frame: one in 65536 gets past a checksum of 16 bits by chance."""
        return next(datagram for datagram in (self._refused(kind, make()) for _ in itertools.count()) if datagram)

    def random_bytes(self) -> Datagram:
        start = (b"", b"\xfd", b"\xfe", b"\xfd\x09\x00\x00\x00\x02\x01\x00\x00\x00")
        return self._until_refused(
            "random bytes",
            lambda: start[self._rng.integers(4)] + self._rng.bytes(int(self._rng.integers(1, 280))),
        )

    def bit_flips(self) -> Datagram:
        return self._until_refused("bit flips", lambda: flipped(self._ours.encode(self._any()), self._rng, 4))

    def truncated(self) -> Datagram:
        def cut() -> bytes:
            frame = self._ours.encode(self._any())
            return frame[: self._rng.integers(1, len(frame))]

        return self._until_refused("truncated", cut)

    def unknown_message(self) -> Datagram:
        frame = bytearray(self._ours.encode(self._any()))
        frame[7:10] = (0x7F, 0xFF, 0x70)  # no message has this number, so no checksum can be right
        return self._until_refused("unknown message", lambda: bytes(frame))

    def wrong_system(self) -> Datagram:
        return Datagram("wrong system", self._stranger.encode(self._any()), {"mavlink ignored other source": 1})

    def wrong_system_heartbeat(self) -> Datagram:
        beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
        counts = {"mavlink ignored heartbeat: other system": 1}
        return Datagram("wrong system's heartbeat", self._stranger.encode(beat), counts)

    def mavlink1(self) -> Datagram:
        packer = mavlink.MAVLink(None, srcSystem=STRANGER_SYSTEM, srcComponent=1)
        frame = bytes(self._any().pack(packer, force_mavlink1=True))
        if self._rng.random() < 0.5:
            return Datagram("MAVLink 1", frame, {"mavlink ignored other source": 1})
        return self._until_refused("MAVLink 1", lambda: flipped(frame, self._rng, 3))

    def corrected_checksum(self) -> Datagram:
        """Bits of the time flipped and the checksum made to fit, under the autopilot's own ids."""
        bits = self._rng.choice(np.arange(41, 63), self._rng.integers(1, 5), replace=False)
        time_usec = sum(1 << int(bit) for bit in bits) + int(self._rng.integers(1 << 41))
        which = int(self._rng.integers(2))
        data = self._ours.encode(self._sound(time_usec)[which])
        return Datagram("corrected checksum", data, {f"skipped {('imu', 'gps')[which]}: wrong time": 1})

    def absurd_imu(self) -> Datagram:
        value, reason = (
            (np.nan, "not finite"), (np.inf, "not finite"), (1e30, "out of range"), (-5e3, "out of range"),
        )[self._rng.integers(4)]  # fmt: skip
        at = int(self._rng.integers(6))
        message = self._sound()[0]
        setattr(message, ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")[at], value)
        return Datagram("absurd IMU", self._ours.encode(message), {f"skipped imu: {reason}": 1})

    def absurd_gps(self) -> Datagram:
        fields, reason = (
            ({"lat": 2**31 - 1}, "no position"), ({"lon": -(2**31)}, "no position"),
            ({"lat": 0, "lon": 0}, "no position"),
            ({"h_acc": 0, "eph": 65535}, "no accuracy"), ({"fix_type": 0}, "no fix"), ({"fix_type": 255}, "no fix"),
        )[self._rng.integers(6)]  # fmt: skip
        message = self._sound(int(self._rng.integers(1 << 45, 1 << 46)))[1]
        for name, value in fields.items():
            setattr(message, name, value)
        return Datagram("absurd GPS", self._ours.encode(message), {f"skipped gps: {reason}": 1})

    def unasked_timesync(self) -> Datagram:
        tc1, ts1 = (int(self._rng.integers(1, 1 << 60)) for _ in range(2))
        message = mavlink.MAVLink_timesync_message(tc1, ts1)
        return Datagram("unasked TIMESYNC", self._ours.encode(message), {"timesync rejected": 1})

    CLASSES: ClassVar[dict[Callable[[DatagramMaker], Datagram], float]] = {
        random_bytes: 18, bit_flips: 22, truncated: 10, unknown_message: 5, wrong_system: 12,
        wrong_system_heartbeat: 5, mavlink1: 8, corrected_checksum: 6, absurd_imu: 6, absurd_gps: 5,
        unasked_timesync: 3,
    }  # fmt: skip
