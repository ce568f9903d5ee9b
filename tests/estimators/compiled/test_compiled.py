"""Compiled kernels: cached for all processes and processors, compiled once, never stale.

The kernels under test live in a small package of their own, and each process of a test is a real one.
"""

from __future__ import annotations

import ctypes
import json
import os
import platform
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import llvmlite.binding
import pytest

from estimators.compiled import cache as kernel_cache
from estimators.compiled import entries as compiled

ROOT = Path(__file__).parents[3]

SAMPLE = {
    "__init__.py": "",
    "constants.py": "FACTOR = 2.0\n",
    "inner.py": """
        from estimators.compiled.entries import kernel
        from sample.constants import FACTOR

        @kernel
        def scaled(x):
            return FACTOR * x
        """,
    "outer.py": """
        import numpy as np
        from estimators.compiled.entries import entry, kernel
        from . import inner

        ROW = np.dtype([("value", np.float64), ("kind", np.int32)], align=True)
        scaled = inner.scaled

        @entry("float64(float64[::1])")
        def total(values):
            total = 0.0
            for i in range(values.shape[0]):
                total += scaled(values[i])
            return total

        @entry("float64(ROW[::1], float64)", ROW=ROW)
        def ratio(rows, divisor):
            values = np.empty(rows.shape[0])
            for i in range(rows.shape[0]):
                values[i] = rows[i]["value"]
            return total(values) / divisor
        """,
    "unrelated.py": "NOTHING = 0\n",
}

CHILD = """
import dataclasses, json, sys
import numpy as np
from estimators.compiled import entries as compiled
from sample import outer

def tell(progress):
    print(json.dumps(dataclasses.asdict(progress)), flush=True)

compiled.on_progress(tell)
warm = compiled.is_warm()
exec(sys.argv[1])
answer = [outer.total(np.ones(3)), outer.ratio(np.ones(3, outer.ROW), 2.0)]
print(json.dumps({"answer": answer, "warm_before": warm, "warm_after": compiled.is_warm()}))
"""


@dataclass
class Outcome:
    """What a child process printed: its progress events and its answer."""

    events: list[dict[str, Any]]
    answer: list[float]
    warm_before: bool
    warm_after: bool

    def count(self, what: str) -> int:
        return sum(event["what"] == what for event in self.events)


class Sample:
    """A package of kernels with its cache folder, and processes that call it."""

    def __init__(self, folder: Path) -> None:
        self.package = folder / "sample"
        self.cache = folder / "cache"
        self.package.mkdir()
        for name, source in SAMPLE.items():
            (self.package / name).write_text(textwrap.dedent(source))

    def edit(self, name: str, old: str, new: str) -> None:
        path = self.package / name
        source = path.read_text()
        assert old in source
        path.write_text(source.replace(old, new))

    def start(self, code: str = "", *, prefix: str = "", **environment: str) -> subprocess.Popen[str]:
        ours = ("NUMBA_", "FLEETLOC_")
        inherited = {key: value for key, value in os.environ.items() if not key.startswith(ours)}
        return subprocess.Popen(
            [sys.executable, "-B", "-c", prefix + CHILD, code],
            env={
                **inherited,
                "PYTHONPATH": f"{self.package.parent}{os.pathsep}{ROOT}",
                "FLEETLOC_CACHE": str(self.cache),
                **environment,
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, code: str = "", *, prefix: str = "", **environment: str) -> Outcome:
        return outcome(self.start(code, prefix=prefix, **environment))

    def files(self) -> set[str]:
        return {path.name for path in self.cache.glob("*.kernel")}


def outcome(child: subprocess.Popen[str]) -> Outcome:
    out, err = child.communicate(timeout=120)
    assert child.returncode == 0, err
    *events, last = [json.loads(line) for line in out.splitlines()]
    return Outcome(events, **last)


@pytest.fixture
def sample(tmp_path: Path) -> Sample:
    return Sample(tmp_path)


@pytest.fixture(scope="module")
def warmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sample, Outcome]:
    """A sample whose first process has run."""
    made = Sample(tmp_path_factory.mktemp("warmed"))
    return made, made.run()


def test_first_process_compiles_and_tells(warmed: tuple[Sample, Outcome]) -> None:
    # GIVEN an empty cache, WHEN the first process calls two entries
    sample, first = warmed
    # THEN it is right, and has told of both entries and of the kernel inside
    assert first.answer == [6.0, 3.0]
    assert not first.warm_before
    assert first.warm_after
    assert [event["name"] for event in first.events if event["what"] == "compiling"] == [
        "sample.outer.total",
        "sample.outer.ratio",
    ]
    assert "sample.inner.scaled" in {event["name"] for event in first.events if event["what"] == "inner"}
    assert len(sample.files()) == 2


def test_next_process_only_loads(warmed: tuple[Sample, Outcome]) -> None:
    sample, _ = warmed
    second = sample.run()
    assert second.answer == [6.0, 3.0]
    assert second.warm_before
    assert second.events == []


def test_warm_up_counts_what_is_ready(sample: Sample) -> None:
    first = sample.run("compiled.warm_up()")
    assert [(e["name"], e["done"], e["total"]) for e in first.events if e["what"] == "ready"] == [
        ("sample.outer.total", 1, 2),
        ("sample.outer.ratio", 2, 2),
    ]
    assert first.events[-1]["what"] == "ready", "nothing is compiled after the warm-up"
    assert sample.run().events == []


@pytest.mark.parametrize(
    ("name", "old", "new", "answer"),
    [
        ("inner.py", "FACTOR * x", "FACTOR * x + 1.0", [9.0, 4.5]),
        ("constants.py", "2.0", "4.0", [12.0, 6.0]),
    ],
    ids=["callee in another file", "constant in a third file"],
)
def test_changed_source_is_compiled_again(
    sample: Sample, name: str, old: str, new: str, answer: list[float]
) -> None:
    # GIVEN a warm cache
    sample.run()
    before = sample.files()
    # WHEN a file that the entries do not lie in changes
    sample.edit(name, old, new)
    changed = sample.run()
    # THEN the new code runs
    assert changed.answer == answer
    assert changed.count("compiling") == 2
    # and the old one is still there for whoever goes back
    sample.edit(name, new, old)
    back = sample.run()
    assert back.answer == [6.0, 3.0]
    assert back.events == []
    assert before < sample.files()


@pytest.mark.parametrize(
    ("name", "is_package", "source", "imported"),
    [
        ("p.a", False, "import p.b as b, numpy", {"p.b", "numpy"}),
        ("p.a", False, "from p.b import c", {"p.b", "p.b.c"}),
        ("p.a", False, "from . import b", {"p", "p.b"}),
        ("p.a", False, "from .b import c", {"p.b", "p.b.c"}),
        ("p.q.a", False, "from ..b import c", {"p.b", "p.b.c"}),
        ("p.q", True, "from .b import c", {"p.q.b", "p.q.b.c"}),
        ("p.a", False, "def f():\n    import p.b", set()),
    ],
)
def test_every_form_of_import_counts(name: str, is_package: bool, source: str, imported: set[str]) -> None:
    assert set(kernel_cache._imports(name, is_package, source.encode())) == imported


def test_file_that_no_kernel_imports_does_not_matter(warmed: tuple[Sample, Outcome]) -> None:
    sample, _ = warmed
    sample.edit("unrelated.py", "NOTHING = 0", "NOTHING = 0  # or is it")
    assert sample.run("import sample.unrelated").events == []


def test_source_edited_while_the_process_runs_does_not_spoil_the_cache(sample: Sample) -> None:
    # GIVEN a process that has imported the kernels, WHEN their file changes before the first call
    old = sample.run("path = outer.inner.__file__; text = open(path).read();"
                     "open(path, 'w').write(text.replace('FACTOR * x', '100.0 * x'))")
    # THEN it runs and stores what it has imported, and the next process does not take that for the new source
    assert old.answer == [6.0, 3.0]
    assert sample.run().answer == [300.0, 150.0]


def test_processes_that_start_together_compile_once(sample: Sample) -> None:
    children = [sample.start("compiled.warm_up()") for _ in range(4)]
    outcomes = [outcome(child) for child in children]
    assert all(each.answer == [6.0, 3.0] for each in outcomes)
    compiled_names = [e["name"] for each in outcomes for e in each.events if e["what"] == "compiling"]
    assert sorted(compiled_names) == ["sample.outer.ratio", "sample.outer.total"]


def test_a_process_waits_for_the_one_that_compiles(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEETLOC_CACHE", str(sample.cache))
    # GIVEN a process that holds the folder
    lock = kernel_cache.compile_lock
    with lock(pytest.fail, pytest.fail), lock(pytest.fail, pytest.fail):
        child = sample.start()
        assert child.stdout is not None
        # WHEN another needs a kernel, THEN it says so, and compiles only when its turn has come
        told = json.loads(child.stdout.readline())
        assert told["what"] == "waiting"
        assert str(sample.cache) in told["detail"]
        assert sample.files() == set()
    assert outcome(child).answer == [6.0, 3.0]


def test_threads_share_one_compilation(sample: Sample) -> None:
    together = """
from concurrent.futures import ThreadPoolExecutor
with ThreadPoolExecutor(4) as pool:
    assert list(pool.map(outer.total, [np.ones(3)] * 8)) == [6.0] * 8
"""
    assert sample.run(together).count("compiling") == 2


# Root may write everywhere: it must give that up for a mode of 0555 to mean anything.
WITHOUT_PRIVILEGE = """
import ctypes, os, sys
PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1
if os.geteuid() == 0 and "dropped" not in sys.argv:
    if ctypes.CDLL(None, use_errno=True).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0):
        sys.exit(77)
    os.execv(sys.executable, [*sys.orig_argv, "dropped"])
try:
    open(os.path.join(os.environ["FLEETLOC_CACHE"], "probe"), "w")
    sys.exit(77)
except PermissionError:
    pass
"""


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    folder.chmod(0o555)
    try:
        yield
    finally:
        folder.chmod(0o755)


def run_unprivileged(sample: Sample) -> Outcome:
    child = sample.start(prefix=WITHOUT_PRIVILEGE)
    out, err = child.communicate(timeout=120)
    if child.returncode == 77:
        pytest.skip("this user writes to read-only folders and cannot give that up")
    assert child.returncode == 0, err
    *events, last = [json.loads(line) for line in out.splitlines()]
    return Outcome(events, **last)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "prctl"), reason="Linux: gives up root's right to write")
def test_read_only_cache_is_used_without_compiling(sample: Sample) -> None:
    sample.run()
    with read_only(sample.cache):
        loaded = run_unprivileged(sample)
    assert loaded.answer == [6.0, 3.0]
    assert loaded.events == []


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "prctl"), reason="Linux: gives up root's right to write")
def test_empty_read_only_cache_costs_time_not_the_answer(sample: Sample) -> None:
    sample.cache.mkdir()
    with read_only(sample.cache):
        alone = run_unprivileged(sample)
    assert alone.answer == [6.0, 3.0]
    assert alone.count("compiling") == 2
    warnings = [event["detail"] for event in alone.events if event["what"] == "warning"]
    assert warnings
    assert all(str(sample.cache) in sentence and "Permission denied" in sentence for sentence in warnings)


@pytest.mark.parametrize("damage", [b"", b"no kernel at all", None], ids=["empty", "foreign", "cut"])
def test_damaged_file_is_replaced(sample: Sample, damage: bytes | None) -> None:
    sample.run()
    for path in sample.cache.glob("*.total-*.kernel"):
        path.write_bytes(path.read_bytes()[:-100] if damage is None else damage)
    repaired = sample.run()
    assert repaired.answer == [6.0, 3.0]
    assert repaired.count("compiling") == 1
    assert any("damaged" in event["detail"] for event in repaired.events if event["what"] == "warning")
    assert sample.run().events == []


@pytest.mark.parametrize("wrong", ["group", "others", "owner"])
def test_a_file_that_others_may_have_written_is_not_run(sample: Sample, wrong: str) -> None:
    sample.run()
    prefix = ""
    for path in sample.cache.glob("*.total-*.kernel"):
        assert path.stat().st_mode & 0o022 == 0
        if wrong == "owner":
            if os.geteuid():  # nobody but root gives files away: then we are somebody else
                prefix = f"import os; os.geteuid = lambda: {os.geteuid() + 1}\n"
            else:
                os.chown(path, 12345, -1)
        else:
            path.chmod(0o664 if wrong == "group" else 0o646)
    distrustful = sample.run(prefix=prefix)
    assert distrustful.answer == [6.0, 3.0]
    assert distrustful.count("compiling") >= 1
    told = [event["detail"] for event in distrustful.events if event["what"] == "warning"]
    assert any(("belongs to user" if wrong == "owner" else "can be written by others") in each for each in told)
    if not prefix:  # what was compiled takes its place
        assert sample.run().events == []


def test_another_processor_has_its_own_files(warmed: tuple[Sample, Outcome]) -> None:
    # GIVEN a cache for any processor, WHEN a process wants this one's own
    sample, _ = warmed
    generic = sample.files()
    native = sample.run(FLEETLOC_CPU="native")
    # THEN it compiles beside, and the files for any processor stay in use
    assert native.answer == [6.0, 3.0]
    assert native.count("compiling") == 2
    assert len(sample.files() - generic) == 2
    assert generic < sample.files()
    assert sample.run().events == []


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the baseline of x86-64 is SSE2")
def test_generic_code_needs_no_extension(sample: Sample) -> None:
    look = """
outer.total(np.ones(3))
(code,) = outer.total.inspect_asm().values()
registers = [line for line in code.splitlines() if "%ymm" in line or "%zmm" in line or "\\tv" in line]
assert "xmm" in code and not registers, registers[:3]
"""
    assert sample.run(look).answer == [6.0, 3.0]


@pytest.mark.parametrize(
    ("choice", "features", "says"),
    [
        ("pentium", {}, "FLEETLOC_CPU='pentium': expected one of generic, x86-64-v2, x86-64-v3, native"),
        ("x86-64-v2", {"sse3": True}, "lacks ssse3, sse4.1, sse4.2, popcnt, cx16; use generic"),
    ],
)
def test_target_that_cannot_be_is_refused(
    monkeypatch: pytest.MonkeyPatch, choice: str, features: dict[str, bool], says: str
) -> None:
    monkeypatch.setattr(llvmlite.binding, "get_host_cpu_features", lambda: features)
    with pytest.raises(compiled.TargetError, match=says.replace("+", r"\+")):
        compiled.select_target(choice)


def test_arguments_and_arithmetic(sample: Sample) -> None:
    child = """
for wrong in (np.ones((2, 2)), np.ones(4)[::2], np.ones(2, np.float32), None):
    try:
        outer.total(wrong)
    except TypeError:
        continue
    raise AssertionError(f"accepted {wrong!r}")
rows = np.zeros(1, outer.ROW)
assert np.isnan(outer.ratio(rows, 0.0)), "divides as numpy does"
assert outer.ratio(rows, 2) == 0.0, "numbers are converted"
assert outer.total.targetoptions["nogil"] and not outer.total.targetoptions["fastmath"]
assert outer.scaled(4.0) == 8.0, "a kernel can be called from Python"
"""
    assert sample.run(child).answer == [6.0, 3.0]


def test_plain_python_for_the_debugger(sample: Sample) -> None:
    plain = sample.run("assert not hasattr(outer.total, 'overloads')", NUMBA_DISABLE_JIT="1")
    assert plain.answer == [6.0, 3.0]
    assert sample.files() == set()


def test_old_files_are_removed(tmp_path: Path) -> None:
    for age in range(9):
        path = tmp_path / f"a.b-0123-{age:04x}.kernel"
        path.touch()
        os.utime(path, (age, age))
    other = tmp_path / "a.c-0123-0000.kernel"
    other.touch()
    kernel_cache._remove_old(path)
    kept = {f"a.b-0123-{age:04x}.kernel" for age in range(9 - kernel_cache.KEPT_PER_KERNEL, 9)}
    assert {left.name for left in tmp_path.iterdir()} == kept | {other.name}


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEETLOC_CACHE", "/srv/kernels")
    assert kernel_cache.cache_folder() == Path("/srv/kernels")
    monkeypatch.delenv("FLEETLOC_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/var/cache/user")
    assert kernel_cache.cache_folder() == Path("/var/cache/user/fleetloc")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/pilot")
    assert kernel_cache.cache_folder() == Path("/home/pilot/.cache/fleetloc")


def test_import_all_knows_the_entries_of_every_floor() -> None:
    # GIVEN the modules whose sources declare an entry
    floors = ROOT / "estimators"
    sources = {path.relative_to(ROOT): path.read_text() for path in floors.rglob("*.py")}
    declaring = {
        ".".join(path.with_suffix("").parts) for path, text in sources.items() if "\n@entry(" in text
    }
    assert len({name.split(".")[1] for name in declaring}) >= 5  # they lie on many floors
    # WHEN everything is imported
    compiled.import_all()
    # THEN something is known of each
    assert declaring <= {name.rpartition(".")[0] for name in compiled.entries()}
