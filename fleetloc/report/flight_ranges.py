"""``fleetloc ranges`` of a flight: what its estimators found of the biases of ranges, from flight logs or live.

In a flight nobody knows the true distances. The estimator of each drone estimates the bias of every pair beside the
places (`estimators.systematic`), with an uncertainty that says how far fixes and geometry tell the two apart.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from agent.config.tables import FleetConfig
from agent.inputs import UwbIn
from agent.log.flight_reader import FlightReader, RecordedInput
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from fleetloc.errors import EnvironmentFault, InputError
from fleetloc.monitor.listener import FleetListener
from fleetloc.output import write_json
from fleetloc.report.pair_calibration import CalibratedPair, as_json, print_pairs, write_lines
from fleetloc.report.range_study import pair_figures
from sim_bridge.replay.flight_log_replay import agent_of, recorded_config
from transport.errors import Rejected
from transport.messages.measurement_body import TagRangeMeasurement
from transport.messages.report_body import Diagnostics
from transport.messages.uwb_body import decode_uwb
from transport.security.opening import Received

Pair = tuple[int, int]
OUTLIER_M = 0.5
"""Errors that are further off do not count for how independent those of a pair are."""


@dataclass(frozen=True, slots=True)
class _OwnRange:
    """A range of the own module, as measured at a fleet time; between which antennas."""

    taken_s: float
    other: int
    range_m: float
    tag: int
    other_tag: int


@dataclass(slots=True)
class _Flown:
    """What one flight log tells."""

    biases: dict[Pair, tuple[float, float]] = field(default_factory=dict)
    """The last estimate of each pair and its 1-sigma, m."""
    residuals_m: dict[tuple[Pair, Pair | None], list[float]] = field(default_factory=dict)
    """Own ranges less the estimated distance, calibrated biases put back; by pair, and tags where there are any."""
    waiting: list[_OwnRange] = field(default_factory=list)
    """Own ranges whose tick is not estimated yet."""


def study_flight_logs(paths: Sequence[Path], json_file: Path | None, write: Path | None) -> list[CalibratedPair]:
    """Repeat flights from their logs and tell what they say of each pair's ranges.

    Of several logs of one flight, the surest estimate of a pair counts: they used the same measurements. Raises
    `LogFileError` for a file that is no flight log, `InputError` where none estimates biases.
    """
    best: dict[Pair, tuple[float, float]] = {}
    residuals: dict[tuple[Pair, Pair | None], list[float]] = {}
    for path in paths:
        flown = _fly(path)
        for pair, found in flown.biases.items():
            if pair not in best or found[1] < best[pair][1]:
                best[pair] = found
        for antennas, values in flown.residuals_m.items():
            residuals.setdefault(antennas, []).extend(values)
    if not best:
        expected = "flights with ranges whose estimator has systematic_errors on"
        raise InputError(
            ", ".join(path.name for path in paths), "", expected, "no pair of which a range told anything"
        )
    pairs = [each for pair in sorted(best) for each in _calibrated(pair, *best[pair], residuals)]
    _tell(pairs, "ranges less distance, as the flight's estimators found", json_file, write)
    return pairs


def _calibrated(
    pair: Pair, bias_m: float, bias_sigma_m: float, residuals_m: Mapping[tuple[Pair, Pair | None], list[float]]
) -> Iterator[CalibratedPair]:
    """What is known of a pair, and of each two of its antennas: how far their ranges are from those of the pair."""
    found = {tags: np.array(values) for (of, tags), values in residuals_m.items() if of == pair}
    if not found:
        yield CalibratedPair(pair, 0, bias_m, bias_sigma_m)
        return
    usual_m = float(np.median(np.concatenate(list(found.values()))))
    for tags, values in sorted(found.items(), key=lambda each: each[0] or (0, 0)):
        figures = pair_figures(pair, values, OUTLIER_M)
        apart_m = 0.0 if tags is None else figures.median_m - usual_m
        spread_m = bias_sigma_m if tags is None else math.hypot(bias_sigma_m, figures.median_sigma_m)
        yield CalibratedPair(pair, figures.count, bias_m + apart_m, spread_m, figures.sigma_m, tags)


def _tell(pairs: list[CalibratedPair], title: str, json_file: Path | None, write: Path | None) -> None:
    print_pairs(pairs, title)
    write_lines(pairs, write)
    if json_file is not None:
        write_json(json_file, {"pairs": as_json(pairs)})


def _fly(path: Path) -> _Flown:
    reader = FlightReader(path)
    config = recorded_config(reader.start, path)
    onboard, flown, known = agent_of(reader, config, make_estimator), _Flown(), _configured(config)
    for entry in reader:
        if not isinstance(entry, RecordedInput):
            continue
        for output in onboard.take(entry.event):
            if isinstance(output, EstimateReady):
                flown.biases |= dict(_biases(output, known))
                _compare(flown, output, config, onboard)
        if isinstance(entry.event, UwbIn):
            flown.waiting += _own_ranges(entry.event, onboard)
    return flown


def _configured(config: FleetConfig) -> Mapping[Pair, float]:
    """Biases that the drones took off already; of a pair's antennas their mean."""
    found: dict[Pair, list[float]] = {}
    for each in config.sensors.uwb_pairs:
        found.setdefault((min(each.pair), max(each.pair)), []).append(each.bias_m)
    return {pair: sum(biases_m) / len(biases_m) for pair, biases_m in found.items()}


def _biases(ready: EstimateReady, known: Mapping[Pair, float]) -> Iterator[tuple[Pair, tuple[float, float]]]:
    biases, members = ready.estimate.range_biases, ready.joint
    if biases is None or members is None:
        return
    for one, other in np.argwhere(np.triu(np.isfinite(biases.bias_m))).tolist():
        pair = min(members[one], members[other]), max(members[one], members[other])
        yield pair, (float(biases.bias_m[one, other]) + known.get(pair, 0.0), float(biases.sigma_m[one, other]))


def _own_ranges(event: UwbIn, onboard: OnboardAgent) -> Iterator[_OwnRange]:
    try:
        frame = decode_uwb(event.data)
    except Rejected:
        return  # the agent has counted it
    taken_s = onboard.fleet_s(frame.t_ns * 1e-9 if frame.clock == "mono" else event.host_s)
    for each in frame.ranges:
        yield _OwnRange(taken_s + each.offset_s, each.other, each.range_m, each.tag, each.other_tag)


def _compare(flown: _Flown, ready: EstimateReady, config: FleetConfig, onboard: OnboardAgent) -> None:
    """Ranges about this tick against the distance of the antennas in its estimate."""
    members, half_s, own = ready.joint or (), 0.5 * config.fleet.period_s, onboard.agent_id
    mean = ready.estimate.mean.reshape(-1, 6)
    late = [each for each in flown.waiting if each.taken_s > ready.t_s + half_s]
    for each in flown.waiting:
        offset_s, other = each.taken_s - ready.t_s, each.other
        if abs(offset_s) > half_s or own not in members or other not in members or other not in config.ids:
            continue
        said = own, round(ready.t_s / config.fleet.period_s), other, each.range_m, 1.0, math.inf, offset_s
        record = TagRangeMeasurement(*said, each.tag, each.other_tag)
        if not onboard.core.records.arms.knows(record):
            continue
        between = mean[config.ids.index(own)] - mean[config.ids.index(other)]
        shift_m = onboard.core.records.arms.shift(record).arm_m
        distance_m = float(np.linalg.norm(between[:3] + offset_s * between[3:] + shift_m))
        if math.isfinite(distance_m):
            flown.residuals_m.setdefault(_antennas(config, own, each), []).append(each.range_m - distance_m)
    flown.waiting = late


def _antennas(config: FleetConfig, own: int, measured: _OwnRange) -> tuple[Pair, Pair | None]:
    """The pair of a range, the lower id first, and their tags in that order where one of them has several."""
    ends = sorted(((own, measured.tag), (measured.other, measured.other_tag)))
    several = any(len(config.agent(agent).uwb_tags_m) > 1 for agent, _ in ends)
    return (ends[0][0], ends[1][0]), (ends[0][1], ends[1][1]) if several else None


async def listen_to_biases(
    config: FleetConfig, base: Path, duration_s: float, json_file: Path | None, write: Path | None
) -> list[CalibratedPair]:
    """Listen to what the daemons of a fleet say of their ranges, for so long, and tell it.

    Raises `EnvironmentFault` where none says anything, `SessionError`, `KeyFileError`.
    """
    known = _configured(config)
    best: dict[Pair, tuple[float, float]] = {}
    reported: dict[int, dict[Pair, tuple[float, float]]] = {}

    def hear(received: Received) -> None:
        if isinstance(received.message, Diagnostics):
            reported[received.sender] = dict(_reported(received.message, known))

    listener = FleetListener(config, base, hear, lambda *_: None)
    await listener.open()
    try:
        await asyncio.sleep(duration_s)
    finally:
        await listener.close()
    for found in reported.values():
        for pair, value in found.items():
            if pair not in best or value[1] < best[pair][1]:
                best[pair] = value
    if not best:
        raise EnvironmentFault(f"no daemon of {config.fleet.name} told biases of its ranges within {duration_s:g} s")
    pairs = [CalibratedPair(pair, 0, *best[pair]) for pair in sorted(best)]
    _tell(pairs, "ranges less distance, as the drones estimate it now", json_file, write)
    return pairs


def _reported(message: Diagnostics, known: Mapping[Pair, float]) -> Iterator[tuple[Pair, tuple[float, float]]]:
    own = message.agent_id
    for name, gauges in message.neighbours.items():
        if name.isdigit() and {"range_bias_m", "range_bias_sigma_m"} <= gauges.keys():
            pair = min(own, int(name)), max(own, int(name))
            yield pair, (gauges["range_bias_m"] + known.get(pair, 0.0), gauges["range_bias_sigma_m"])
