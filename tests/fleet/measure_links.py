"""Which link serves on a lossy radio: a fleet's daemons on a lossy segment, link by link; see docs/links.md.

``python -m tests.fleet.measure_links [--config FILE] [--link L]... [--with FILE]... [--start S]... [--json FILE]``
from the root of the repository, as root. Every run is a simulator and one daemon per drone in network namespaces;
``clean`` has no faults, ``warm`` gets them when all daemons have found each other, ``cold`` has them before.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from agent.config.reading import load_config
from fleetloc.output import print_table, write_json
from tests.support.lossnet.delivery import delivery
from tests.support.lossnet.flight import LossyFlight, why_not

ROOT = Path(__file__).parents[2]
LINKS, STARTS = ("tcp", "udp", "multilink"), ("clean", "warm", "cold")
MEETING_S = 4.0
"""What daemons get to find each other on the clean segment before a warm run begins."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=ROOT / "configs" / "mesh5.toml")
    parser.add_argument("--link", action="append", choices=LINKS)
    parser.add_argument("--with", dest="profiles", action="append", type=Path, help="link profile in place of --link")
    parser.add_argument("--start", action="append", choices=STARTS)
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--loss", type=float, default=0.3, help="of frames, every directed link")
    parser.add_argument("--delay", type=float, default=0.05, help="seconds")
    parser.add_argument("--duration", type=float, default=30.0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="keep the runs' folders here")
    options = parser.parse_args()
    if reason := why_not():
        sys.stderr.write(f"measure_links: {reason}\n")
        return 3
    faults = {"loss": options.loss, "delay_s": options.delay}
    links = [] if options.profiles and not options.link else (options.link or LINKS)
    kinds = [(link, [], [f"transport.link={link}"]) for link in links]
    kinds += [(profile.stem, [profile], []) for profile in options.profiles or ()]
    rows: list[dict[str, Any]] = []
    for (name, profiles, settings), start in itertools.product(kinds, options.start or STARTS):
        overrides = [*settings, *options.overrides]
        with tempfile.TemporaryDirectory() as scratch:
            out = Path(scratch) if options.keep is None else options.keep / f"{name}_{start}"
            shutil.rmtree(out, ignore_errors=True)
            rows.append({"link": name, "start": start} | run(options, out, overrides, profiles, start, faults))
        sys.stderr.write(f"{rows[-1]}\n")
        if options.json is not None:
            write_json(options.json, {"loss": options.loss, "delay_s": options.delay, "runs": rows})
    print_table(list(rows[0]), [[shown(value) for value in row.values()] for row in rows])
    return 0


def run(
    options: argparse.Namespace,
    out: Path,
    overrides: list[str],
    profiles: list[Path],
    start: str,
    faults: dict[str, float],
) -> dict[str, Any]:
    """One flight and its figures."""
    with LossyFlight(options.config, out, overrides, profiles) as flight:
        if start == "cold":
            flight.set_faults(**faults)
        flight.start_daemons()
        if start != "cold":
            time.sleep(MEETING_S)
        if start == "warm":
            flight.set_faults(**faults)
        begin_s = time.time()
        flight.fly(options.duration)
        end_s = time.time()
        report = flight.report()
        frames, lost, size = flight.set_faults()
    config = load_config(options.config, overrides)
    pairs = [(other, agent_id) for agent_id in config.ids for other in config.neighbours(agent_id)]
    found = delivery(out, pairs, begin_s, end_s)
    fleet = report["fleet"]
    return {
        "delivery": found.mean,
        "least_of_a_pair": min(found.share.values()),
        "dead_pairs": found.dead,
        "last_pair_heard_s": max(found.first_s.values()),
        "age_p50_s": found.age_s(50),
        "age_p99_s": found.age_s(99),
        "on_time": fleet["ticks_on_time_fraction"],
        "rmse_m": fleet["position_rmse_m"],
        "rmse_after_10s_m": fleet["position_rmse_after_10s_m"],
        "norm_full_rms_after_10s": fleet["norm_full_rms_after_10s"],
        "anees_after_10s": fleet["anees_after_10s"],
        "frames_lost": lost / frames if frames else 0.0,
        "segment_bytes": size,
    }


def shown(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
