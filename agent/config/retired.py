"""Keys that are no longer keys, or were not always: what each is now, and the old files that still have them.

Nobody set them, so each is a constant beside the code that uses it. A fleet's file that has one is refused with what
took its place. Old flight logs hold the whole configuration that they were flown with, these keys too: there they are
left out where they have the constant's value, and else the log needs the version that it was flown with.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from agent.config.faults import Fault


@dataclass(frozen=True, slots=True)
class Retired:
    """A former key: the value that it has for good, and how that is said."""

    value: object
    words: str


RETIRED: Mapping[str, Retired] = {
    "sensors.gps_sigma_floor_m": Retired(0.02, "it is 2 cm"),
    "sensors.gps_speed_sigma_mps": Retired(0.3, "it is 0.3 m/s"),
    "sensors.gps_uere_m": Retired(2.5, "it is 2.5 m"),
    "sensors.uwb_max_age_s": Retired(1.0, "it is 1 s"),
    "sensors.uwb_max_range_m": Retired(2000.0, "a range over 2000 m is left out"),
    "sensors.attitude_max_age_s": Retired(0.3, "it is 0.3 s"),
    "sensors.accel_gap_sigma_mps2": Retired(1.1547, "it is 1.1547 m/s2, of a uniform in +-2 m/s2"),
    "initial.position_sigma_m": Retired(50.0, "it is 50 m"),
    "initial.speed_sigma_mps": Retired(3.0, "it is 3 m/s"),
    "initial.max_wait_s": Retired(2.0, "it is 2 s"),
    "mavlink.local_position_hz": Retired(2.0, "it is 2 Hz"),
    "mavlink.timesync_respond": Retired("auto", "the daemon answers until another component is seen answering"),
    "mavlink.rate_floor": Retired(0.6, "it is 0.6"),
    "mavlink.max_rtt_s": Retired(0.01, "it is 10 ms, or twice the best on a slower link"),
    "transport.information_format": Retired("auto", "single precision where the conditioning of a pair allows"),
    "transport.redeclare_after_s": Retired(1.0, "it is 1 s"),
    "transport.faults.burst_loss": Retired(1.0, "a burst loses all packets"),
    "transport.faults.delay_uniform_s": Retired(0.0, "transport.delay_jitter_s is the random delay"),
    "transport.faults.in_order": Retired(False, "a packet does not wait for those before it"),
    "transport.faults.reorder_delay_s": Retired(0.02, "it is 20 ms"),
    "record.max_mb": Retired(200.0, "it is 200 MB"),
    "record.min_free_mb": Retired(100.0, "it is 100 MB"),
    "log.max_mb": Retired(10.0, "it is 10 MB"),
    "log.keep": Retired(5, "it is 5 files"),
    "log.min_free_mb": Retired(100.0, "it is 100 MB"),
    "adsb.period_s": Retired(1.0, "it is 1 s"),
    "adsb.max_sigma_m": Retired(20.0, "it is 20 m"),
    "sim.start_position_half_width_m": Retired(15.0, "it is 15 m"),
    "sim.start_speed_half_width_mps": Retired(2.0, "it is 2 m/s"),
    "sim.imu_hz": Retired(100.0, "it is 100 Hz; mavlink.imu_hz asks for less"),
    "sim.attitude_hz": Retired(50.0, "it is 50 Hz; mavlink.attitude_hz asks for less"),
    "sim.max_accel_mps2": Retired(2.0, "it is 2 m/s2 per axis"),
    "sitl.truth_hz": Retired(50.0, "it is 50 Hz"),
    "sitl.component_id": Retired(194, "it is 194"),
    "monitor.refresh_s": Retired(0.2, "it is 0.2 s"),
    "monitor.stale_after_s": Retired(1.0, "it is 1 s, or three periods"),
    "monitor.lost_after_s": Retired(2.0, "it is 2 s, or six periods"),
}


LATER: Mapping[str, object] = {
    "transport.exchanges": 1,
    "estimator.systematic_errors": False,
    "estimator.robust": False,
    "fleet.joint_bodies": 999,
    "sensors.barometer": False,
    "sensors.odometry": False,
}
"""Keys that came later, and what was so before them: a flight log without such a key was flown like that."""


def explained(fault: Fault) -> Fault:
    """A fault of an unknown key, saying what took its place if it was a key once."""
    retired = RETIRED.get(re.sub(r"\[\d+\]", "", fault.key))
    if retired is None:
        return fault
    return replace(fault, meant="", says=f"no longer a key: {retired.words}; remove the line")


def as_flown(tables: dict[str, Any]) -> tuple[dict[str, Any], list[Fault]]:
    """The configuration of an old flight in today's keys, and the former keys whose value can be had no longer."""
    kept, faults = copy.deepcopy(tables), []
    for key, retired in RETIRED.items():
        inside, name = _table_of(kept, key)
        if name not in inside:
            continue
        value = inside.pop(name)
        if value != retired.value:
            faults.append(Fault(key, "", "", says=f"{value} was set, and it is no longer a key: {retired.words}"))
    for key, before in LATER.items():
        table, _, name = key.rpartition(".")
        kept.setdefault(table, {}).setdefault(name, before)
    return kept, faults


def _table_of(tables: dict[str, Any], key: str) -> tuple[dict[str, Any], str]:
    """The table that a key stands in, empty where there is none, and the key's name in it."""
    *path, name = key.split(".")
    inside: Any = tables
    for step in path:
        inside = inside.get(step) if isinstance(inside, dict) else None
    return (inside if isinstance(inside, dict) else {}), name
