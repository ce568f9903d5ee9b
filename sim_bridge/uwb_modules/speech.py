"""What a module says on its port: ranges as the bytes of each protocol. Sans-I/O.

The layouts stand in `agent.uwb.modules`; here they are written once more, by themselves, from the same sources. In
the simulated fleet a module has the id of its drone.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Protocol

from sim_bridge.world.sensors import SensedRange, SensedRanges

CLOCK_AHEAD_S = 4_294_960.0
"""A LinkTrack's clock at the start of the world's: 7.3 s before its 32 bits of ms begin anew."""


class Speech(Protocol):
    """One module's voice."""

    def say(self, time_s: float, ranges: SensedRanges) -> bytes:
        """What it sends when it has measured, at ``time_s`` of a steady clock."""

    def hear(self, data: bytes) -> bytes:
        """What it answers to what is typed."""


class LinkTrackSpeech:
    """A LinkTrack that sends NodeFrame3, or 2 with ``node_frame=2``."""

    def __init__(self, own: int, node_frame: int = 3) -> None:
        self._own, self._node_frame = own, node_frame

    def say(self, time_s: float, ranges: SensedRanges) -> bytes:
        clock = int((time_s + CLOCK_AHEAD_S) * 1e3) % 2**32
        two = self._node_frame == 2
        nodes = b"".join(_node(each) + bytes(6 if two else 0) for each in ranges.ranges)
        if two:
            body = struct.pack("<BBI92xI10xHB", 0, self._own, 0, clock, 5000, len(ranges.ranges))
        else:
            body = struct.pack("<BBII4xHB", 0, self._own, clock, 0, 5000, len(ranges.ranges))
        frame = struct.pack("<BBH", 0x55, 4 if two else 5, 5 + len(body) + len(nodes)) + body + nodes
        return frame + bytes((sum(frame) % 256,))

    def hear(self, data: bytes) -> bytes:
        return b""


def _node(measured: SensedRange) -> bytes:
    powers = bytes(max(0, min(255, round(-2.0 * dbm))) for dbm in (measured.first_path_dbm, measured.rx_dbm))
    range_mm = round(1e3 * measured.range_m).to_bytes(3, "little", signed=True)
    return bytes((0, measured.target)) + range_mm + powers


class UciSpeech:
    """A module with UCI firmware that is the initiator of its own session."""

    def __init__(self, own: int) -> None:
        self._own, self._sequence = own, 0

    def say(self, time_s: float, ranges: SensedRanges) -> bytes:
        entries = b"".join(
            struct.pack("<HBBH12xBB11x", each.target, 0, each.nlos > 0.5, _cm(each), slot + 1, 0)
            for slot, each in enumerate(ranges.ranges)
        )
        head = struct.pack("<IIBIBBB8xB", self._sequence, self._own, 0, 100, 1, 0, 0, len(ranges.ranges))
        self._sequence += 1
        payload = head + entries
        parts = [payload[at : at + 255] for at in range(0, len(payload), 255)]
        return b"".join(
            bytes((0x62 | (0x10 if part is not parts[-1] else 0), 0, 0, len(part))) + part for part in parts
        )

    def hear(self, data: bytes) -> bytes:
        return b""


class Dwm1001Speech:
    """A DWM1001 tag whose shell is closed at first."""

    def __init__(self, own: int) -> None:
        self._on, self._typed, self._open = False, b"", False

    def say(self, time_s: float, ranges: SensedRanges) -> bytes:
        if not self._on:
            return b""
        anchors = "".join(
            f",AN{index},{each.target:04X},0.00,0.00,0.00,{each.range_m:.2f}"
            for index, each in enumerate(ranges.ranges)
        )
        return f"DIST,{len(ranges.ranges)}{anchors}\r\n".encode()

    def hear(self, data: bytes) -> bytes:
        answer = b""
        self._typed = (self._typed + data)[-64:]
        if not self._open:
            if not self._typed.endswith(b"\r\r"):
                return b"\x40\x01\x01"
            self._open = True
            answer += b"\r\n\r\n DWM1001 TWR Real Time Location System\r\n\r\n"
            self._typed = b""
        while b"\r" in self._typed:
            command, _, self._typed = self._typed.partition(b"\r")
            answer += command + b"\r\n"
            if command.strip() == b"lec":
                self._on = not self._on
        return answer + b"dwm> "


class Dwm3001Speech:
    """A DWM3001CDK that starts `INITF` by itself."""

    def __init__(self, own: int) -> None:
        self._block = 0

    def say(self, time_s: float, ranges: SensedRanges) -> bytes:
        entries = ";\r\n".join(
            f' [mac_address=0x{each.target:04x}, status="SUCCESS", distance[cm]={_cm(each)}]'
            for each in ranges.ranges
        )
        block, self._block = self._block, self._block + 1
        head = f"session_handle=1, sequence_number={block}, block_index={block}, n_measurements={len(ranges.ranges)}"
        return f"SESSION_INFO_NTF: {{{head}\r\n{entries}}}\r\n".encode()

    def hear(self, data: bytes) -> bytes:
        return b""


def _cm(measured: SensedRange) -> int:
    return round(100.0 * measured.range_m)


SPEECHES: Mapping[str, Callable[[int], Speech]] = {
    "linktrack": LinkTrackSpeech,
    "uci": UciSpeech,
    "dwm1001": Dwm1001Speech,
    "dwm3001-cli": Dwm3001Speech,
}
