"""What a daemon says of itself once a second: counters and gauges by name, units in the names."""

from __future__ import annotations

import math
import os
import resource
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np

from agent.onboard import OnboardAgent
from agent.watch.health import Health
from estimators.integrity.protection.statement import IntegrityState
from estimators.model.measurements import Kind
from transport.messages.header import MAX_BODY_BYTES, PacketKind
from transport.messages.report_body import Diagnostics

TICKS_REMEMBERED = 1024
TICKS_REMEMBERED = 1024
MAX_NAME, MAX_REASON, MAX_NEIGHBOURS = 64, 128, 256
"""Characters of a name, of a reason, and neighbours: more a packet of diagnostics does not hold."""


class TickTimes:
    """How long the last ticks took to compute and how late after their end they were out, in s."""

    def __init__(self) -> None:
        self._compute_s: deque[float] = deque(maxlen=TICKS_REMEMBERED)
        self._latency_s: deque[float] = deque(maxlen=TICKS_REMEMBERED)

    def add(self, compute_s: float, latency_s: float) -> None:
        """Note one tick."""
        self._compute_s.append(compute_s)
        self._latency_s.append(latency_s)

    def gauges(self) -> dict[str, float]:
        """Median and 99th percentile of both, nothing before the first tick."""
        gauges: dict[str, float] = {}
        for name, values in (("tick_time", self._compute_s), ("publish_latency", self._latency_s)):
            if values:
                median, tail = np.percentile(list(values), [50, 99])
                gauges |= {f"{name}_p50_s": float(median), f"{name}_p99_s": float(tail)}
        return gauges


class ProcessUse:
    """Share of one core used since the start of the process's measurement, and resident memory."""

    def __init__(self) -> None:
        self._wall_s = time.monotonic()
        self._cpu_s = _cpu_s()

    def gauges(self) -> dict[str, float]:
        """``cpu_fraction`` and ``rss_mb``."""
        wall_s = max(time.monotonic() - self._wall_s, 1e-3)
        return {"cpu_fraction": (_cpu_s() - self._cpu_s) / wall_s, "rss_mb": _rss_mb()}


def _cpu_s() -> float:
    use = resource.getrusage(resource.RUSAGE_SELF)
    return use.ru_utime + use.ru_stime


def _rss_mb() -> float:
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:  # another system, or no descriptor is left: then the largest that it was
        pass
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


_ON_THE_LINK = ("imu", "attitude", "gps", "baro", "ground", "odometry", "flow")


def counters_of(onboard: OnboardAgent) -> dict[str, int]:
    """Everything that the agent counts, by name; names of the same thing share their first word."""
    core, session, uwb, opener = onboard.core, onboard.autopilot, onboard.uwb, onboard.opener
    decoder = session.decoder
    counters = {
        "mavlink rx": decoder.received,
        "mavlink tx": session.sent,
        "mavlink lost": decoder.lost,
        "mavlink bad": decoder.bad.total(),
        "mavlink reboots": session.reboots,
        "mavlink handovers": session.handovers,
        "timesync rejected": session.clock.rejected,
        "uwb frames": uwb.intake.received,
        "uwb unusable": uwb.intake.skipped,
        "packets sent": onboard.sealer.sent,
        "packets unsent": onboard.unsent.total(),
        "records left out": onboard.sealer.left_out,
        "range: attitude unknown": core.records.unturned,
        "packets received": sum(peer.received for _, peer in opener.peers.items()),
        "packets lost": sum(peer.lost for _, peer in opener.peers.items()),
    }
    tables: Iterable[tuple[str, dict[str, int]]] = (
        ("", dict(core.counters)),
        ("mavlink ignored ", dict(session.ignored)),
        ("mavlink bad ", dict(decoder.bad)),
        ("mavlink refused ", {} if decoder.signing is None else dict(decoder.signing.refused)),
        ("skipped ", dict(session.samples.skipped)),
        ("skipped ", dict(session.velocities.skipped)),
        ("noted ", dict(session.samples.noted)),
        ("", {} if onboard.feeder is None else dict(onboard.feeder.counters)),
        ("", _samples(onboard)),
        ("skipped ", dict(core.timeline.skipped)),
        ("skipped uwb ", dict(uwb.skipped)),
        ("skipped detection ", dict(onboard.detections.skipped)),
        ("gps latency ", dict(core.gps_latency.counters)),
        ("refused ", dict(core.records.refused)),
        ("rejected uwb ", uwb.intake.rejections.as_dict()),
        ("rejected detection ", onboard.detections.intake.rejections.as_dict()),
        ("rejected ", opener.peers.rejections()),
    )
    for prefix, table in tables:
        counters |= {f"{prefix}{name}"[:MAX_NAME]: count for name, count in table.items()}
    return counters


def _samples(onboard: OnboardAgent) -> dict[str, int]:
    """What came of each sensor (messages of the autopilot's link, or samples made elsewhere), and what was used.

    The rest is in the counters of what was skipped, at a wrong time or late.
    """
    core, told = onboard.core, onboard.autopilot.samples.received + onboard.autopilot.velocities.received
    counted = {f"{kind}: received": told[kind] or core.counters[f"{kind}: samples"] for kind in _ON_THE_LINK}
    counted |= {f"{kind}: used": core.timeline.used[kind] for kind in ("imu", "attitude")}
    counted["range: received"] = (
        core.counters["range: samples"] + core.counters["range: not ours"] + sum(onboard.uwb.skipped.values())
    )
    counted["imu: waiting"] = core.timeline.waiting
    counted["range: not located"] = core.records.unused_ranges
    return counted


def gauges_of(onboard: OnboardAgent, now_s: float) -> dict[str, float]:
    """What is measured at this moment, fleet time ``now_s``; what is not known is left out."""
    core, session = onboard.core, onboard.autopilot
    rates = {f"rate_{mid}_hz": stream.rate_hz for mid, stream in session.rates.streams.items()}
    gauges = {
        "rtt_s": session.clock.rtt_s,
        "gps_fix_type": float(session.samples.fix_type),
        "gps_frozen": float(session.samples.frozen),
        "gps_age_s": core.gps_age_s(now_s),
        "gps_latency_s": core.gps_latency.latency_s,
        "gps_latency_sigma_s": core.gps_latency.sigma_s,
        **nis_gauges(onboard, onboard.agent_id),
        **protection_gauges(onboard),
        **rates,
    }
    return {name: value for name, value in gauges.items() if value is not None and math.isfinite(value)}


def neighbour_gauges(onboard: OnboardAgent, host_s: float, now_s: float) -> dict[str, dict[str, float]]:
    """The state of each neighbour's link by id; the opener keeps host time, the core fleet time."""
    core, opener = onboard.core, onboard.opener
    peers = {str(agent_id): peer.as_dict(host_s) for agent_id, peer in opener.peers.items()}
    for agent_id, age_s in core.neighbours.ages_s(now_s).items():
        peers[str(agent_id)]["heard_age_s"] = age_s
    near = {int(name): gauges for name, gauges in peers.items() if int(name) in core.neighbours}
    of_pair = nis_gauges, bias_gauges, relative_gauges
    return {str(each): gauges | _merged(about(onboard, each) for about in of_pair) for each, gauges in near.items()}


def _merged(tables: Iterable[dict[str, float]]) -> dict[str, float]:
    return {name: value for table in tables for name, value in table.items()}


def protection_gauges(onboard: OnboardAgent) -> dict[str, float]:
    """Protection levels of the own position (docs/integrity.md), and whether it is within the alert limits."""
    stated = onboard.core.integrity.statement
    if stated is None:
        return {}
    alert = stated.state in (IntegrityState.ALERT, IntegrityState.NOT_OBSERVABLE)
    return {
        "protection_horizontal_m": round(stated.own.horizontal_m, 3),
        "protection_vertical_m": round(stated.own.vertical_m, 3),
        "integrity_alert": float(alert),
    }


def relative_gauges(onboard: OnboardAgent, agent_id: int) -> dict[str, float]:
    """Protection levels of a neighbour's relative position, beside them its guaranteed set, and whether it is off."""
    stated = onboard.core.integrity.statement
    gauges: dict[str, float] = {}
    if stated is not None and agent_id in stated.relative:
        level = stated.relative[agent_id]
        gauges["protection_horizontal_m"] = round(level.horizontal_m, 3)
        gauges["protection_vertical_m"] = round(level.vertical_m, 3)
    if stated is not None and agent_id in stated.guaranteed:
        held = stated.guaranteed[agent_id]
        gauges["guaranteed_half_axis_m"] = round(float(held.half_axes_m[0]), 3)
        gauges["guaranteed_least_range_m"] = round(held.least_range_m, 3)
    if stated is not None and agent_id in stated.off:
        gauges["fixes_off_m"] = round(stated.off[agent_id], 3)
    return gauges


def target_states(onboard: OnboardAgent) -> dict[str, str]:
    """What is known of each target, by its id as text; nothing before the first estimate."""
    stated = onboard.core.integrity.statement
    return {} if stated is None else {str(each): str(state) for each, state in stated.targets.items()}


def nis_gauges(onboard: OnboardAgent, agent_id: int) -> dict[str, float]:
    """How well an agent's measurements fit the estimate (`estimators.integrity.innovations`): about 1 if as claimed.

    Of the own agent the ranges to all others, of another those between it and the own one. What was not measured is
    left out.
    """
    fleet = onboard.core.fleet
    innovations, present = fleet.innovations, fleet.present
    if innovations is None or agent_id not in present:
        return {}
    slot, own = present.index(agent_id), present.index(onboard.agent_id)
    squares = innovations.squares[slot]
    nis = {
        "nis_gps_position": squares[Kind.POSITION],
        "nis_gps_velocity": squares[Kind.VELOCITY],
        "nis_gps_speed": squares[Kind.SPEED],
        "nis_heights": squares[Kind.HEIGHT],
        "nis_odometry": squares[Kind.ODOMETRY],
        "nis_sightings": squares[Kind.RELATIVE],
        "nis_ranges": squares[Kind.RANGE] if slot == own else innovations.pairs[own, slot],
        "weight_gps_position": innovations.weights[slot, Kind.POSITION],
    }
    return {name: round(float(value), 3) for name, value in nis.items() if math.isfinite(value)}


def bias_gauges(onboard: OnboardAgent, agent_id: int) -> dict[str, float]:
    """What ranges between the own and another drone are too long by, as estimated; nothing where that is unknown."""
    fleet = onboard.core.fleet
    biases, present = fleet.range_biases, fleet.present
    if biases is None or agent_id not in present or onboard.agent_id not in present:
        return {}
    pair = present.index(onboard.agent_id), present.index(agent_id)
    gauges = {"range_bias_m": biases.bias_m[pair], "range_bias_sigma_m": biases.sigma_m[pair]}
    return {name: round(float(value), 4) for name, value in gauges.items() if math.isfinite(value)}


def diagnostics_of(
    agent_id: int,
    health: Health,
    counters: dict[str, int],
    gauges: dict[str, float],
    neighbours: dict[str, dict[str, float]],
    integrity: str = "",
    targets: dict[str, str] | None = None,
) -> Diagnostics:
    """The message that goes out; of very many neighbours the first ones, as many as fit into it."""
    reasons = tuple(reason[:MAX_REASON] for reason in health.reasons)
    said = integrity[:MAX_REASON]
    message = Diagnostics(
        agent_id, str(health.state), reasons, counters, gauges, integrity=said, targets=targets or {}
    )
    return msgspec.structs.replace(message, neighbours=_fitting(neighbours, len(msgspec.json.encode(message))))


def _fitting(neighbours: dict[str, dict[str, float]], taken_bytes: int) -> dict[str, dict[str, float]]:
    """Neighbours for whom a body has room that already holds so many bytes."""
    left_bytes = MAX_BODY_BYTES[PacketKind.DIAG] - taken_bytes - len(',"neighbours":{}')
    fitting: dict[str, dict[str, float]] = {}
    for agent_id, gauges in neighbours.items():
        left_bytes -= len(msgspec.json.encode({agent_id: gauges})) - len("{}") + len(",")
        if left_bytes < 0 or len(fitting) == MAX_NEIGHBOURS:
            break
        fitting[agent_id] = gauges
    return fitting
