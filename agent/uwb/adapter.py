"""UWB ranges as ``uwb-range/1`` frames to range samples; what a serial driver makes goes the same way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace

from agent.config.tables import SensorsTable, UwbPair
from agent.sensing.samples import RangeSample
from transport.messages.uwb_body import MAX_TAGS, UwbFrame, UwbIntake, UwbRange

NLOS_REJECT_DB = 10.0
NLOS_SUSPECT_DB = 6.0
NLOS_SUSPECT_PROBABILITY = 0.5
NLOS_SIGMA_FACTOR = 3.0
MAX_LEAD_S = 0.05
MAX_AGE_S = 1.0
"""An older frame comes too late for the usual window, 6 ticks of 0.1 s."""


class UwbAdapter:
    """The ranges that one observer's module sees.

    A first path much weaker than the whole signal means no line of sight: such a range is far too long. It is
    refused above 10 dB and trusted a third as much above 6 dB (the rule of thumb for DW1000 radios).
    """

    def __init__(
        self, observer: int, others: Collection[int], sensors: SensorsTable, antennas: Mapping[int, int] | None = None
    ) -> None:
        """``antennas``: how many are configured, by agent; who is not in it may have any."""
        self._antennas = antennas or {}
        self._observer = observer
        self._others = frozenset(others)
        self._sensors = sensors
        self._pairs = {_seen_from(observer, each): each for each in sensors.uwb_pairs if observer in each.pair}
        """What calibration found, by the other drone, and by the own antenna and the other's where it is of these."""
        self.intake = UwbIntake(observer, max_age_s=MAX_AGE_S)
        self.skipped: Counter[str] = Counter()
        """Ranges left out, by reason; `intake` counts refused frames."""

    def receive(self, payload: bytes, *, now_s: float, host_s: float, unix_s: float) -> list[RangeSample]:
        """The samples in a frame.

        ``now_s`` is the fleet time of its arrival, ``host_s`` and ``unix_s`` the same instant on this host's
        monotonic and UTC clocks, one of which the driver stamped with.
        """
        accepted = self.intake.accept(payload, unix_s=unix_s, monotonic_s=host_s)
        if accepted is None:
            return []
        return self.samples_of(*accepted, now_s)

    def samples_of(self, frame: UwbFrame, age_s: float, now_s: float) -> list[RangeSample]:
        """The samples in a frame that was accepted ``age_s`` after its measurement, at fleet time ``now_s``."""
        measured_s = now_s - max(age_s, 0.0) - self._sensors.uwb_latency_s
        entries = (self._calibrated(entry) for entry in frame.ranges)
        samples = (self._sample(entry, measured_s, now_s) for entry in entries if entry is not None)
        return [sample for sample in samples if sample is not None]

    def _calibrated(self, entry: UwbRange) -> UwbRange | None:
        """The range less its pair's bias; one that is then none is left out."""
        known = self._pairs.get((entry.other, (entry.tag, entry.other_tag))) or self._pairs.get((entry.other, None))
        if known is None:
            return entry
        if entry.range_m <= known.bias_m:
            self.skipped["shorter than its bias"] += 1
            return None
        sigma_m = known.sigma_m if entry.sigma_m is None else entry.sigma_m
        return replace(entry, range_m=entry.range_m - known.bias_m, sigma_m=sigma_m)

    def _sample(self, entry: UwbRange, measured_s: float, now_s: float) -> RangeSample | None:
        sigma_m = self._sensors.uwb_sigma_m if entry.sigma_m is None else entry.sigma_m
        t_s = measured_s + entry.offset_s
        if entry.other not in self._others:
            return self._skip("not a neighbour")
        if not self._has_tag(self._observer, entry.tag) or not self._has_tag(entry.other, entry.other_tag):
            return self._skip("unknown tag")
        if t_s > now_s + MAX_LEAD_S:
            return self._skip("wrong time")
        weakness_db = 0.0
        if entry.rx_dbm is not None and entry.first_path_dbm is not None:
            weakness_db = entry.rx_dbm - entry.first_path_dbm
        if weakness_db > NLOS_REJECT_DB:
            return self._skip("no line of sight")
        if weakness_db > NLOS_SUSPECT_DB or (entry.nlos or 0.0) > NLOS_SUSPECT_PROBABILITY:
            sigma_m *= NLOS_SIGMA_FACTOR
        sigma_m = max(sigma_m, self._sensors.uwb_sigma_floor_m)
        return RangeSample(
            t_s, self._observer, entry.other, entry.range_m, sigma_m, entry.tag, entry.other_tag
        )

    def _has_tag(self, agent_id: int, tag: int) -> bool:
        return tag < self._antennas.get(agent_id, MAX_TAGS)

    def _skip(self, reason: str) -> RangeSample | None:
        self.skipped[reason] += 1
        return None


def _seen_from(observer: int, pair: UwbPair) -> tuple[int, tuple[int, int] | None]:
    """The other drone of a pair, and the antennas that its calibration is of, the observer's first."""
    other = sum(pair.pair) - observer
    if pair.tags is None or pair.pair[0] == observer:
        return other, pair.tags
    return other, (pair.tags[1], pair.tags[0])
