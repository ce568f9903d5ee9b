"""Whether this installation's five packages are the ones that Python would import; looked at before any of them is.

Their names are short, and others have them too: a folder ``agent/`` where ``python -m fleetloc`` is typed or on
PYTHONPATH (ROS overlays have such), a module ``estimators.py``, or another distribution that ships ``estimators/``
and, installed later, has overwritten ours. Imports nothing but the standard library.
"""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import os
import sys
from importlib import metadata
from pathlib import Path

ROOMS = ("estimators", "transport", "agent", "sim_bridge", "fleetloc")
OWN = Path(__file__).resolve().parents[1]
"""The folder that all five lie in: of the checkout, or ``site-packages``."""
REMEDY_ELSEWHERE = "rename it, or install fleetloc into an environment of its own (pipx install fleetloc)"


def complaint() -> str | None:
    """One line on the first package that would not be ours: what was found where, what to do; ``None`` if all are."""
    for room in ROOMS:
        found = _found(room)
        if found is None:
            return f"package '{room}' of fleetloc is not in {OWN}: it was removed; install fleetloc anew"
        if found != OWN / room:
            return f"{found} hides fleetloc's own package '{room}' ({OWN / room}): {_remedy(found)}"
    return _overwritten()


def child_options() -> list[str]:
    """Options of Python for a process of ours: the working folder's modules must not come before our packages."""
    return [] if Path.cwd() == OWN else ["-P"]


def _found(room: str) -> Path | None:
    """The folder, or module file, that an import of a room would give."""
    try:
        spec = importlib.util.find_spec(room)
    except ValueError:  # something in sys.modules without a specification
        return Path(getattr(sys.modules[room], "__file__", None) or room)
    if spec is None:
        return None
    if spec.origin is None:  # a folder without __init__.py: elsewhere it hides what an editable installation finds
        folder = Path(next(iter(spec.submodule_search_locations or ()), room)).resolve()
        return None if folder == OWN / room else folder
    origin = Path(spec.origin).resolve()
    return origin.parent if origin.name == "__init__.py" else origin


def _remedy(found: Path) -> str:
    if str(found.parent) in (str(Path(each).resolve()) for each in _python_path()):
        return f"take {found.parent} out of PYTHONPATH for this command"
    if found.parent == Path.cwd():
        return "start it from another folder, or as `fleetloc` instead of `python -m fleetloc`"
    return REMEDY_ELSEWHERE


def _python_path() -> list[str]:
    return [each for each in os.environ.get("PYTHONPATH", "").split(os.pathsep) if each]


def _overwritten() -> str | None:
    """On a package in our own place that is not as it was installed; nothing for a checkout, which has no hashes."""
    try:
        files = metadata.distribution("fleetloc").files or []
    except metadata.PackageNotFoundError:
        return None
    wanted = {f"{room}/__init__.py": room for room in ROOMS}
    for file in files:
        room = wanted.get(file.as_posix())
        if room is None or file.hash is None or Path(str(file.locate())).resolve().parents[1] != OWN:
            continue
        digest = hashlib.new(file.hash.mode, Path(str(file.locate())).read_bytes()).digest()
        if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != file.hash.value:
            return f"another distribution has overwritten {OWN / room}: {_culprits(room)}; {REMEDY_ELSEWHERE}"
    return None


def _culprits(room: str) -> str:
    """Who else claims a package; slow, so only when it matters."""
    claimants = metadata.packages_distributions().get(room, [])
    return ", ".join(sorted({name for name in claimants if name != "fleetloc"})) or "unknown which"
