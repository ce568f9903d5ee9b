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
from fleetloc.report.range_study import NORMAL_OF_MAD
from sim_bridge.replay.flight_log_replay import agent_of, recorded_config
from transport.errors import Rejected
from transport.messages.report_body import Diagnostics
from transport.messages.uwb_body import decode_uwb
from transport.security.opening import Received

Pair = tuple[int, int]


@dataclass(slots=True)
class _Flown:
    """What one flight log tells."""

    biases: dict[Pair, tuple[float, float]] = field(default_factory=dict)
    """The last estimate of each pair and its 1-sigma, m."""
    residuals_m: dict[Pair, list[float]] = field(default_factory=dict)
    """Own ranges less the estimated distance, calibrated biases put back."""
    waiting: list[tuple[float, int, float]] = field(default_factory=list)
    """Own ranges whose tick is not estimated yet: fleet time, the other, m."""


def study_flight_logs(paths: Sequence[Path], json_file: Path | None, write: Path | None) -> list[CalibratedPair]:
    """Repeat flights from their logs and tell what they say of each pair's ranges.

    Of several logs of one flight, the surest estimate of a pair counts: they used the same measurements. Raises
    `LogFileError` for a file that is no flight log, `InputError` where none estimates biases.
    """
    best: dict[Pair, tuple[float, float]] = {}
    residuals: dict[Pair, list[float]] = {}
    for path in paths:
        flown = _fly(path)
        for pair, found in flown.biases.items():
            if pair not in best or found[1] < best[pair][1]:
                best[pair] = found
        for pair, values in flown.residuals_m.items():
            residuals.setdefault(pair, []).extend(values)
    if not best:
        expected = "flights with ranges whose estimator has systematic_errors on"
        raise InputError(
            ", ".join(path.name for path in paths), "", expected, "no pair of which a range told anything"
        )
    pairs = [_calibrated(pair, *best[pair], residuals.get(pair, [])) for pair in sorted(best)]
    _tell(pairs, "ranges less distance, as the flight's estimators found", json_file, write)
    return pairs


def _calibrated(pair: Pair, bias_m: float, bias_sigma_m: float, residuals_m: list[float]) -> CalibratedPair:
    sigma_m = None
    if residuals_m:
        values = np.array(residuals_m)
        sigma_m = NORMAL_OF_MAD * float(np.median(np.abs(values - np.median(values))))
    return CalibratedPair(pair, len(residuals_m), bias_m, bias_sigma_m, sigma_m)


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
                _compare(flown, output, config, onboard.agent_id)
        if isinstance(entry.event, UwbIn):
            flown.waiting += _own_ranges(entry.event, onboard)
    return flown


def _configured(config: FleetConfig) -> Mapping[Pair, float]:
    """Biases that the drones took off already."""
    return {(min(each.pair), max(each.pair)): each.bias_m for each in config.sensors.uwb_pairs}


def _biases(ready: EstimateReady, known: Mapping[Pair, float]) -> Iterator[tuple[Pair, tuple[float, float]]]:
    biases, members = ready.estimate.range_biases, ready.joint
    if biases is None or members is None:
        return
    for one, other in np.argwhere(np.triu(np.isfinite(biases.bias_m))).tolist():
        pair = min(members[one], members[other]), max(members[one], members[other])
        yield pair, (float(biases.bias_m[one, other]) + known.get(pair, 0.0), float(biases.sigma_m[one, other]))


def _own_ranges(event: UwbIn, onboard: OnboardAgent) -> Iterator[tuple[float, int, float]]:
    try:
        frame = decode_uwb(event.data)
    except Rejected:
        return  # the agent has counted it
    taken_s = onboard.fleet_s(frame.t_ns * 1e-9 if frame.clock == "mono" else event.host_s)
    for each in frame.ranges:
        yield taken_s + each.offset_s, each.other, each.range_m


def _compare(flown: _Flown, ready: EstimateReady, config: FleetConfig, own: int) -> None:
    """Ranges about this tick against the distance in its estimate."""
    members, half_s = ready.joint or (), 0.5 * config.fleet.period_s
    mean = ready.estimate.mean.reshape(-1, 6)
    late = [each for each in flown.waiting if each[0] > ready.t_s + half_s]
    for taken_s, other, range_m in flown.waiting:
        if abs(taken_s - ready.t_s) <= half_s and own in members and other in members:
            between = mean[config.ids.index(own)] - mean[config.ids.index(other)]
            distance_m = float(np.linalg.norm(between[:3] + (taken_s - ready.t_s) * between[3:]))
            if math.isfinite(distance_m):
                flown.residuals_m.setdefault((min(own, other), max(own, other)), []).append(range_m - distance_m)
    flown.waiting = late


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
