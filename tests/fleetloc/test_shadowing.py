"""Packages of others with the names of ours: one line that says what was found where, never a traceback."""

from __future__ import annotations

import base64
import hashlib
import os
import subprocess
import sys
import types
from collections.abc import Mapping
from pathlib import Path

import pytest

from agent.exit_codes import ExitCode
from fleetloc import shadowing

ROOT = Path(__file__).parents[2]


def version(
    folder: Path, environment: Mapping[str, str] | None = None, options: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """``python -m fleetloc --version`` typed in a folder."""
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, *options, "-m", "fleetloc", "--version"],
        cwd=folder, env=clean | (environment or {}), capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip


def package(folder: Path, name: str) -> Path:
    """A package of somebody else."""
    made = folder / name
    made.mkdir(parents=True)
    (made / "__init__.py").write_text("raise RuntimeError('of somebody else')\n")
    return made


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode == ExitCode.REFUSED, done.stderr
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("fleetloc: error: ")
    return line


def test_nothing_is_said_where_all_is_well(tmp_path: Path) -> None:
    done = version(tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("fleetloc ")


@pytest.mark.parametrize("room", ["agent", "transport", "estimators", "sim_bridge"])
def test_a_package_in_the_working_folder(tmp_path: Path, room: str) -> None:
    made = package(tmp_path, room)
    line = one_line(version(tmp_path))
    assert f"{made} hides fleetloc's own package '{room}' ({ROOT / room})" in line
    assert "start it from another folder" in line


def test_a_module_in_the_working_folder(tmp_path: Path) -> None:
    module = tmp_path / "estimators.py"
    module.write_text("raise RuntimeError('of somebody else')\n")
    assert f"{module} hides fleetloc's own package 'estimators'" in one_line(version(tmp_path))


def test_a_package_on_pythonpath(tmp_path: Path) -> None:
    overlay, elsewhere = tmp_path / "overlay", tmp_path / "elsewhere"
    made = package(overlay, "agent")
    elsewhere.mkdir()
    line = one_line(version(elsewhere, {"PYTHONPATH": f"{tmp_path}{os.pathsep}{overlay}"}))
    assert f"{made} hides fleetloc's own package 'agent'" in line
    assert f"take {overlay} out of PYTHONPATH" in line


def test_a_module_without_a_specification_that_took_the_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN something in ``sys.modules`` that no finder has put there WHEN looked at THEN it is named."""
    monkeypatch.setitem(sys.modules, "agent", types.ModuleType("agent"))
    assert "hides fleetloc's own package 'agent'" in (shadowing.complaint() or "nothing")


def installed(site: Path) -> None:
    """As much of an installation as the look needs: the packages' first files, with their hashes on record."""
    record = []
    for name in (*(f"{room}/__init__.py" for room in shadowing.ROOMS), "fleetloc/shadowing.py"):
        content = (ROOT / name).read_bytes()
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (site / name).write_bytes(content)
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        record.append(f"{name},sha256={digest},{len(content)}")
    distribution(site, "fleetloc", record)


def distribution(site: Path, name: str, record: list[str]) -> None:
    folder = site / f"{name}-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (folder / "RECORD").write_text("\n".join(record) + "\n")


def look(site: Path) -> str:
    """What is said of an installation in ``site``."""
    command = [sys.executable, "-S", "-P", "-c", "from fleetloc import shadowing; print(shadowing.complaint())"]
    environment = os.environ | {"PYTHONPATH": str(site)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=60).stdout


def test_another_distribution_that_has_overwritten_a_package_of_an_installation(tmp_path: Path) -> None:
    installed(tmp_path)
    assert look(tmp_path) == "None\n"
    (tmp_path / "estimators" / "__init__.py").write_text("version = 3\n")
    distribution(tmp_path, "estimators", ["estimators/__init__.py,,"])
    said = look(tmp_path)
    assert f"another distribution has overwritten {tmp_path / 'estimators'}: estimators; " in said
    assert "pipx install fleetloc" in said


def test_a_package_that_was_removed_from_an_installation(tmp_path: Path) -> None:
    installed(tmp_path)
    (tmp_path / "transport" / "__init__.py").unlink()
    (tmp_path / "transport" / "left.txt").write_text("a file that the removal left\n")
    said = look(tmp_path)
    assert said == f"package 'transport' of fleetloc is not in {tmp_path}: it was removed; install fleetloc anew\n"


def test_a_folder_that_is_no_package_hides_ours_only_where_a_finder_brings_them(tmp_path: Path) -> None:
    """GIVEN folders named agent and transport without ``__init__.py`` (of a ROS workspace) THEN ours are found.

    An editable installation may bring ours by a finder that Python asks last, and then the line says what hides them.
    """
    for name in ("agent", "transport"):
        (tmp_path / name / "src").mkdir(parents=True)
    said = version(tmp_path)
    if any("__editable___fleetloc" in repr(finder) for finder in sys.meta_path):
        assert said.returncode == 3
        assert f"{tmp_path / 'transport'} hides fleetloc's own package 'transport'" in said.stderr
    else:
        assert said.returncode == 0


def test_processes_of_a_run_do_not_look_into_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN a folder that holds ``agent/`` WHEN `fleetloc` starts its daemons there THEN they find our packages."""
    package(tmp_path, "agent")
    monkeypatch.chdir(tmp_path)
    assert version(tmp_path, options=tuple(shadowing.child_options())).returncode == 0


def test_a_checkout_that_is_not_installed_starts_its_processes_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert shadowing.child_options() == []
