"""The command keeps linear algebra to one thread, unless its user says otherwise."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from fleetloc.bench.speed.environment import THREAD_VARIABLES

PROGRAM = """
import os, sys
from fleetloc.__main__ import main
assert "numpy" not in sys.modules
sys.argv = ["fleetloc", "examples"]
assert main() == 0
print(os.environ["OPENBLAS_NUM_THREADS"], os.environ["OMP_NUM_THREADS"])
"""


@pytest.mark.parametrize(("set_by_user", "expected"), [({}, "1 1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3 1")])
def test_one_thread_is_set_before_numpy_is_there(set_by_user: dict[str, str], expected: str) -> None:
    bare = {name: value for name, value in os.environ.items() if name not in THREAD_VARIABLES}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=bare | set_by_user, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[-1] == expected
