"""All files for other tools of one flight: ``estimates.mcap`` with its layout, and the tracks for maps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from agent.config.tables import FleetConfig
from agent.outputs import EstimateReady
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Triple
from estimators.model.layout import STATES_PER_AGENT
from fleetloc.export.foxglove_layout import write_layout
from fleetloc.export.map_files import MapTrack, write_geojson, write_kml
from fleetloc.export.plot_mcap import PlotMcap
from fleetloc.run.run_files import GEOJSON, KML, LAYOUT, MCAP

EVERY_S = 0.5
"""Points of a track are so far apart: maps show no more."""


class PlotFiles:
    """Takes what was estimated and measured, in order of time, and writes the files by its end; times are fleet time.

    ``start_s`` is the zero of the times that people see. Raises `LogFileError` and `OSError` where the disk refuses.
    """

    def __init__(self, directory: Path, config: FleetConfig, agents: Sequence[int], start_s: float) -> None:
        self._directory, self._config, self._agents = directory, config, tuple(agents)
        self._epoch_unix_s = config.fleet.epoch_unix_s
        self._mcap = PlotMcap(directory / MCAP, config, start_s)
        self._points: dict[tuple[int, str], list[tuple[float, Triple]]] = {}
        self._pairs: set[tuple[int, int]] = set()

    def estimate(self, agent_id: int, ready: EstimateReady, published_s: float) -> None:
        """What an agent that has located itself estimated."""
        self._mcap.write(agent_id, ready, published_s)
        at = STATES_PER_AGENT * self._config.bodies.index(agent_id)
        north, east, down = ready.estimate.mean[at : at + 3].tolist()
        self._note(agent_id, "estimate", ready.t_s, (north, east, down))

    def fix(self, agent_id: int, t_s: float, position_m: Triple, arrived_s: float) -> None:
        """A fix of its receiver."""
        self._mcap.write_fix(agent_id, t_s, position_m, arrived_s)
        self._note(agent_id, "gps", t_s, position_m)

    def range(self, observer: int, target: int, t_s: float, range_m: float, sigma_m: float | None) -> None:
        """A range that it measured."""
        self._mcap.write_range(observer, target, t_s, range_m, sigma_m)
        self._pairs.add((observer, target))

    def truth(self, agent_id: int, points: Iterable[tuple[float, Triple]]) -> None:
        """Where it truly was."""
        for t_s, place_m in points:
            self._note(agent_id, "truth", t_s, place_m)

    def close(self) -> None:
        """Write what is made of the whole flight, and close everything."""
        self._mcap.close()
        frame, name = FleetFrame.of(self._config), self._config.fleet.name
        tracks = [MapTrack(agent_id, kind, points) for (agent_id, kind), points in self._sorted()]
        write_kml(self._directory / KML, name, tracks, frame)
        write_geojson(self._directory / GEOJSON, tracks, frame)
        write_layout(self._directory / LAYOUT, self._agents, sorted(self._pairs))

    def _sorted(self) -> list[tuple[tuple[int, str], list[tuple[float, Triple]]]]:
        return sorted(self._points.items(), key=lambda each: (each[0][0], each[0][1]))

    def _note(self, agent_id: int, kind: str, t_s: float, place_m: Triple) -> None:
        """Keep a point if it is not too near in time to the last one: a flight of hours fits into memory."""
        points = self._points.setdefault((agent_id, kind), [])
        unix_s = self._epoch_unix_s + t_s
        if math.isfinite(sum(place_m)) and (not points or unix_s - points[-1][0] >= EVERY_S - 1e-6):
            points.append((unix_s, place_m))
