"""Take out of an environment what never runs in a fleet: the tests of libraries.

``python prune.py PREFIX``; says what it freed.
"""

import shutil
import sys
from pathlib import Path

TESTED = ("numba", "scipy", "matplotlib", "mpl_toolkits")
"""Libraries whose folders named tests nothing imports."""


def unneeded(packages: Path) -> list[Path]:
    """Folders to remove, none inside another."""
    return [folder for name in TESTED for folder in (packages / name).rglob("tests") if folder.is_dir()]


def size_bytes(path: Path) -> int:
    """Size of a file or of all files of a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


(site,) = Path(sys.argv[1]).glob("lib/python*/site-packages")
freed = 0
for path in unneeded(site):
    freed += size_bytes(path)
    shutil.rmtree(path)
sys.stdout.write(f"pruned {freed / 1e6:.0f} MB\n")
