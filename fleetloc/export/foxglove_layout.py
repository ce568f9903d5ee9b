"""A layout for Foxglove that shows the file of `fleetloc.export.plot_mcap`: import it, then open the file.

3D panel and map, how sure each drone is of itself, positions, ranges, and how old the news of the others is.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from agent.log.estimate_mcap import POSES_FRAME, agent_key
from fleetloc.export.map_files import COLOURS


def foxglove_layout(agents: Sequence[int], pairs: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """The layout of a fleet; ``pairs`` are those between whom there are ranges, observer first."""
    own = [(agent_key(each), each) for each in agents]
    colours = {each: COLOURS[number % len(COLOURS)] for number, each in enumerate(agents)}
    axes = ("n", "e", "d")
    panels: dict[str, Any] = {
        "3D!fleet": {
            "followTf": POSES_FRAME,
            "scene": {},
            "layers": {"grid": {"layerId": "foxglove.Grid", "visible": True, "frameId": POSES_FRAME, "size": 100,
                                "divisions": 10}},
            "topics": {f"/{key}/poses": {"visible": True, "type": "axis", "axisScale": 2} for key, _ in own},
        },
        "map!fleet": {
            "layer": "map",
            "zoomLevel": 18,
            "disabledTopics": [],
            "topicColors": {f"/{key}/{name}": colours[each] for key, each in own for name in ("location", "gps")},
        },
        "Plot!sigma": _plot("sigma of the own position, m", [
            (f"/{key}/table.sigma_{axis}_m_{each}", colours[each]) for key, each in own for axis in axes
        ]),
        "Plot!position": _plot("own position, NED, m", [
            (f"/{key}/table.{axis}_m_{each}", colours[each]) for key, each in own for axis in axes
        ]),
        "Plot!ranges": _plot("ranges, m", [
            (f"/{agent_key(one)}/range/{agent_key(other)}.range_m", colours.get(one, COLOURS[0]))
            for one, other in pairs
        ]),
        "Plot!ages": _plot("age of the news of others, ticks", [
            (f"/{key}/table.age_ticks_{other}", colours.get(other, COLOURS[0]))
            for key, each in own for other in agents if other != each
        ]),
    }  # fmt: skip
    curves = {
        "direction": "column",
        "first": {"direction": "column", "first": "Plot!position", "second": "Plot!sigma"},
        "second": {"direction": "column", "first": "Plot!ranges", "second": "Plot!ages"},
    }
    places = {"direction": "column", "first": "3D!fleet", "second": "map!fleet"}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": places, "second": curves, "splitPercentage": 45},
    }


def write_layout(path: Path, agents: Sequence[int], pairs: Sequence[tuple[int, int]]) -> None:
    """Write it; raises `OSError`."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(foxglove_layout(agents, pairs)), indent=1) + b"\n")


def _plot(title: str, curves: Sequence[tuple[str, str]]) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "paths": [
            {"value": path, "color": colour, "enabled": True, "timestampMethod": "receiveTime"}
            for path, colour in curves
        ],
        "showLegend": True,
        "legendDisplay": "floating",
        "isSynced": True,
        "xAxisVal": "timestamp",
    }
