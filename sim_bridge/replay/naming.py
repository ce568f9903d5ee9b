"""What files are called where people read of them: logs of several drones are often called alike."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def names_apart(paths: Iterable[Path]) -> dict[Path, str]:
    """Each path's last parts, as many as it takes to tell all of them apart: usually the file name alone."""
    different = list(dict.fromkeys(paths))
    longest = max((len(path.parts) for path in different), default=0)
    for count in range(1, longest + 1):
        names = ["/".join(path.parts[-count:]) for path in different]
        if len(set(names)) == len(names):
            return dict(zip(different, names, strict=True))
    return {path: str(path) for path in different}
