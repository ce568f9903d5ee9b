"""A wheel built from the tree holds all that is needed outside of it, and flies from there."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from fleetloc import shadowing

ROOT = Path(__file__).parents[2]
NEEDED = (*shadowing.ROOMS, "configs", "deploy", "pyproject.toml", "setup.py", "README.md", "LICENSE")
CODEC = "mavlink/ardupilotmega.py"
"""In the agent's package: what `setup.py` adds to a wheel."""
BUILD = "import sys, setuptools.build_meta as build; print(build.build_wheel(sys.argv[1]))"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the wheel holds, as `pip install` would unpack it."""
    pytest.importorskip("setuptools", "77", reason="NOT TESTED: this setuptools cannot build the wheel; run make")
    tree, made, site = (tmp_path_factory.mktemp(name) for name in ("tree", "made", "site"))
    for name in NEEDED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, tree / name)
    command = [sys.executable, "-P", "-c", BUILD, str(made)]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(next(made.glob("fleetloc-*.whl"))) as wheel:
        wheel.extractall(site)
    return site


def names(folder: Path, pattern: str) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob(pattern))


def test_a_wheel_holds_examples_unit_web_page_and_types(site: Path) -> None:
    held = site / "fleetloc"
    assert names(held / "data/configs", "*.toml") == names(ROOT / "configs", "*.toml")
    assert names(held / "data/systemd", "*") == names(ROOT / "deploy/systemd", "*")
    assert names(held / "monitor/static", "*") == ["page.css", "page.html", "page.js"]
    assert names(site, "py.typed") == sorted(f"{room}/py.typed" for room in shadowing.ROOMS)


def test_a_wheel_holds_every_module_and_nothing_else_at_the_top(site: Path) -> None:
    for room in shadowing.ROOMS:
        more = [CODEC] if room == "agent" else []
        assert names(site / room, "*.py") == sorted(names(ROOT / room, "*.py") + more)
    assert sorted(path.name for path in site.iterdir() if path.suffix != ".dist-info") == sorted(shadowing.ROOMS)


def test_a_wheel_speaks_mavlink_without_pymavlink(site: Path, tmp_path: Path) -> None:
    """GIVEN an installed wheel WHEN its codec is loaded THEN it is the copy, which is pymavlink's file."""
    look = "import sys; from agent.mavlink.dialect import mavlink as m; print(m.__file__, 'pymavlink' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-P", "-c", look], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(site)},
        capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    assert done.stdout.split() == [str(site / "agent" / CODEC), "False"]
    spec = importlib.util.find_spec("pymavlink.dialects.v20.ardupilotmega")
    assert spec is not None
    assert (site / "agent" / CODEC).read_bytes() == Path(str(spec.origin)).read_bytes()


def test_a_wheel_is_built_with_the_pymavlink_that_is_tested() -> None:
    requires = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    (codec,) = [each for each in requires if each.startswith("pymavlink")]
    assert codec in (ROOT / "requirements.lock").read_text().splitlines()


def test_what_is_unpacked_flies_the_demo_from_another_folder(site: Path, tmp_path: Path) -> None:
    """GIVEN an installed wheel WHEN the demo is flown from an empty folder THEN its report is there."""
    arguments = ["fleet", "--demo", "--lockstep", "--duration", "2"]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "fleetloc", *arguments],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(site)}, capture_output=True, text=True, check=False,
        timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "fleetloc-demo" / "report.json").is_file()
