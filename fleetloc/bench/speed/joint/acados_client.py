"""acados in another Python: starts `fleetloc.bench.speed.joint.acados_worker` and asks it for window after window."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from estimators.model.measurements import Matrix
from estimators.model.motion import input_matrix, transition_matrix
from fleetloc.bench.speed.joint.windows import Edges, StagedWindow

WORKER = Path(__file__).parent / "acados_worker.py"
LOG_CHARACTERS = 300


class AcadosMissingError(Exception):
    """acados cannot be run; the text says why, in one line."""


@dataclass(frozen=True, slots=True)
class AcadosAnswer:
    """CPU times in s, acados' own status (0: solved), and the states ``(N+1, 6n)``."""

    set_s: float
    solve_s: float
    status: int
    iterations: int
    path: Matrix


class AcadosClient:
    """A compiled solver for windows of one structure; a context that ends the worker.

    ``python`` has acados; ``plan`` is one of the worker's. Raises `AcadosMissingError`.
    """

    def __init__(
        self,
        python: str,
        plan: str,
        windows: Sequence[StagedWindow],
        edges: Edges,
        period_s: float,
        eps: float,
        tolerance: float,
        folder: Path,
    ) -> None:
        agents = len(windows[0].mean) // 6
        problem = folder / "windows.npz"
        arrays: dict[str, Any] = {
            "agents": agents,
            "edges": np.array(edges),
            "eps": eps,
            "tolerance": tolerance,
            "transition": transition_matrix(agents, period_s),
            "push": input_matrix(agents, period_s),
        }
        for name in StagedWindow.__dataclass_fields__:
            arrays[name] = np.array([getattr(window, name) for window in windows])
        np.savez(problem, **arrays)
        self._log = folder / f"{plan}.log"
        with self._log.open("wb") as log:
            try:
                self._worker = subprocess.Popen(
                    [python, str(WORKER), str(problem), str(folder), plan],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    cwd=folder,
                    text=True,
                )
            except OSError as error:
                raise AcadosMissingError(f"acados: {python} cannot be started: {error.strerror}") from error
        self._line()  # it is ready once its solver is compiled

    def __enter__(self) -> AcadosClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._worker.communicate()

    def solve(self, window: int) -> AcadosAnswer:
        """Set and solve a window, by its place."""
        assert self._worker.stdin is not None
        self._worker.stdin.write(f"{window}\n")
        self._worker.stdin.flush()
        answer = self._line()
        return AcadosAnswer(**{**answer, "path": np.array(answer["path"])})

    def _line(self) -> dict[str, Any]:
        assert self._worker.stdout is not None
        line = self._worker.stdout.readline()
        if line:
            return dict(json.loads(line))
        self._worker.communicate()
        said = self._log.read_text(errors="replace").split("\n")
        last = next((text.strip() for text in reversed(said) if text.strip()), "nothing")[:LOG_CHARACTERS]
        raise AcadosMissingError(f"acados: its worker ended with code {self._worker.returncode} and said: {last}")
