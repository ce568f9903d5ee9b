"""The configuration reference is that of the code."""

from __future__ import annotations

from pathlib import Path

import msgspec

from agent.config.retired import RETIRED
from agent.config.tables import FleetConfig
from fleetloc.config_reference import reference

PAGE = Path(__file__).parents[3] / "docs" / "configuration.md"


def test_the_page_is_what_the_code_says() -> None:
    assert PAGE.read_text(encoding="utf-8") == reference(), "the configuration's tables have changed: make docs"


def test_every_table_and_every_key_of_it_is_there() -> None:
    page = reference()
    own = [field.name for field in msgspec.structs.fields(FleetConfig) if field.name != "others"]
    for name in (*own, "sim", "sitl", "monitor"):
        assert f"[{name}]" in page
    for key in ("period_s", "gps_speed_half_width_mps", "center_m", "lat_deg", "neighbour_timeout_s"):
        assert f"| `{key}` |" in page
    assert '`[[sim.paths]]`, kind = "circle"' in page
    for key in RETIRED:
        assert f"| `{key}` |" in page


def test_every_key_says_what_it_means() -> None:
    rows = [line.split(" | ") for line in reference().splitlines() if line.startswith("| `")]
    assert len(rows) > 100
    assert [row[0] for row in rows if not row[-1].strip(" |")] == []
