"""The one door to flight logs: which format a file is in is seen from its content."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from agent.config.tables import SensorsTable
from agent.sensing.frames import FleetFrame
from sim_bridge.replay.logs.dataflash.records import FORMAT_OF_FORMAT
from sim_bridge.replay.logs.dataflash.source import DataflashSource
from sim_bridge.replay.logs.events import LogError, LogSource
from sim_bridge.replay.logs.files import opened
from sim_bridge.replay.logs.surveyed import OwnWords
from sim_bridge.replay.logs.telemetry.frames import STAMP_BYTES, V1, V2, is_frame
from sim_bridge.replay.logs.telemetry.source import TlogSource
from sim_bridge.replay.logs.ulog.source import MAGIC, UlogSource

SNIFFED_BYTES = 1 << 16
FEW_FRAMES = 2
_EXPECTED = "a flight log (.tlog, dataflash .BIN, .ulg; gzip accepted)"


def open_log(
    path: Path, *, frame: FleetFrame | None, sensors: SensorsTable, ours: OwnWords = OwnWords()
) -> LogSource:
    """A flight log, plain or gzip; nothing but its beginning is read yet.

    Without ``frame`` positions are about the log's own origin, home or first fix. Raises `LogError` if the
    file is empty, no log, or a .ulg without the package that reads it.
    """
    skipped: Counter[str] = Counter()
    with opened(path, skipped) as file:
        head = file.read(SNIFFED_BYTES)
    if not head:
        raise LogError(path, _EXPECTED, "a damaged gzip stream" if skipped else "an empty file")
    if head.startswith(MAGIC):
        return UlogSource(path, frame, sensors, ours)
    if FORMAT_OF_FORMAT in head:
        return DataflashSource(path, frame, sensors, ours)
    if _holds_frames(head):
        if _without_stamps(head):
            raise LogError(path, "frames with time stamps (the .tlog beside it)", "frames without any (a .tlog.raw?)")
        return TlogSource(path, frame, sensors, ours)
    raise LogError(path, _EXPECTED, f"{len(head)} bytes of something else, beginning {head[:8]!r}")


def _without_stamps(head: bytes) -> bool:
    """Whether most frames follow each other at once, without the room that a stamp takes (``mav.tlog.raw``)."""
    at_once = stamped = at = 0
    while at < len(head):
        end = at + is_frame(head, at) if head[at] in (V1, V2) else at
        if end == at:
            at += 1
            continue
        at_once += is_frame(head, end) > 0
        stamped += is_frame(head, end + STAMP_BYTES) > 0
        at = end
    return at_once > stamped


def _holds_frames(head: bytes) -> bool:
    """Whether MAVLink frames with correct checksums are here, with room for stamps before them."""
    found, at = 0, STAMP_BYTES
    while at < len(head):
        if head[at] in (V1, V2) and is_frame(head, at):
            found += 1
            if found >= FEW_FRAMES or at == STAMP_BYTES:
                return True
        at += 1
    return False
