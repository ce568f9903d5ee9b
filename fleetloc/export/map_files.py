"""Tracks on a map: KML for Google Earth and ground stations, GeoJSON for everything else.

Heights of KML are above mean sea level and those of GeoJSON above the WGS84 ellipsoid. Where the fleet's are of the
other sort and ``sensors.geoid_separation_m`` is not known, KML lays tracks on the ground and GeoJSON has no heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import msgspec

from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Triple

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442")
"""Okabe and Ito's, by drone in turn."""
DIGITS = 8
"""Of degrees: a millimetre."""


@dataclass(frozen=True, slots=True)
class MapTrack:
    """Where a drone was, in the eyes of ``kind`` ("estimate", "gps", "truth"): Unix times in s, places in NED m."""

    agent_id: int
    kind: str
    points: Sequence[tuple[float, Triple]]

    @property
    def name(self) -> str:
        """For people."""
        return f"drone {self.agent_id}, {self.kind}"


def write_kml(path: Path, name: str, tracks: Sequence[MapTrack], frame: FleetFrame) -> None:
    """A file of tracks with times; raises `OSError`."""
    lifted = _lift_to_sea_level(frame)
    styles = "".join(
        f'<Style id="c{number}"><LineStyle><color>{_kml_colour(colour)}</color><width>2</width></LineStyle></Style>\n'
        for number, colour in enumerate(COLOURS)
    )
    places = "".join(_placemark(track, frame, lifted) for track in tracks if track.points)
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2">\n<Document>\n'
        f"<name>{escape(name)}</name>\n{styles}{places}</Document>\n</kml>\n",
        encoding="utf-8",
    )


def write_geojson(path: Path, tracks: Sequence[MapTrack], frame: FleetFrame) -> None:
    """A FeatureCollection of lines; ``times`` (UTC) are of their points. Raises `OSError`."""
    lift_m = _lift_to_ellipsoid(frame)
    features = []
    for track in tracks:
        if len(track.points) < 2:  # a line has two points
            continue
        coordinates = []
        for _, place_m in track.points:
            lat_deg, lon_deg, height_m = frame.geodetic(place_m)
            height = [] if lift_m is None else [round(height_m + lift_m, 3)]
            coordinates.append([round(lon_deg, DIGITS), round(lat_deg, DIGITS), *height])
        properties = {
            "name": track.name,
            "agent": track.agent_id,
            "kind": track.kind,
            "stroke": _colour(track),
            "times": [_utc(unix_s) for unix_s, _ in track.points],
        }
        geometry = {"type": "LineString", "coordinates": coordinates}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    collection: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    path.write_bytes(msgspec.json.format(msgspec.json.encode(collection), indent=1) + b"\n")


def _placemark(track: MapTrack, frame: FleetFrame, lift_m: float | None) -> str:
    mode = "clampToGround" if lift_m is None else "absolute"
    whens, coordinates = [], []
    for unix_s, place_m in track.points:
        lat_deg, lon_deg, height_m = frame.geodetic(place_m)
        whens.append(f"<when>{_utc(unix_s)}</when>")
        coordinates.append(
            f"<gx:coord>{lon_deg:.{DIGITS}f} {lat_deg:.{DIGITS}f} {height_m + (lift_m or 0.0):.3f}</gx:coord>"
        )
    lines = "\n".join((*whens, *coordinates))
    return (
        f"<Placemark><name>{escape(track.name)}</name><styleUrl>#c{_number(track)}</styleUrl>\n"
        f"<gx:Track><altitudeMode>{mode}</altitudeMode>\n{lines}\n</gx:Track></Placemark>\n"
    )


def _number(track: MapTrack) -> int:
    return (track.agent_id - 1) % len(COLOURS)


def _colour(track: MapTrack) -> str:
    return COLOURS[_number(track)]


def _kml_colour(colour: str) -> str:
    """Opaque, blue first."""
    return f"ff{colour[5:7]}{colour[3:5]}{colour[1:3]}"


def _utc(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _lift_to_sea_level(frame: FleetFrame) -> float | None:
    """What makes the fleet's heights those above mean sea level; ``None`` where that is not known."""
    if frame.msl:
        return 0.0
    return None if frame.geoid_separation_m is None else -frame.geoid_separation_m


def _lift_to_ellipsoid(frame: FleetFrame) -> float | None:
    """Likewise above the ellipsoid."""
    return frame.geoid_separation_m if frame.msl else 0.0
