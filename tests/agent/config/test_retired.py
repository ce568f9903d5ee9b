"""Former keys: refused in a fleet's file with what took their place, understood in an old flight log."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from agent.config.reading import dump, load_config, load_document, recorded_config
from agent.config.retired import RETIRED
from agent.errors import ConfigError
from fleetloc.whole_config import load_whole, read_whole, whole
from sim_bridge.sitl.sitl_table import SITL
from sim_bridge.world.sim_table import SIM

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"


def with_former_keys(**other: object) -> str:
    """The effective configuration of a fleet as it was once written: with all former keys."""
    tables = tomllib.loads(dump(load_config(LINE3)))
    for key, retired in RETIRED.items():
        *path, name = key.split(".")
        inside = tables
        for step in path:
            inside = inside.setdefault(step, {})
        inside[name] = other.get(name, retired.value)
    lines = []
    for name, table in tables.items():
        for entry in table if isinstance(table, list) else (table,):
            lines.append(f"[{name}]" if entry is table else f"[[{name}]]")
            lines += [f"{key} = {toml(value)}" for key, value in entry.items()]
    return "\n".join(lines)


def toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return str(value).lower() if isinstance(value, bool) else repr(value)


def test_a_former_key_is_refused_with_what_took_its_place(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text(LINE3.read_text().replace("[sensors]\n", "[sensors]\ngps_uere_m = 2.5\n"))
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    line = 1 + path.read_text().splitlines().index("gps_uere_m = 2.5")
    assert str(caught.value) == (
        f"{path}:{line}: sensors.gps_uere_m: no longer a key: it is 2.5 m; remove the line"
    )


def test_a_former_key_of_another_room_is_refused_where_that_is_read() -> None:
    config = load_config(LINE3, ["sim.start_speed_half_width_mps=2", "sitl.truth_hz=50"])
    with pytest.raises(ConfigError, match=r"--set: sim.start_speed_half_width_mps: no longer a key: it is 2 m/s"):
        SIM.of(config)
    with pytest.raises(ConfigError, match=r"--set: sitl.truth_hz: no longer a key: it is 50 Hz"):
        SITL.of(config)


@pytest.mark.parametrize("key", RETIRED)
def test_no_former_key_is_a_key(key: str) -> None:
    _, errors = read_whole(load_document(LINE3, [f"{key}=1"]))
    assert [(error.key, "no longer a key" in error.says) for error in errors] == [(key, True)]


def test_an_old_log_that_has_them_with_the_constants_values_is_read() -> None:
    config = recorded_config(with_former_keys(), "log", "fleetloc 0.1.0")
    assert whole(config) == load_whole(LINE3)


def test_an_old_log_that_had_another_value_names_the_version_that_it_needs() -> None:
    with pytest.raises(ConfigError) as caught:
        recorded_config(with_former_keys(gps_uere_m=4.0), "log", "fleetloc 0.1.0, numpy 2.0")
    assert str(caught.value) == (
        "log: sensors.gps_uere_m: 4.0 was set, and it is no longer a key: it is 2.5 m; "
        "replay it with the version that it was flown with (fleetloc 0.1.0, numpy 2.0)"
    )
