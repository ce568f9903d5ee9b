"""The example configurations and the systemd unit that every installation holds.

``fleetloc/data`` holds links to the folders of the checkout; a wheel holds their files in their place.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from fleetloc.errors import InputError

DATA = Path(__file__).parent / "data"
CONFIGS = DATA / "configs"
DEMO = CONFIGS / "line3.toml"
"""What `fleetloc fleet --demo` flies."""

_STOP = re.compile(r"(?<! al)[.;] ")


def files() -> dict[Path, str]:
    """All files, relative to `DATA`, each with its first comment: what it is an example of."""
    found = sorted(path for folder in sorted(DATA.iterdir()) for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(DATA): _first_comment(path) for path in found}


def copy(folder: Path) -> list[Path]:
    """Copy all into a folder that is new or empty; what was written. Raises `InputError`, `OSError`."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError("--copy", "", "a folder that is new or empty", str(folder))
    written = []
    for name in files():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        written.append(Path(shutil.copyfile(DATA / name, folder / name)))
    return written


def _first_comment(path: Path) -> str:
    """The comment at a file's head up to the end of its first clause, ``#`` removed; empty where there is none."""
    words: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        words.append(line.lstrip("# "))
    return _STOP.split(" ".join(words))[0].removesuffix(".")
