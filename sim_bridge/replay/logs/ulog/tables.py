"""The topics of a PX4 log that matter, as plain columns.

Read by pyulog (extra ``[ulog]``), which holds all records of the topics asked for in memory; of those only the
columns used here are kept. Measured on 200 s of a full-rate log: 22 MB at most, 6 MB kept, which is 100 MB per hour
of flight. Nothing else grows with the log.
"""

from __future__ import annotations

import contextlib
import io
import struct
import tempfile
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.replay.logs.events import LogError
from sim_bridge.replay.logs.files import opened

MAGIC = b"ULog\x01\x12\x35"
COPIED_BYTES = 1 << 20
READ_AT_MOST = 8
"""Times the file's size."""
CALL_BYTES = 4
"""What one call to read counts as, beside the bytes."""
INSTALL = "pip install 'fleetloc[ulog]'"
LONGEST_LOG_US = 24 * 3600 * 1_000_000
_DAMAGE = (
    struct.error, ValueError, TypeError, IndexError, KeyError, AttributeError, EOFError, OverflowError, OSError,
    MemoryError,
)  # fmt: skip
"""What pyulog raises over damaged files, besides its own errors (which are none of these)."""

Column = NDArray[Any]


@dataclass(frozen=True, slots=True)
class TopicTable:
    """Records of one topic in ascending ``timestamp`` (us of boot time, int64), columns by field name."""

    name: str
    timestamp_us: NDArray[np.int64]
    columns: Mapping[str, Column]

    def __len__(self) -> int:
        return len(self.timestamp_us)

    def stack(self, *names: str) -> NDArray[np.float64] | None:
        """Columns side by side ``(m, k)``; ``None`` unless all are there."""
        if any(name not in self.columns for name in names):
            return None
        return np.stack([np.asarray(self.columns[name], np.float64) for name in names], axis=1)


@dataclass(frozen=True, slots=True)
class Tables:
    """What was kept of a log: the first instance of each topic, of some all by their numbers, and the parameters."""

    topics: Mapping[str, TopicTable]
    parameters: Mapping[str, float]
    instances: Mapping[str, Mapping[int, TopicTable]] = field(default_factory=dict)


class Unpacked:
    """A file from its start, that ends the reading once far more was read of it than it holds.

    Over damaged headers pyulog goes back and reads again, in some files for ever.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._left = READ_AT_MOST * (file.seek(0, io.SEEK_END) + COPIED_BYTES)
        file.seek(0)
        self.tell, self.close = file.tell, file.close

    def read(self, size: int) -> bytes:
        """At most ``size`` bytes; raises `OSError` when the reading leads nowhere."""
        self._left -= size + CALL_BYTES
        if self._left < 0:
            raise OSError("headers that send the reader back and back")
        return self._file.read(size)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place of the file."""
        return self._file.seek(offset, whence)


def load_tables(
    path: Path, wanted: Mapping[str, tuple[str, ...]], skipped: Counter[str], *, several: Collection[str] = ()
) -> Tables:
    """Read the wanted fields of the wanted topics, all instances of ``several`` of them.

    ``skipped`` counts records left out and damage. Raises `LogError` if the file cannot be read or pyulog is
    not installed.
    """
    try:
        from pyulog import ULog
    except ImportError:
        raise LogError(path, f"the package that reads .ulg files ({INSTALL})", "it is not installed") from None
    with tempfile.TemporaryFile() as unpacked:  # pyulog goes back and forth, which gzip does only in quadratic time
        with opened(path, skipped) as file:
            while block := file.read(COPIED_BYTES):
                unpacked.write(block)
        log = _parsed(ULog, path, Unpacked(unpacked), list(wanted))
    if log.file_corruption:
        skipped["damaged stretches of the file (at least one)"] += 1
    if log.dropouts:
        skipped["dropouts of the logger"] += len(log.dropouts)
    topics: dict[str, TopicTable] = {}
    instances: dict[str, dict[int, TopicTable]] = {}
    while log.data_list:  # one by one, so that both forms of a topic are in memory together only once
        data = log.data_list.pop()
        if data.multi_id and data.name not in several:
            continue
        table = _table(data.name, data.data, wanted[data.name], skipped)
        if table is not None and data.name in several:
            instances.setdefault(data.name, {})[data.multi_id] = table
        elif table is not None:
            topics[data.name] = table
    numbers = {name: value for name, value in log.initial_parameters.items() if isinstance(value, int | float)}
    return Tables(topics, numbers, instances)


def _parsed(ulog: Any, path: Path, file: Unpacked, names: list[str]) -> Any:
    """The parsed log; what pyulog prints about damage is in its ``file_corruption`` as well."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            return ulog(file, names, True)
    except _DAMAGE as error:
        raise LogError(path, "a readable .ulg", f"damage that pyulog cannot pass: {error!r}") from None
    except Exception as error:
        if type(error).__module__.partition(".")[0] != "pyulog":
            raise
        raise LogError(path, "a readable .ulg", str(error)) from None


def _table(
    name: str, data: Mapping[str, Column], fields: tuple[str, ...], skipped: Counter[str]
) -> TopicTable | None:
    stamps = data.get("timestamp")
    if stamps is None or stamps.dtype != np.uint64:
        skipped[f"{name}: its description is damaged"] += 1
        return None
    usable = np.flatnonzero(stamps < np.uint64(1 << 62))
    stamps_us = stamps[usable].astype(np.int64)
    kept = usable[in_order(stamps_us)]
    if len(kept) < len(stamps):
        skipped[f"{name}: wrong time"] += len(stamps) - len(kept)
    if not len(kept):
        return None
    columns = {
        field: np.ascontiguousarray(data[field][kept])
        for field in fields
        if field in data and data[field].dtype.kind in "fiub"
    }
    return TopicTable(name, stamps[kept].astype(np.int64), columns)


def in_order(stamps_us: NDArray[np.int64]) -> NDArray[np.int64]:
    """Places of the longest choice of stamps that never decreases, within a day of their median.

    A stamp with a flipped bit breaks the order; which of two neighbours is the wrong one is decided by
    leaving out as few as possible.
    """
    if not len(stamps_us):
        return np.zeros(0, np.int64)
    near = np.flatnonzero(np.abs(stamps_us - np.int64(np.median(stamps_us))) <= LONGEST_LOG_US)
    values = stamps_us[near]
    if (np.diff(values) >= 0).all():
        return near
    tails: list[int] = []
    tail_places: list[int] = []
    before = np.full(len(values), -1, np.int64)
    for place, value in enumerate(values.tolist()):
        length = bisect_right(tails, value)
        if length == len(tails):
            tails.append(value)
            tail_places.append(place)
        else:
            tails[length] = value
            tail_places[length] = place
        if length:
            before[place] = tail_places[length - 1]
    chosen = []
    place = tail_places[-1]
    while place >= 0:
        chosen.append(place)
        place = int(before[place])
    return near[np.array(chosen[::-1], np.int64)]
