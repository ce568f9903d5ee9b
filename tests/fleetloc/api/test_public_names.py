"""What ``import fleetloc`` gives is what the documentation says, and costs nothing until it is used."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import fleetloc

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
ROOMS = {"agent", "transport", "estimators", "sim_bridge"}


def test_the_page_names_what_is_public_and_nothing_else() -> None:
    table = PAGE.partition("## All names")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(fleetloc.__all__)


@pytest.mark.parametrize("name", fleetloc.__all__)
def test_every_name_is_there_and_says_what_it_is(name: str) -> None:
    value: Any = getattr(fleetloc, name)
    assert value.__doc__, name
    assert name in dir(fleetloc)


def test_other_names_are_refused_as_of_any_module() -> None:
    with pytest.raises(AttributeError, match="module 'fleetloc' has no attribute 'Radio'"):
        getattr(fleetloc, "Radio")  # noqa: B009  # mypy knows too that there is none


def test_an_import_loads_no_room_and_a_name_only_its_own() -> None:
    look = (
        "import sys, fleetloc; print(sorted(sys.modules.keys() & set(sys.argv[1:])));"
        "fleetloc.UwbRange; print(sorted(sys.modules.keys() & set(sys.argv[1:])))"
    )
    heavy = [*sorted(ROOMS), "matplotlib", "numba", "numpy", "scipy", "typer", "zenoh"]
    done = subprocess.run([sys.executable, "-c", look, *heavy], cwd=ROOT, capture_output=True, text=True, check=True)
    at_first, then = map(ast.literal_eval, done.stdout.splitlines())
    assert at_first == []
    assert set(then) <= {"transport", "numpy"}


@pytest.mark.parametrize("page", ["uwb.md", "replay.md", "python.md"])
def test_scripts_that_are_shown_use_only_what_is_public(page: str) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    imported: set[str] = set()
    for script in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(script)):
            if isinstance(node, ast.ImportFrom) and node.module == "fleetloc":
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert (node.module or "").partition(".")[0] not in {*ROOMS, "fleetloc"}, node.module
            elif isinstance(node, ast.Import):
                assert not {alias.name.partition(".")[0] for alias in node.names} & ROOMS
    assert imported
    assert imported <= set(fleetloc.__all__)
