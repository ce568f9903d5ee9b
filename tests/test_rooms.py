"""The rooms stay apart, their floors stay small, and nothing of a developer's machine gets into the sources.

Each check is a function that lists faults, and is itself tested on made-up faults.
"""

from __future__ import annotations

import ast
import re
import subprocess
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

MAY_IMPORT: dict[str, set[str]] = {
    "estimators": set(),
    "transport": set(),
    "agent": {"estimators", "transport"},
    "sim_bridge": {"estimators", "transport", "agent"},
    "fleetloc": {"estimators", "transport", "agent", "sim_bridge"},
}
"""Room -> rooms it may import besides itself; the table of docs/architecture.md."""

MOST_FILES = 16
"""Modules in one folder; one idea a file decides how long a file is."""

MACHINE_PATH = re.compile(r"""(?<![\w.$}~-])/(?:home|root|Users|work|workspace|mnt)/[\w.-]+""")
ALLOWED_PATH = {"/home/pilot"}
"""Made-up home of a test."""

RETIRED = {
    "Roll",
    "RecordRelay",
    "RecordStore",
    "RecordKind",
    "AccelerationRecord",
    "AnchorRangeRecord",
    "RangeRecord",
    "SpeedRecord",
    "VelocityRecord",
    "PositionRecord",
    "Record",
    "DoubledRecording",
    "RecordingError",
    "Recording",
    "EstimateRecorder",
    "FlightRecord",
    "RecordError",
    "RecordHeader",
    "RecordReplay",
}
"""Names of classes from when one word meant several things: a *measurement* crosses the wire, a *flight log* and an
*estimate log* are written in flight, a *study input* is read by studies, who is there is the *membership*."""

NAMED_TWICE_STILL: set[str] = set()
"""To be emptied, never to grow."""

NOT_LOCKED = {"docs"}
"""Extras that no test needs."""

TEXT_SUFFIXES = {".py", ".md", ".toml", ".yml", ".yaml", ".cfg", ".txt", ".lock", ".sh", ".json", ""}


def import_faults(name: str, source: str) -> Iterator[str]:
    """Imports of a module (dotted ``name``) that the table forbids, wherever in the file they stand."""
    room = name.partition(".")[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            imported = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            imported = [node.module or ""]
        else:
            continue
        for target in imported:
            other = target.partition(".")[0]
            if other in ("tests", "conftest"):
                yield f"{name}:{node.lineno} imports {target}, which is a test"
            elif other in MAY_IMPORT and other != room and other not in MAY_IMPORT[room]:
                yield f"{name}:{node.lineno} imports {target}; {room} may import {sorted(MAY_IMPORT[room])}"


def machine_paths(text: str) -> list[str]:
    """Absolute paths in home and work folders, which exist on one machine only."""
    return [path for path in MACHINE_PATH.findall(text) if path not in ALLOWED_PATH]


def modules() -> list[Path]:
    """The Python files of all rooms."""
    return sorted(path for room in MAY_IMPORT for path in (ROOT / room).rglob("*.py"))


def texts() -> list[Path]:
    """All text files that are, or are about to be, under version control."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode == 0:
        paths = [ROOT / line for line in listed.stdout.splitlines()]
    else:  # an unpacked archive
        made = ("build", "dist", "out", ".venv", ".git", ".hypothesis")
        paths = [path for path in ROOT.rglob("*") if not _is_made(path.relative_to(ROOT).parts[:-1], made)]
    return [path for path in paths if path.is_file() and path.suffix in TEXT_SUFFIXES]


def _is_made(folders: tuple[str, ...], made: tuple[str, ...]) -> bool:
    return any(folder in made or folder.endswith(("cache", ".egg-info", "__")) for folder in folders)


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def lock_faults(lock: str, needed: set[str]) -> Iterator[str]:
    """Lines of a lock file that are no pin, for every Python or for some, and needed packages without one."""
    pinned = set()
    for line in lock.splitlines():
        if line.startswith("#") or not line:
            continue
        if match := re.fullmatch(r"([A-Za-z0-9._-]+)==[\w.+!]+( ; python_version [<>=]+ \"[\d.]+\")?", line):
            pinned.add(normalised(match[1]))
        else:
            yield f"not name==version: {line}"
    yield from (f"not pinned: {name}" for name in sorted(needed - pinned))


def normalised(requirement: str) -> str:
    """Name of a package as PEP 503 compares it, without version, extras and marker."""
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert name, requirement
    return re.sub(r"[-_.]+", "-", name[0]).lower()


def test_rooms_exist() -> None:
    names = {dotted(path).partition(".")[0] for path in modules()}
    assert names == set(MAY_IMPORT)


def test_rooms_import_only_what_they_may() -> None:
    faults = [fault for path in modules() for fault in import_faults(dotted(path), path.read_text())]
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("estimators.a", "import transport"),
        ("estimators.a", "def f():\n    from agent.core import Core"),
        ("transport.a", "if TYPE_CHECKING:\n    from estimators.layout import Layout"),
        ("agent.a", "import numpy, sim_bridge.world as world"),
        ("sim_bridge.a", "from fleetloc import cli"),
        ("fleetloc.a", "from tests.conftest import settings"),
    ],
)
def test_import_check_finds_faults(name: str, source: str) -> None:
    assert len(list(import_faults(name, source))) == 1


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("estimators.a", "from estimators.layout import Layout\nfrom . import layout\nimport numpy"),
        ("agent.a", "import estimators.layout\nfrom transport import header"),
        ("fleetloc.a", "import sim_bridge, agent"),
    ],
)
def test_import_check_allows_the_table(name: str, source: str) -> None:
    assert list(import_faults(name, source)) == []


def foreign_assignments(name: str, source: str) -> Iterator[str]:
    """Assignments to a private attribute, or into one, of another object than ``self`` or ``cls``."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Attribute | ast.Subscript) or not isinstance(node.ctx, ast.Store | ast.Del):
            continue
        target: ast.expr = node
        while isinstance(target, ast.Subscript):
            target = target.value
        if not isinstance(target, ast.Attribute) or not target.attr.startswith("_") or target.attr.startswith("__"):
            continue
        owner = target.value
        if not (isinstance(owner, ast.Name) and owner.id in ("self", "cls")):
            yield f"{name}:{node.lineno} sets {ast.unparse(target)}"


def test_nobody_sets_private_state_of_another_object() -> None:
    faults = [fault for path in modules() for fault in foreign_assignments(dotted(path), path.read_text())]
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    "source",
    [
        "other._x = 1",
        "other._x += 1",
        "other._x: int = 1",
        "other._x[0] = 1",
        "self.part._x = 1",
        "a, other._x = 1, 2",
        "del other._x",
        "for other._x in range(2): pass",
    ],
)
def test_private_state_check_finds_faults(source: str) -> None:
    assert len(list(foreign_assignments("agent.a", source))) == 1


@pytest.mark.parametrize(
    "source", ["self._x = 1", "cls._x[0] = 1", "other.x = 1", "y = other._x", "self.__x = 1", "_x = 1"]
)
def test_private_state_check_allows_the_rest(source: str) -> None:
    assert list(foreign_assignments("agent.a", source)) == []


def classes(sources: dict[str, str]) -> dict[str, list[str]]:
    """The modules that define a class of each name, wherever in them it stands."""
    found: dict[str, list[str]] = {}
    for name, source in sources.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(name)
    return found


def test_no_two_classes_have_one_name() -> None:
    found = classes({dotted(path): path.read_text(encoding="utf-8") for path in modules()})
    twice = {name: places for name, places in found.items() if len(places) > 1}
    assert {name: places for name, places in twice.items() if name not in NAMED_TWICE_STILL} == {}
    assert set(twice) >= NAMED_TWICE_STILL  # what is done is taken off the list


def test_retired_words_do_not_come_back() -> None:
    found = classes({dotted(path): path.read_text(encoding="utf-8") for path in modules()})
    assert {name: places for name, places in found.items() if name in RETIRED} == {}


def test_class_check_finds_faults() -> None:
    nested = "class Kind:\n    pass\ndef make():\n    class Inner:\n        pass\n"
    assert classes({"a": nested, "b": "class Kind(int): ..."}) == {"Kind": ["a", "b"], "Inner": ["a"]}


def crowded_folders(paths: list[Path]) -> dict[str, int]:
    """Folders with more modules than a reader can survey."""
    count = Counter(str(path.parent.relative_to(ROOT)) for path in paths if path.name != "__init__.py")
    return {folder: files for folder, files in count.items() if files > MOST_FILES}


def test_floors_can_be_surveyed() -> None:
    assert crowded_folders(modules()) == {}


def test_floor_check_finds_faults() -> None:
    paths = [ROOT / "agent" / "hall" / f"module_{i}.py" for i in range(MOST_FILES + 1)]
    assert crowded_folders(paths) == {"agent/hall": MOST_FILES + 1}


def test_floors_say_what_lives_there() -> None:
    folders = {path.parent for path in modules()}
    silent = [str(folder.relative_to(ROOT)) for folder in folders if not _docstring(folder / "__init__.py")]
    assert silent == []


def _docstring(init: Path) -> str | None:
    return ast.get_docstring(ast.parse(init.read_text())) if init.is_file() else None


PARTS_OF_A_DRONE = {"AgentCore", "AutopilotSession", "Timeline"}
"""What `agent.onboard.OnboardAgent` is put together of; nobody else does that."""
ASSEMBLY = Path("agent") / "onboard.py"


def assemblies(source: str) -> list[str]:
    """The parts of a drone that a module constructs."""
    calls = (node.func for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    names = (func.id if isinstance(func, ast.Name) else getattr(func, "attr", "") for func in calls)
    return sorted(name for name in names if name in PARTS_OF_A_DRONE)


def test_one_drone_is_assembled_in_one_place() -> None:
    everything = [*modules(), *sorted((ROOT / "tests").rglob("*.py"))]
    found = {str(path.relative_to(ROOT)): parts for path in everything if (parts := assemblies(path.read_text()))}
    assert found == {str(ASSEMBLY): sorted(PARTS_OF_A_DRONE)}


def test_assembly_check_finds_faults() -> None:
    source = "core = agent.core.AgentCore(config)\nx = Timeline()\nprint(Timeline)"
    assert assemblies(source) == ["AgentCore", "Timeline"]


def test_sources_know_nothing_of_one_machine() -> None:
    faults = {
        str(path.relative_to(ROOT)): found
        for path in texts()
        if (found := machine_paths(path.read_text(errors="replace")))
    }
    assert faults == {}


@pytest.mark.parametrize("folder", ["home", "root", "work", "Users"])
def test_path_check_finds_faults(folder: str) -> None:
    path = f"/{folder}/somebody/data.npz"
    for text in (path, f'open("{path}")', f"see {path}.", f"FROM=({path})", f"file://{path}"):
        assert machine_paths(text) == [f"/{folder}/somebody"], text


@pytest.mark.parametrize("text", ["a/home/of", "$HOME/work/x", "./work/x", "~/work/x", "s/work/a", "/tmp/x"])
def test_path_check_allows_the_rest(text: str) -> None:
    assert machine_paths(text) == []


def test_lock_pins_every_dependency_and_names_no_server() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needed = {normalised(each) for each in project["dependencies"]}
    needed |= {normalised(each) for name in extras.keys() - NOT_LOCKED for each in extras[name]}
    assert list(lock_faults((ROOT / "requirements.lock").read_text(), needed)) == []


def test_lock_check_finds_faults() -> None:
    lock = "# made by make\nnumpy==2.1.0\nscipy>=1.0\n--index-url https://example.org\n"
    assert list(lock_faults(lock, {"numpy", "numba"})) == [
        "not name==version: scipy>=1.0",
        "not name==version: --index-url https://example.org",
        "not pinned: numba",
    ]
