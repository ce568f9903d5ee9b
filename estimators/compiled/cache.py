"""Where compiled kernels are kept between processes, under which name, and who may compile.

numba's own cache asks for a writable folder even to read, looks only at the file of the outermost function,
and lets every process that finds nothing compile for itself. The daemons of a fleet start together, often
from a read-only image, so this cache

- only reads to load, and writes nothing but the file of a kernel it has compiled;
- names a file by all that the machine code depends on, so a stale file is never looked at;
- hands out one lock per folder, so that one process compiles while the others wait and then load.

Environment: ``FLEETLOC_CACHE`` names the folder (default: ``fleetloc`` in the user's cache folder).
The files are pickles, so whoever writes one runs code here: only those are looked at that belong to the user who
runs this, or to root, and that nobody else may write.
"""

from __future__ import annotations

import ast
import fcntl
import hashlib
import os
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import llvmlite
import numba
import numpy as np
from numba.core import caching, compiler, serialize

FORMAT = 1
"""Version of the files' layout."""
KEPT_PER_KERNEL = 4
"""Files of one kernel for the same target that are kept: a few sources side by side, not all ever seen."""
OTHERS_WRITE = 0o022
_DIGEST_BYTES = 32
_SUFFIX = ".kernel"

_CONFIG: Any = numba.config
_SOURCES: dict[str, bytes] = {}
_STAMPS: dict[str, bytes] = {}


def cache_folder() -> Path:
    """The folder of the compiled kernels, which may not exist yet (``FLEETLOC_CACHE``, read at each call)."""
    chosen = os.environ.get("FLEETLOC_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "fleetloc"


def remember_source(module_name: str) -> None:
    """Read a module's source while it is being imported.

    What is stored later is then named by the source that runs, also if the file is edited meanwhile.
    """
    path = getattr(sys.modules.get(module_name), "__file__", None)
    if path is not None and module_name not in _SOURCES:
        _SOURCES[module_name] = Path(path).read_bytes()


def source_stamp(module_name: str) -> bytes:
    """Digest of the source of a module and of every module of its package that it imports, directly or not.

    Callees and constants of other files are frozen into the machine code, so all those files count. The
    module must be imported; imports inside functions do not count, since a kernel cannot use them.
    """
    if module_name not in _STAMPS:
        digest = hashlib.sha256()
        for name, source in sorted(_closure(module_name).items()):
            digest.update(f"{name}\0{len(source)}\0".encode())
            digest.update(source)
        _STAMPS[module_name] = digest.digest()
    return _STAMPS[module_name]


def _closure(module_name: str) -> dict[str, bytes]:
    package = module_name.partition(".")[0]
    sources: dict[str, bytes] = {}
    waiting = [module_name]
    while waiting:
        name = waiting.pop()
        if name in sources:
            continue
        remember_source(name)
        if name not in _SOURCES:  # no module: a name in a package, or an import under a condition
            continue
        sources[name] = _SOURCES[name]
        is_package = hasattr(sys.modules[name], "__path__")
        waiting += [
            imported
            for imported in _imports(name, is_package, sources[name])
            if imported.partition(".")[0] == package
        ]
    return sources


def _imports(name: str, is_package: bool, source: bytes) -> Iterator[str]:
    """Names that the top level imports; ``from a import b`` gives a and a.b, and one may be no module."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = name.split(".")
                parents = parents[: len(parents) - node.level + is_package]
                base = ".".join([*parents, base] if base else parents)
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


class KernelCache(caching._Cache):
    """The place of one kernel with one signature; what numba's dispatcher calls to load and to save.

    Parameters
    ----------
    function
        The Python function.
    options
        The compiler options, which are part of the name.
    report
        Called with a sentence when a file cannot be used or written.
    """

    def __init__(
        self, function: Callable[..., Any], options: dict[str, Any], report: Callable[[str], None]
    ) -> None:
        self._function = function
        self._options = repr(sorted(options.items()))
        self._report = report

    @property
    def cache_path(self) -> str:
        """The folder."""
        return str(cache_folder())

    def path(self, signature: Any, target_context: Any) -> Path:
        """The file of a signature, for the code generator's target and the sources as they are now."""
        environment = (
            FORMAT,
            sys.implementation.cache_tag,
            (numba.__version__, llvmlite.__version__, np.__version__),
            (int(_CONFIG.OPT), _CONFIG.BOUNDSCHECK, _CONFIG.DEBUGINFO_DEFAULT),
            target_context.codegen().magic_tuple(),
            self._options,
            str(signature),
        )
        name = f"{self._function.__module__}.{self._function.__qualname__}".replace("<", "").replace(">", "")
        prefix = hashlib.sha256(repr(environment).encode()).hexdigest()[:16]
        stamp = source_stamp(self._function.__module__).hex()[:16]
        return cache_folder() / f"{name}-{prefix}-{stamp}{_SUFFIX}"

    def read(self, signature: Any, target_context: Any) -> bytes | None:
        """The stored payload, or None if there is none or it is damaged (which is reported)."""
        path = self.path(signature, target_context)
        try:
            with path.open("rb") as file:
                distrusted = _distrusted(os.fstat(file.fileno()))
                stored = b"" if distrusted else file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._report(f"cannot read {path}: {error.strerror}")
            return None
        if distrusted:
            self._report(f"{path} {distrusted}: not used, and compiled again")
            return None
        digest, payload = stored[:_DIGEST_BYTES], stored[_DIGEST_BYTES:]
        if hashlib.sha256(payload).digest() != digest:
            self._report(f"{path} is damaged and is compiled again")
            return None
        return payload

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function, or None if it must be compiled."""
        target_context.refresh()
        payload = self.read(sig, target_context)
        if payload is None:
            return None
        rebuild: Any = compiler.CompileResult._rebuild
        return rebuild(target_context, *pickle.loads(payload))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store a compiled function; a folder that cannot be written is reported, and costs only the time.

        Raises ``TypeError`` for a function whose machine code holds addresses of this process.
        """
        if data.lifted or data.library.has_dynamic_globals:
            raise TypeError(
                f"kernel {self._function.__qualname__} cannot be stored: it uses a large global array or a "
                "pointer of this process; pass it as an argument"
            )
        path = self.path(sig, data.target_context)
        dumps: Any = serialize.dumps
        payload = dumps(data._reduce())
        temporary = path.with_suffix(f".{os.getpid()}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.unlink(missing_ok=True)
            with open(temporary, "xb", opener=_private) as file:
                file.write(hashlib.sha256(payload).digest() + payload)
            temporary.replace(path)
            _remove_old(path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            self._report(f"cannot store compiled kernels in {path.parent}: {error.strerror}")

    def enable(self) -> None:
        """Part of numba's interface; always enabled."""

    def disable(self) -> None:
        """Part of numba's interface; always enabled."""

    def flush(self) -> None:
        """Part of numba's interface; a file is replaced, never emptied."""


def _distrusted(status: os.stat_result) -> str:
    """Why a file is not to be believed; empty if it is."""
    if status.st_uid not in (os.geteuid(), 0):
        return f"belongs to user {status.st_uid}, expected {os.geteuid()} or root"
    if status.st_mode & OTHERS_WRITE:
        return f"can be written by others (mode {status.st_mode & 0o777:03o})"
    return ""


def _private(path: str, flags: int) -> int:
    """Make a file that others may read whatever the mask is, and only we may write."""
    return os.open(path, flags, 0o644 & ~OTHERS_WRITE)


def _remove_old(newest: Path) -> None:
    prefix = newest.name.rpartition("-")[0]
    same = sorted(newest.parent.glob(f"{prefix}-*{_SUFFIX}"), key=lambda path: path.stat().st_mtime)
    for path in same[:-KEPT_PER_KERNEL]:
        path.unlink(missing_ok=True)


_THREADS = threading.RLock()


class _Held:
    """Whether this process holds the folder; guarded by ``_THREADS``."""

    inside = False


@contextmanager
def compile_lock(waiting: Callable[[], None], report: Callable[[str], None]) -> Iterator[None]:
    """Hold the cache folder for compiling; other threads and processes wait here. May be nested.

    ``waiting`` is called once if another process holds it. The system releases the lock of a process that
    dies. A folder that cannot be written has nothing to share, hence no lock; a file system without locks is
    reported, and costs only the time.
    """
    with _THREADS:
        if _Held.inside:
            yield
            return
        try:
            cache_folder().mkdir(parents=True, exist_ok=True)
            handle = open(cache_folder() / "lock", "ab")  # noqa: SIM115  # closed below
        except OSError:  # reported when the result cannot be stored
            yield
            return
        with handle:
            try:
                _take(handle, waiting)
            except OSError as error:
                report(f"cannot lock {handle.name}: {error.strerror}")
            _Held.inside = True
            try:
                yield
            finally:
                _Held.inside = False


def _take(handle: IO[bytes], waiting: Callable[[], None]) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        waiting()
        fcntl.flock(handle, fcntl.LOCK_EX)
