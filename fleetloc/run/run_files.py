"""The files of a run in its folder: who writes which, and how several records of one agent are told apart.

=============================  ====================================================================
``fleet.toml``                 the effective configuration; every process of the run reads this one
``truth.npz``                  where every drone truly was (`sim_bridge.world.truth`)
``agent_001.estimates``        the last estimate log of agent 1 (`agent.log.estimate_log`)
``agent_001.1.estimates``      the one before it, if the daemon was restarted; ``.2`` the next, ...
``agent_001.mcap``, ``.tlog``  the flight log of its last daemon (`agent.log.flight_log`), likewise
``agent_001.json``             counters of its last daemon, likewise
``agent_001.log``              what the daemon said on stderr
``uwb_001.log``                what the driver of its UWB module said, where a module is simulated
``simulator.log``              what the simulator said
``simulator.json``             how its run went (`sim_bridge.world.simulator.SimulatorReport`)
``report.json``                figures
``report.html``                the same for people, with plots
``estimates.mcap``, ...        files for other tools, where they were asked for (`fleetloc.export`)
=============================  ====================================================================
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.errors import LogFileError
from agent.log.estimate_log import SUFFIX, read_entries
from fleetloc.errors import InputError

CONFIG, TRUTH, REPORT_JSON, REPORT_HTML = "fleet.toml", "truth.npz", "report.json", "report.html"
SIMULATOR_LOG, SIMULATOR_JSON = "simulator.log", "simulator.json"
MCAP, KML, GEOJSON, LAYOUT = "estimates.mcap", "tracks.kml", "tracks.geojson", "foxglove-layout.json"
EXPORTED = (MCAP, KML, GEOJSON, LAYOUT)
SUMMARY_SUFFIX = ".json"
BESIDE_SUFFIXES = (SUMMARY_SUFFIX, ".tlog", ".mcap")
"""What goes with a record and keeps its number."""
_OF_A_RUN = re.compile(r"agent_[0-9]{3}(\.[0-9]+)?\.(estimates|json|log|tlog|mcap)|uwb_[0-9]{3}\.log")


def record_path(directory: Path, agent_id: int) -> Path:
    """The record that a daemon writes."""
    return directory / f"agent_{agent_id:03d}{SUFFIX}"


def log_path(directory: Path, agent_id: int) -> Path:
    """What a daemon says on stderr."""
    return directory / f"agent_{agent_id:03d}.log"


def uwb_log_path(directory: Path, agent_id: int) -> Path:
    """What the driver of an agent's UWB module says on stderr."""
    return directory / f"uwb_{agent_id:03d}.log"


def keep_earlier_record(directory: Path, agent_id: int) -> None:
    """Rename what an earlier daemon of this agent left, so that a restart does not overwrite it.

    Raises `OSError` if the folder refuses.
    """
    record = record_path(directory, agent_id)
    if not record.exists():
        return
    number = next(n for n in itertools.count(1) if not _numbered(record, n).exists())
    record.rename(_numbered(record, number))
    for beside in (record.with_suffix(suffix) for suffix in BESIDE_SUFFIXES):
        if beside.exists():
            beside.rename(_numbered(beside, number))


def records(directory: Path, agent_id: int) -> list[Path]:
    """All records of an agent, the earliest first."""
    last = record_path(directory, agent_id)
    earlier = itertools.takewhile(Path.exists, (_numbered(last, n) for n in itertools.count(1)))
    return [*earlier, *([last] if last.exists() else [])]


def readable_entries(directory: Path, agent_id: int) -> tuple[list[NDArray[np.void]], list[str]]:
    """The entries of an agent's records, the earliest first, and a line for each record that cannot be read."""
    paths, parts, unread = records(directory, agent_id), [], []
    if not paths:
        unread.append(f"record {record_path(directory, agent_id)}: not there")
    for path in paths:
        try:
            parts.append(read_entries(path)[1])
        except LogFileError as error:  # of a daemon that was killed in its first moment
            unread.append(str(error))
    return parts, unread


def in_folder(config: FleetConfig, base: Path, directory: Path) -> FleetConfig:
    """The configuration of a run as its folder holds it: paths absolute, so that a daemon can be restarted anywhere.

    ``base`` is the folder of the configuration file, which the key and state folders are relative to.
    """
    replace, security = msgspec.structs.replace, config.security
    absolute = {"keys": str((base / security.keys).resolve())}
    if security.state is not None:
        absolute["state"] = str((base / security.state).resolve())
    return replace(
        config,
        record=replace(config.record, directory=str(directory)),
        security=replace(security, **absolute),
    )


def refuse_inputs(directory: Path, inputs: Iterable[Path | str], also: re.Pattern[str] | None = None) -> None:
    """Refuse a folder in which `clear` would remove what the run is to read; raises `InputError`.

    ``also`` matches the names of further files that the command removes or writes there. Inputs that are no files
    are passed over.
    """
    files = [path for path in map(Path, inputs) if path.is_file()]
    for left in _left_in(directory, also):
        if any(left.samefile(path) for path in files):
            expected = "another folder: files of this name are a run's own, and are removed when one begins"
            raise InputError("--out", str(directory), expected, f"an input of this run, {left.name}")


def clear(directory: Path) -> None:
    """Make the folder, and remove what an earlier run left in it; nothing else is touched.

    Ask `refuse_inputs` before. Raises `OSError` if the folder refuses.
    """
    directory.mkdir(parents=True, exist_ok=True)
    for path in _left_in(directory):
        path.unlink()


def _left_in(directory: Path, also: re.Pattern[str] | None = None) -> Iterator[Path]:
    """The files in a folder whose names are those of a run."""
    named = {CONFIG, TRUTH, REPORT_JSON, REPORT_HTML, SIMULATOR_LOG, SIMULATOR_JSON, *EXPORTED}
    for path in directory.iterdir() if directory.is_dir() else ():
        if path.name in named or _OF_A_RUN.fullmatch(path.name) or (also and also.fullmatch(path.name)):
            yield path


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}.{number}{path.suffix}")
