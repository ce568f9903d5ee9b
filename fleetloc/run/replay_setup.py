"""From the command line of a replay to what the engine runs on."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from agent.config.documents import Document, Override, read_document
from agent.config.reading import config_of
from agent.config.tables import FleetConfig, SensorsTable
from agent.errors import ConfigError
from agent.log.estimate_mcap import SUFFIX as RECORD_SUFFIX
from agent.sensing.frames import FleetFrame
from fleetloc.errors import InputError
from sim_bridge.replay.feed import Inputs
from sim_bridge.replay.injection import Injection, parsed_faults
from sim_bridge.replay.logs.events import LogError, LogSource, TruthSample
from sim_bridge.replay.logs.frames import frame_about, origin_of
from sim_bridge.replay.logs.opening import open_log
from sim_bridge.replay.logs.surveyed import OwnWords
from sim_bridge.replay.naming import names_apart
from sim_bridge.replay.plan import PlannedVehicle, ReplayPlan, make_plan
from sim_bridge.replay.reading import surveyed
from sim_bridge.replay.side_files.range_files import UNIX_FROM_S, RangeCounts, RangeLine, read_ranges
from sim_bridge.replay.side_files.recorded_ranges import ranges_of_record
from sim_bridge.replay.side_files.truth_files import TruthFile
from sim_bridge.replay.synthesis import Synthesiser, SyntheticNoise
from sim_bridge.replay.what_if import GpsDrop, GpsDrops, ReplaySpan

SYNTHETIC = "synthetic"
LOGGED, STAMPED = "logged", "stamped"
AUTO = "auto"
NO_PLACE = "none: no log tells a place"
"""Where the origin is from, if it is from nowhere."""
TRUTH_SUFFIXES = (".csv", ".csv.gz")


def split_truth(logs: Sequence[Path], truth: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Logs and files of truth apart: of ``--truth A B C`` the parser gives the option A, and B and C to the logs."""
    if not truth or AUTO in truth:
        return list(logs), [AUTO]
    files = [path for path in logs if path.name.endswith(TRUTH_SUFFIXES)]
    return [path for path in logs if path not in files], [*truth, *map(str, files)]


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line says, unchecked."""

    config: Path
    logs: Sequence[Path]
    settings: Sequence[Override] = ()
    """Overrides of the configuration, those of options included."""
    ranges: Sequence[str] = ()
    """Files, or one word: synthetic, with its settings."""
    truth: Sequence[str] = (AUTO,)
    drops: Sequence[str] = ()
    faults: Sequence[str] = ()
    seed: int = 1
    from_s: float | None = None
    to_s: float | None = None
    arrival: str = LOGGED


@dataclass(frozen=True, slots=True)
class Prepared:
    """A replay that can run; the counts of its inputs fill up while it does. Times are fleet time."""

    config: FleetConfig
    inputs: Inputs
    sources: tuple[LogSource, ...]
    seed: int
    origin_from: str
    truth_from: str
    ranges_from: str
    truth_files: dict[int, TruthFile]

    @property
    def synthetic(self) -> bool:
        """Whether ranges are made of the truth."""
        return self.inputs.synthesiser is not None


def prepare(options: Options) -> Prepared:
    """Open everything, check that it fits together.

    Raises `ConfigError`, `LogError`, `ReplayError`, `InputError` or `OSError` with one line that says what does not.
    """
    if options.arrival not in (LOGGED, STAMPED):
        raise InputError("--arrival", "", f"{LOGGED} or {STAMPED}", options.arrival)
    config, sources, origin_from = _config_and_logs(options)
    files = _truth_files(options.truth, FleetFrame.of(config), sources)
    plan = make_plan(config, sources, _better_clocks(sources, files))
    config = _with_epoch(config, plan)
    from_s, to_s = _part(options, plan)
    flown = tuple(vehicle.agent_id for vehicle in plan.vehicles)
    asked = [GpsDrop.parsed(text) for text in options.drops]
    drops = GpsDrops(asked, flown, *plan.span_s, (from_s, to_s))
    part_s = from_s - plan.zero_s, to_s - plan.zero_s
    injection = Injection(parsed_faults(options.faults, config, flown, part_s), options.seed, plan.zero_s)
    truth = {v.agent_id: _fleet_timed(v, files[_key(v)], plan) for v in plan.vehicles} if files else None
    counts = RangeCounts()
    ranges, ranges_from = _ranges(options, config, plan, counts)
    truth_files = {v.agent_id: files[_key(v)] for v in plan.vehicles} if files else {}
    return Prepared(
        config=config,
        inputs=Inputs(
            plan,
            drops,
            from_s,
            to_s,
            truth,
            ranges,
            at_stamps=options.arrival == STAMPED,
            range_counts=counts,
            truth_skipped={agent_id: file.skipped for agent_id, file in truth_files.items()},
            injection=injection,
        ),
        sources=tuple(sources),
        seed=options.seed,
        origin_from=origin_from,
        truth_from=_truth_words(plan, files),
        ranges_from=ranges_from,
        truth_files=truth_files,
    )


def _part(options: Options, plan: ReplayPlan) -> tuple[float, float]:
    """The fleet times between which is replayed; raises `InputError` if nothing is left."""
    if plan.overlap_s is None and (options.from_s is not None or options.to_s is not None):
        names = names_apart(vehicle.source.path for vehicle in plan.vehicles)
        earliest = min(plan.vehicles, key=lambda each: each.last_s)
        latest = max(plan.vehicles, key=lambda each: each.first_s)
        apart = f"{names[earliest.source.path]} ends {latest.first_s - earliest.last_s:.1f} s before"
        raise InputError("--from/--to", "", "logs that overlap", f"{apart} {names[latest.source.path]} begins")
    from_s, to_s = ReplaySpan(options.from_s, options.to_s).resolved(*plan.span_s)
    begin_s, end_s = max(from_s, plan.start_s), min(to_s, plan.end_s)
    if not begin_s < end_s:
        first_s, last_s, common_s = (each - plan.zero_s for each in (plan.start_s, plan.end_s, plan.span_s[1]))
        whole = f"{round(first_s, 1) + 0.0:.1f} to {last_s:.1f} s"
        expected = f"a part of {whole} (0 to {common_s:.1f} s are in all logs)"
        asked = [f"{each - plan.zero_s:.1f} s" if math.isfinite(each) else "its end" for each in (from_s, to_s)]
        raise InputError("--from/--to", "", expected, f"{asked[0].replace('its end', 'the begin')} to {asked[1]}")
    return begin_s, end_s


# --- configuration and logs ----------------------------------------------------------------------------------


def _config_and_logs(options: Options) -> tuple[FleetConfig, list[LogSource], str]:
    """The configuration, completed by the origin of the logs where it names none, and the opened logs."""
    document = read_document(options.config)
    document = document.overridden(options.settings)
    fleet = document.tables.get("fleet")
    if not isinstance(fleet, dict) or "origin" in fleet:
        config, origin_from = config_of(document), "configuration"
    else:
        # the sensors' settings decide what counts as a first fix: a look at the file with any origin comes first
        anywhere = {"lat_deg": 0.0, "lon_deg": 0.0, "alt_m": 0.0}
        sensors = config_of(document.with_table("fleet", {**fleet, "origin": anywhere})).sensors
        config, origin_from = _with_origin_of_logs(document, options.logs, sensors)
    frame = FleetFrame.of(config)
    ours = OwnWords(config.mavlink.component_id, config.feedback.kind == "odometry")
    sources = surveyed([open_log(path, frame=frame, sensors=config.sensors, ours=ours) for path in options.logs])
    return config, sources, origin_from


def _with_origin_of_logs(document: Document, logs: Sequence[Path], sensors: SensorsTable) -> tuple[FleetConfig, str]:
    """The configuration with the origin of the first log that tells a place, and how the report names that.

    Raises `LogError` if it is one that no configuration can have.
    """
    for path in logs:
        source = open_log(path, frame=None, sensors=sensors)
        if origin_of(source.survey().systems.values()) is not None:
            frame, origin_from = source.frame, f"log {path.name}"
            break
    else:
        path, frame, origin_from = logs[0], frame_about(()), NO_PLACE
    origin = {"lat_deg": frame.lat_deg, "lon_deg": frame.lon_deg, "alt_m": frame.alt_m}
    try:
        return config_of(document.with_table("fleet", {**document.tables["fleet"], "origin": origin})), origin_from
    except ConfigError as error:
        if not error.key.startswith("fleet.origin"):
            raise
        raise LogError(path, f"a place to begin at with {error.key}: {error.expected}", error.found) from None


def _with_epoch(config: FleetConfig, plan: ReplayPlan) -> FleetConfig:
    """Fleet time as the plan has it: ticks of the configured epoch would be too large for old logs, or negative."""
    replaced = msgspec.structs.replace
    return replaced(config, fleet=replaced(config.fleet, epoch_unix_s=plan.epoch_unix_s or 0.0))


# --- truth ---------------------------------------------------------------------------------------------------

Key = tuple[Path, int]
"""A vehicle: its log and system id."""


def _key(vehicle: PlannedVehicle) -> Key:
    return vehicle.source.path, vehicle.survey.system_id


def _truth_files(truth: Sequence[str], frame: FleetFrame, sources: Sequence[LogSource]) -> dict[Key, TruthFile]:
    """The files by vehicle, in the order in which the logs were given; none if truth is what the logs hold."""
    if list(truth) == [AUTO]:
        return {}
    vehicles = [(source.path, system_id) for source in sources for system_id in sorted(source.survey().systems)]
    if len(truth) != len(vehicles):
        raise InputError("--truth", "", f"{AUTO}, or a file for each of {len(vehicles)} vehicle(s)", f"{len(truth)}")
    return {key: TruthFile(Path(path), frame) for key, path in zip(vehicles, truth, strict=True)}


def _better_clocks(sources: Sequence[LogSource], files: dict[Key, TruthFile]) -> dict[int, float]:
    """Unix time at boot from the truth files, for logs that run on the autopilot's clock."""
    zeros: dict[int, float] = {}
    for k, source in enumerate(sources):
        for (path, _), file in files.items():
            if source.format != "tlog" and path == source.path:
                zero_s = file.unix_of_boot_s()
                if zero_s is not None:
                    zeros[k] = zero_s
    return zeros


def _fleet_timed(vehicle: PlannedVehicle, file: TruthFile, plan: ReplayPlan) -> Iterator[TruthSample]:
    """The states of a file on fleet time."""
    boot = vehicle.source.format != "tlog" and file.has_boot_clock()
    if not boot and plan.epoch_unix_s is None:
        raise InputError(str(file.path), "", "truth with time_boot_s, as no log knows the time", "Unix time only")
    shift_s = vehicle.shift_s if boot else -(plan.epoch_unix_s or 0.0)
    for sample in file.samples("boot" if boot else "unix"):
        yield replace(sample, t_s=sample.t_s + shift_s)


def _truth_words(plan: ReplayPlan, files: dict[Key, TruthFile]) -> str:
    if files:
        names = names_apart(file.path for file in files.values())
        return "files " + ", ".join(names[files[_key(vehicle)].path] for vehicle in plan.vehicles)
    names = names_apart(vehicle.source.path for vehicle in plan.vehicles)
    held = [f"{v.survey.truth_from} in {names[v.source.path]}" for v in plan.vehicles if v.survey.truth_from]
    return "; ".join(held) or "none"


# --- ranges --------------------------------------------------------------------------------------------------


def _ranges(
    options: Options, config: FleetConfig, plan: ReplayPlan, counts: RangeCounts
) -> tuple[Iterator[RangeLine] | Synthesiser | None, str]:
    """What gives the ranges, and how the report names it."""
    if not options.ranges:
        return None, "none"
    name, _, model = options.ranges[0].partition(":")
    if name == SYNTHETIC:
        if len(options.ranges) > 1:
            raise InputError("--ranges", "", f"files, or {SYNTHETIC} alone", ", ".join(options.ranges))
        noise = SyntheticNoise.parsed(model)
        flown = {vehicle.agent_id for vehicle in plan.vehicles}
        neighbours = {a: tuple(b for b in config.neighbours(a) if b in flown) for a in config.ids if a in flown}
        made_of = f"synthetic ranges: {noise.described()}, seed {options.seed}"
        arms_m = {agent.id: agent.uwb_tags_m[0] for agent in config.agents if agent.uwb_tags_m}
        return Synthesiser(neighbours, noise, options.seed, arms_m), made_of
    paths = [Path(text) for text in options.ranges]
    streams = []
    for path in paths:
        first = next(_read(path, RangeCounts()), None)
        if first is None:
            raise InputError(str(path), "", "ranges", "none that can be used")
        if first.time_s >= UNIX_FROM_S and plan.epoch_unix_s is None:
            expected = "seconds from the start, as no log knows the time"
            raise InputError(str(path), "time", expected, f"{first.time_s:.3f}")
        streams.append(_fleet_timed_ranges(_read(path, counts), plan))
    merged = heapq.merge(*streams, key=lambda line: line.time_s)
    return merged, f"file {', '.join(path.name for path in paths)}"


def _read(path: Path, counts: RangeCounts) -> Iterator[RangeLine]:
    return ranges_of_record(path, counts) if path.suffix == RECORD_SUFFIX else read_ranges(path, counts)


def _fleet_timed_ranges(lines: Iterator[RangeLine], plan: ReplayPlan) -> Iterator[RangeLine]:
    """Ranges on fleet time; small times count from the start of the logs."""
    for line in lines:
        shift_s = -(plan.epoch_unix_s or 0.0) if line.time_s >= UNIX_FROM_S else plan.start_s
        yield replace(line, time_s=line.time_s + shift_s)
