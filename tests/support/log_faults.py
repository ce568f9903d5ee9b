"""Logs with faults through the agents: what `fleetloc replay` reports of them, without its plots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from agent.config.documents import Override
from agent.config.tables import FleetConfig
from agent.mavlink.session import AutopilotSession
from agent.sensing.samples import Sample
from agent.watch.diagnostics import counters_of
from fleetloc.report.fleet_report import counted_sensors
from fleetloc.report.replay_figures import load_results, report_figures
from fleetloc.run import replay_run
from fleetloc.run.replay_setup import Options, prepare
from sim_bridge.replay.logs.files import opened
from sim_bridge.replay.logs.telemetry.frames import STAMP_BYTES, is_frame
from tests.support.onboard import onboard_of

FAULTY = Path(__file__).parents[1] / "data" / "log_faults"
CONFIGS = Path(__file__).parents[2] / "configs"


def replayed(
    folder: Path,
    *names: str,
    config: Path = CONFIGS / "single.toml",
    ranges: str | None = None,
    settings: Sequence[Override] = (),
    arrival: str = "logged",
) -> dict[str, Any]:
    """The figures of a replay of some of the logs."""
    logs = [FAULTY / f"{name}.gz" for name in names]
    files = () if ranges is None else (str(FAULTY / ranges),)
    prepared = prepare(Options(config, logs, ranges=files, settings=settings, arrival=arrival))
    replay_run.clear(folder)
    run = replay_run.run_replay(prepared, folder)
    return report_figures(prepared, run, load_results(prepared, folder))


def frames_of(name: str) -> Iterator[tuple[float, bytes]]:
    """Seconds from the first stamp, and frame, of a telemetry log."""
    with opened(FAULTY / f"{name}.gz", Counter()) as file:
        data = file.read(1 << 24)
    at, first_us = 0, int.from_bytes(data[:STAMP_BYTES], "big")
    while at < len(data):
        begin = at + STAMP_BYTES
        end = begin + is_frame(data, begin)
        assert end > begin
        yield (int.from_bytes(data[at:begin], "big") - first_us) * 1e-6, data[begin:end]
        at = end


def counted(config: FleetConfig, name: str, from_s: float = 100.0) -> dict[str, dict[str, Any]]:
    """What a daemon that gets the frames of a telemetry log counts of its sensors."""
    onboard = onboard_of(config, linked=True)
    for t_s, frame in frames_of(name):
        onboard.on_mavlink(frame, from_s + t_s)
        onboard.advance(from_s + t_s)
    return counted_sensors(Counter(counters_of(onboard)))


def flown(config: FleetConfig, name: str, from_s: float = 100.0) -> tuple[AutopilotSession, list[Sample]]:
    """A daemon's session with the autopilot of a telemetry log, and its samples."""
    session = onboard_of(config, linked=True).autopilot
    samples: list[Sample] = []
    for t_s, frame in frames_of(name):
        samples += session.receive(frame, from_s + t_s)
        session.to_send(from_s + t_s, None)
    return session, samples
