"""A hostile peer against a running daemon: what is refused and counted, and what it costs; see docs/results.md.

``python -m tests.fleet.fuzz_daemon --packets 100000 --datagrams 100000 --seed 0`` from the root of the repository
flies line3, its third drone on a circle, with signed packets on free loopback ports and fuzzes agent 2, in the
middle of the line, over a real Zenoh session and over its MAVLink port. Everything sent has to be found again in the
daemon's own counters, and no drone's position may be further off than its covariance says.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from agent.config.reading import load_config
from fleetloc.output import print_table, write_json
from fleetloc.run import run_files
from tests.fleet.fuzz_attack import attack_fleet
from tests.fleet.fuzz_traffic import DatagramMaker
from tests.fleet.fuzz_verdict import complaints, figures, lateness
from tests.support.fleet_process import FleetProcess, on_free_ports, with_overrides
from tests.support.machine import Witness, witnessed
from tests.support.own_error import SMOOTH_PATHS
from transport.security.keys import init_keys

FLIGHT_S = 240.0
"""Longer than any attack: the fleet is interrupted when it has been measured."""


def fuzz(folder: Path, packets: int, datagrams: int, duration_s: float, seed: int) -> dict[str, Any]:
    """One whole run in an empty folder; the figures, with ``complaints``."""
    made = list(DatagramMaker(np.random.default_rng((seed, 1))).make(datagrams))
    init_keys(folder / "keys", (1, 2, 3))
    overrides = [*on_free_ports(3), *SMOOTH_PATHS, "security.mode=signed", f"security.keys={folder / 'keys'}"]
    options = ("--duration", str(FLIGHT_S), "--seed", "1")
    fleet = FleetProcess(folder / "run", *with_overrides(overrides), *options)
    try:
        with witnessed(folder) as witness:
            attack = attack_fleet(fleet, packets, made, duration_s, seed)
        fleet.interrupt()
        code, _, stderr = fleet.finish()
        config = load_config(fleet.out / run_files.CONFIG)
        result = figures(config, fleet, attack, Witness(witness))
    finally:
        fleet.clean_up()
    result["exit_code"] = code
    result["complaints"] = complaints(result) + ([f"fleet ended with {code}: {stderr}"] if code else [])
    return result


def show(result: dict[str, Any]) -> None:
    """Tables for people."""
    for what in ("packets", "datagrams"):
        rows = [[name, str(n)] for name, n in result[what]["by_class"].items()]
        print_table([what, "sent"], [*sorted(rows), ["all", str(result[what]["sent"])]])
    rows = [[name, str(c["expected"]), str(c["found"])] for name, c in result["counters"].items()]
    print_table(["counter of the daemon", "expected", "found"], rows)
    print_table(["refused", "packets"], [[name, str(n)] for name, n in result["rejected_by_reason"].items()])
    columns = ["agent", "ticks on time", "RMSE m", "NEES mean", "NEES worst", "late packets"]
    rows = [
        [str(a["id"]), f"{a['ticks_on_time']}/{a['ticks_expected']}", f"{a['position_rmse_m']:.3f}",
         f"{a['own_nees_mean']:.2f}", f"{a['own_nees_worst']:.1f}", str(a["late_packets"])]
        for a in result["agents"]
    ]  # fmt: skip
    print_table(columns, rows)
    rest = (
        "packets_shed", "packets_lost_of_neighbours", "packets_of_neighbours", "own_ranges_aged", "socket_drops",
        "program_faults", "reboots", "resident_mb_before", "resident_mb_after", "duration_s", "machine_late_s",
        "simulator_behind_s",
    )  # fmt: skip
    print_table(["", ""], [[name, f"{result[name]:.1f}".removesuffix(".0")] for name in rest])


def main() -> int:
    """The command; the exit code says whether the daemon withstood."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packets", type=int, default=100_000)
    parser.add_argument("--datagrams", type=int, default=100_000)
    parser.add_argument("--duration", type=float, default=60.0, help="seconds that the attack takes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = fuzz(Path(folder), options.packets, options.datagrams, options.duration, options.seed)
    show(result)
    if options.json is not None:
        write_json(options.json, result)
    result["complaints"] += lateness(result)
    for complaint in result["complaints"]:
        sys.stderr.write(f"fuzz_daemon: {complaint}\n")
    return 1 if result["complaints"] else 0


if __name__ == "__main__":
    sys.exit(main())
