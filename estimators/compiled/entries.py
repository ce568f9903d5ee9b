"""Compiled kernels: the two decorators, ahead-of-time compilation, and the processor they are compiled for.

A *kernel* is a function on scalars and arrays that other kernels call; it is compiled into each of its
callers. An *entry* is a kernel that Python calls; it has one explicit signature, is compiled once, and then
loaded from the cache (`estimators.compiled.cache`) by every later process::

    @kernel
    def half(x: float) -> float:
        return 0.5 * x

    @entry("float64(ROW[::1], float64[:, ::1])", ROW=ROW)
    def step(rows: RowTable, out: Matrix) -> float: ...

What belongs together travels as one `NamedTuple` of arrays and numbers, whose `structure` stands beside it. An
entry takes it as the `plain` tuple, since numba would read the names of its fields anew at every call (2 us)::

    class Window(NamedTuple):
        rows: RowTable
        dt: float

    WINDOW = structure(Window, "ROW[::1], float64", ROW=ROW)

    @entry("float64(WINDOW)", WINDOW=WINDOW)
    def cost(window: Window) -> float:
        window = Window(*window)
        ...

    cost(plain(window))

Nothing is compiled by an import. The first call of an entry loads or compiles it; `warm_up` does so for all
of them, with progress. All kernels release the interpreter lock, follow IEEE 754 to the letter (no
``fastmath``), and divide as numpy does (no exception).

Environment: ``FLEETLOC_CPU`` is ``generic`` (default: the code runs on every processor of the architecture,
so that a cache made elsewhere serves), ``x86-64-v2``, ``x86-64-v3`` (AVX2 and FMA) or ``native``.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar, cast

import llvmlite.binding
import numba
import numpy as np
from numba.core import event, types
from numba.core.registry import CPUDispatcher

from estimators.compiled.cache import KernelCache, cache_folder, compile_lock, remember_source

_CONFIG: Any = numba.config

What = Literal["compiling", "inner", "compiled", "ready", "waiting", "warning"]
Function = TypeVar("Function", bound=Callable[..., Any])
Structure = TypeVar("Structure", bound=tuple[Any, ...])

OPTIONS: dict[str, Any] = {"nopython": True, "nogil": True, "error_model": "numpy", "fastmath": False}

_LEVEL_2 = ("sse3", "ssse3", "sse4.1", "sse4.2", "popcnt", "cx16")
_LEVEL_3 = (*_LEVEL_2, "avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
_NEEDS = {"generic": (), "x86-64-v2": _LEVEL_2, "x86-64-v3": _LEVEL_3}


class TargetError(ValueError):
    """``FLEETLOC_CPU`` names no processor, or one whose instructions this machine lacks."""


@dataclass(frozen=True, slots=True)
class Progress:
    """One thing that happened while kernels were made ready.

    Attributes
    ----------
    what
        ``compiling`` an entry (``name``), ``inner``: a kernel on the way to it, ``compiled``: the entry is
        done; ``ready``: `warm_up` has compiled or loaded the entry; ``waiting`` for another process that
        compiles; ``warning``: the cache could not be used as intended (``detail``).
    name
        Qualified name of the entry or kernel, empty for ``waiting`` and ``warning``.
    done, total
        Entries ready so far and altogether; in a call of a single entry 0 or 1 of 1.
    detail
        Sentence for people.
    """

    what: What
    name: str = ""
    done: int = 0
    total: int = 1
    detail: str = ""


Listener = Callable[[Progress], None]


def _ignore(progress: Progress) -> None:
    """The listener of a library that prints nothing."""


class _State:
    """What this process compiles for, whom it tells, and where it stands."""

    listener: Listener = staticmethod(_ignore)
    done: int = 0
    total: int = 1


_KERNELS: set[str] = set()
_ENTRIES: dict[str, Entry] = {}


def on_progress(listener: Listener | None) -> None:
    """Set who hears of compilation on first calls (None: nobody); `warm_up` takes its own."""
    _State.listener = staticmethod(_ignore if listener is None else listener)


def select_target(choice: str) -> None:
    """Compile for a processor, see the module's text. Only before the first kernel of the process is defined.

    Raises `TargetError`.
    """
    if choice == "native":
        return
    if choice not in _NEEDS:
        raise TargetError(f"FLEETLOC_CPU={choice!r}: expected one of {', '.join(_NEEDS)}, native")
    has = llvmlite.binding.get_host_cpu_features() if choice != "generic" else {}
    missing = [feature for feature in _NEEDS[choice] if not has.get(feature)]
    if missing:
        raise TargetError(f"FLEETLOC_CPU={choice}: this processor lacks {', '.join(missing)}; use generic")
    _CONFIG.CPU_NAME = choice
    _CONFIG.CPU_FEATURES = ""  # those of the name, not those of this machine


select_target(os.environ.get("FLEETLOC_CPU") or "generic")


def kernel(function: Function) -> Function:
    """Make a function callable from kernels and entries, compiled into each of them.

    It can be called from Python too (tests do), which compiles it for the arguments in this process only.
    """
    remember_source(function.__module__)
    _KERNELS.add(_name(function))
    return cast(Function, numba.jit(**OPTIONS)(function))


class _Plain(Protocol):
    def __call__(self, made: Structure, /) -> Structure: ...


plain = cast(_Plain, tuple)
"""A `NamedTuple` as the plain tuple that an entry takes; for type checkers it is what it was."""


def structure(made: type[Any], fields: str, **named: Any) -> Any:
    """What stands in an entry's signature for a `NamedTuple` of a module, as argument or as result.

    ``fields`` are the types of its fields in order, in numba's notation; ``named`` as in `entry`.
    """
    named_tuple: Any = types.NamedTuple
    return named_tuple(_read(f"({fields},)", named), made)


def _read(notation: str, named: Mapping[str, Any]) -> Any:
    """A type, tuple of types or signature from numba's notation and the names in it."""
    known = {name: numba.from_dtype(each) if isinstance(each, np.dtype) else each for name, each in named.items()}
    return eval(notation, {"__builtins__": {}}, {**vars(types), **known})


def entry(signature: str, **named: Any) -> Callable[[Function], Function]:
    """Make a function callable from Python as machine code with exactly this signature.

    Parameters
    ----------
    signature
        numba's notation, e.g. ``"void(float64[:, ::1], int64)"``. ``[::1]`` takes contiguous arrays only.
    named
        What the names in the signature stand for: structured dtypes, or what `structure` gives.

    A call with other types raises ``TypeError`` (numbers are converted). Kernels may call an entry like a
    kernel.
    """
    def decorate(function: Function) -> Function:
        if _CONFIG.DISABLE_JIT:  # to debug or to measure coverage: plain Python
            return function
        remember_source(function.__module__)
        parsed = _read(signature, named)
        made = Entry(function, parsed.replace(args=tuple(_plain_type(each) for each in parsed.args)))
        _ENTRIES[_name(function)] = made
        return cast(Function, made)

    return decorate


def _plain_type(argument: Any) -> Any:
    """The type of an argument of an entry: a structure's is that of its plain tuple."""
    made: Any = types.Tuple
    return made(argument.types) if isinstance(argument, types.NamedTuple) else argument


def _name(function: Any) -> str:
    return f"{function.__module__}.{function.__qualname__}"


class Entry(CPUDispatcher):
    """numba's dispatcher with one fixed signature that is loaded or compiled at the first call."""

    def __init__(self, function: Callable[..., Any], signature: Any) -> None:
        super().__init__(function, targetoptions=dict(OPTIONS))
        self.signature = signature
        self._cache = KernelCache(function, OPTIONS, _warn)
        self._as_kernel: Any = numba.jit(**OPTIONS)(function)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What numba's typing asks for a call from a kernel: there an entry is an ordinary kernel."""
        return self._as_kernel.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """What numba's lowering asks for a call from a kernel."""
        return self._as_kernel.get_overload(sig)

    @property
    def is_ready(self) -> bool:
        """Whether this process has the machine code."""
        return bool(self.overloads)

    def is_stored(self) -> bool:
        """Whether the cache has the machine code of the present sources for the present target."""
        return self._cache.read(self.signature, self.targetctx) is not None

    def make_ready(self) -> None:
        """Load the machine code, or else compile and store it, once among all processes."""
        if self.is_ready:
            return
        if self.is_stored():
            self.compile(self.signature)
        else:
            with compile_lock(_tell_waiting, _warn):
                if not self.is_ready:  # another thread may have been faster
                    self._compile_aloud()
        self.disable_compile()

    def _compile_aloud(self) -> None:
        if self.is_stored():  # by the process that held the lock before
            self.compile(self.signature)
            return
        _tell("compiling", _name(self.py_func))
        with _inner_kernels_told():
            self.compile(self.signature)
        _tell("compiled", _name(self.py_func))

    def _compile_for_args(self, *_args: Any, **_kws: Any) -> Any:
        """What numba's dispatcher asks for a callable when it has no machine code for the arguments.

        With the machine code there, the dispatcher itself calls it or refuses the arguments.
        """
        self.make_ready()
        return self


def _tell(what: What, name: str = "", detail: str = "") -> None:
    _State.listener(Progress(what, name, _State.done, _State.total, detail))


def _warn(sentence: str) -> None:
    _tell("warning", detail=sentence)


def _tell_waiting() -> None:
    _tell("waiting", detail=f"another process compiles kernels into {cache_folder()}")


class _InnerKernels(event.Listener):
    """Tells of each project kernel that numba turns to on the way to an entry."""

    def on_start(self, event: Any) -> None:
        name = _name(event.data["dispatcher"].py_func)
        if name in _KERNELS:
            _tell("inner", name)

    def on_end(self, event: Any) -> None:
        """Part of numba's interface."""


@contextmanager
def _inner_kernels_told() -> Iterator[None]:
    with event.install_listener("numba:compile", _InnerKernels()):
        yield


def entries() -> tuple[str, ...]:
    """Qualified names of the entries of all modules imported so far."""
    return tuple(_ENTRIES)


def import_all() -> None:
    """Import every module of the room, on all its floors, so that every entry is known."""
    room = __name__.partition(".")[0]
    for module in pkgutil.walk_packages(importlib.import_module(room).__path__, f"{room}."):
        importlib.import_module(module.name)


def is_warm() -> bool:
    """Whether all entries known (see `import_all`) are in this process or in the cache."""
    return all(known.is_ready or known.is_stored() for known in _ENTRIES.values())


def warm_up(progress: Listener | None = None) -> int:
    """Make all entries known (see `import_all`) ready in this process and in the cache; returns their number.

    ``progress`` hears of it (default: who is set by `on_progress`). Of several processes that start together
    one compiles, and the others wait, then load.
    """
    before = _State.listener
    if progress is not None:
        on_progress(progress)
    _State.total = len(_ENTRIES)
    try:
        # One process compiles them all: what entries share is then compiled once too.
        with nullcontext() if is_warm() else compile_lock(_tell_waiting, _warn):
            for name, known in _ENTRIES.items():
                known.make_ready()
                _State.done += 1
                _tell("ready", name)
    finally:
        _State.listener = staticmethod(before)
        _State.done, _State.total = 0, 1
    return len(_ENTRIES)
