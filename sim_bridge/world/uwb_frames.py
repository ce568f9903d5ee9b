"""The simulated UWB modules as driver processes: ranges as ``uwb-range/1`` frames, numbered per observer."""

from __future__ import annotations

from sim_bridge.world.sensors import SensedRanges
from transport.messages.uwb_body import MAX_RANGE_M, UwbFrame, UwbRange, encode_uwb_json


class UwbDrivers:
    """Makes all observers' frames; their times are on the clock of ``now``."""

    def __init__(self) -> None:
        self._sequence: dict[int, int] = {}

    def payload(self, taken_s: float, ranges: SensedRanges) -> bytes:
        """One frame as it travels, stamped ``taken_s`` as CLOCK_MONOTONIC of this host."""
        return encode_uwb_json(self.frame(taken_s, ranges))

    def frame(self, taken_s: float, ranges: SensedRanges) -> UwbFrame:
        """The same as a value."""
        sequence = self._sequence.get(ranges.observer, 0)
        self._sequence[ranges.observer] = sequence + 1
        entries = tuple(
            UwbRange(
                other=measured.target,
                range_m=measured.range_m,
                sigma_m=measured.sigma_m,
                nlos=measured.nlos,
                rx_dbm=measured.rx_dbm,
                first_path_dbm=measured.first_path_dbm,
                tag=measured.tag,
                other_tag=measured.other_tag,
            )
            for measured in ranges.ranges
            if measured.range_m <= MAX_RANGE_M
        )
        return UwbFrame(sequence, "mono", round(1e9 * taken_s), entries, ranges.observer)
