"""Lines of the keys of a TOML file."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from agent.config.toml_lines import KeyPath, key_lines

CONFIGS = Path(__file__).parents[3] / "configs"
LITERAL = "'''"

TRICKY = f"""# comment with [table] and key = 1
top = 1
"quoted.key" = "a # no comment, a ] and a }}"

[fleet] # [not.this]
origin = {{ lat_deg = 1.0, "lon_deg" = 2.0 }}
edges = [
    [1, 2],  # [3, 4]
    [2, 3],
]
raw = {LITERAL}
[fake]
key = "
{LITERAL}
dotted.inner . deep = true

[[agents]]
id = 1
[[agents]]
id = 2
  [agents.more]
  of = "it \\" ]"
[[agents.paths]]
lap_s = 1
[[agents.paths]]
lap_s = 2
[[agents]]
id = 3
[[agents.paths]]
lap_s = 3
"""

EXPECTED: dict[KeyPath, int] = {
    ("top",): 2,
    ("quoted.key",): 3,
    ("fleet",): 5,
    ("fleet", "origin", "lon_deg"): 6,
    ("fleet", "edges"): 7,
    ("fleet", "edges", 0): 8,
    ("fleet", "edges", 1, 1): 9,
    ("fleet", "raw"): 11,
    ("fleet", "dotted", "inner", "deep"): 15,
    ("agents",): 17,
    ("agents", 1): 19,
    ("agents", 1, "id"): 20,
    ("agents", 1, "more", "of"): 22,
    ("agents", 1, "paths", 1, "lap_s"): 26,
    ("agents", 2, "paths", 0, "lap_s"): 30,
}


def paths_in(value: Any, path: KeyPath = ()) -> Iterator[KeyPath]:
    """All keys, indices and tables of a document."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for step, each in inner:
        yield (*path, step)
        yield from paths_in(each, (*path, step))


def test_keys_are_found_among_strings_comments_and_brackets() -> None:
    lines = key_lines(TRICKY)
    assert {path: lines[path] for path in EXPECTED} == EXPECTED


@pytest.mark.parametrize("text", [TRICKY, *(path.read_text() for path in sorted(CONFIGS.rglob("*.toml")))])
def test_everything_that_tomllib_reads_has_a_line_and_nothing_else(text: str) -> None:
    assert set(key_lines(text)) == set(paths_in(tomllib.loads(text)))


@pytest.mark.parametrize("path", sorted(CONFIGS.rglob("*.toml")), ids=lambda path: path.stem)
def test_the_line_of_a_key_holds_it(path: Path) -> None:
    lines = path.read_text().splitlines()
    misplaced = [keys for keys, line in key_lines(path.read_text()).items() if str(keys[-1]) not in lines[line - 1]]
    assert not [keys for keys in misplaced if isinstance(keys[-1], str)]


def test_windows_line_ends_count_once() -> None:
    assert key_lines("a = 1\r\n\r\n[b]\r\nc = [\r\n1,\r\n]\r\n")["b", "c", 0] == 5
