"""What really happened, for the report only: recording, reading, and the state at any instant of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.world.quaternions import Array

Indices = NDArray[np.intp]

ARRAYS = ("time_unix_s", "agents", "position_m", "velocity_mps", "pairs", "pair_bias_m")


class TruthError(ValueError):
    """A truth file or time that cannot be used; the message says what was expected."""


@dataclass(frozen=True, slots=True)
class Truth:
    """Sampled truth of a fleet, NED metres and m/s.

    ``time_unix_s`` ``(K,)`` rising, ``agents`` ids, those of targets behind those of drones, ``position_m`` and
    ``velocity_mps`` ``(K, n, 3)``, ``pairs`` ``(m, 2)`` ids with the bias of their ranges ``pair_bias_m`` ``(m,)``.
    """

    time_unix_s: Array
    agents: tuple[int, ...]
    position_m: Array
    velocity_mps: Array
    pairs: Array
    pair_bias_m: Array

    def at(self, time_unix_s: ArrayLike) -> Array:
        """States ``(..., n, 6)`` at Unix times inside the record, by cubic Hermite interpolation.

        Raises `TruthError` for a time outside the record (before its first or after its last sample).
        """
        wanted = np.atleast_1d(np.asarray(time_unix_s, float))
        first, last = float(self.time_unix_s[0]), float(self.time_unix_s[-1])
        if not ((wanted >= first) & (wanted <= last)).all():
            raise TruthError(
                f"truth: expected times in [{first:.3f}, {last:.3f}], "
                f"found [{float(np.min(wanted)):.3f}, {float(np.max(wanted)):.3f}]"
            )
        right = np.clip(np.searchsorted(self.time_unix_s, wanted, side="right"), 1, len(self.time_unix_s) - 1)
        state = self._hermite(right - 1, right, wanted)
        return state if np.ndim(time_unix_s) else state[0]

    def _hermite(self, left: Indices, right: Indices, wanted: Array) -> Array:
        step = (self.time_unix_s[right] - self.time_unix_s[left])[:, None, None]
        s = (wanted - self.time_unix_s[left])[:, None, None] / step
        p0, p1 = self.position_m[left], self.position_m[right]
        m0, m1 = step * self.velocity_mps[left], step * self.velocity_mps[right]
        position = (
            (2 * s**3 - 3 * s**2 + 1) * p0
            + (s**3 - 2 * s**2 + s) * m0
            + (3 * s**2 - 2 * s**3) * p1
            + (s**3 - s**2) * m1
        )
        velocity = (6 * s**2 - 6 * s) * (p0 - p1) + (3 * s**2 - 4 * s + 1) * m0 + (3 * s**2 - 2 * s) * m1
        return np.concatenate((position, velocity / step), axis=-1)

    def save(self, path: Path) -> None:
        """Write an ``.npz``; raises `OSError` if the file cannot be written."""
        with path.open("wb") as file:
            np.savez_compressed(
                file,
                time_unix_s=self.time_unix_s,
                agents=np.array(self.agents, int),
                position_m=self.position_m,
                velocity_mps=self.velocity_mps,
                pairs=self.pairs,
                pair_bias_m=self.pair_bias_m,
            )


def load_truth(path: Path) -> Truth:
    """Read what `Truth.save` wrote; raises `TruthError` naming the file for anything else."""
    try:
        with np.load(path, allow_pickle=False) as file:
            columns = {name: file[name] for name in ARRAYS}
    except (OSError, KeyError, ValueError) as error:
        wanted = ", ".join(ARRAYS)
        raise TruthError(f"{path}: expected a truth record (.npz) with {wanted}: {error}") from error
    count, agents = len(columns["time_unix_s"]), tuple(int(agent) for agent in columns["agents"])
    for name in ("position_m", "velocity_mps"):
        if columns[name].shape != (count, len(agents), 3) or not np.isfinite(columns[name]).all():
            raise TruthError(
                f"{path}: {name}: expected finite values of shape ({count}, {len(agents)}, 3), "
                f"found shape {columns[name].shape}"
            )
    if count < 2 or not (np.diff(columns["time_unix_s"]) > 0.0).all():
        raise TruthError(f"{path}: time_unix_s: expected at least two rising times, found {count}")
    return Truth(agents=agents, **{name: columns[name] for name in ARRAYS if name != "agents"})


class TruthRecorder:
    """Collects samples of a running world."""

    def __init__(self, agents: tuple[int, ...], pair_bias_m: dict[frozenset[int], float]) -> None:
        self._agents = agents
        self._bias = pair_bias_m
        self._time_unix_s: list[float] = []
        self._position_m: list[Array] = []
        self._velocity_mps: list[Array] = []

    def record(self, time_unix_s: float, position_m: Array, velocity_mps: Array) -> None:
        """Keep a copy of one sample, ``(n, 3)`` each."""
        self._time_unix_s.append(time_unix_s)
        self._position_m.append(position_m.copy())
        self._velocity_mps.append(velocity_mps.copy())

    def truth(self) -> Truth:
        """What was collected so far; raises `TruthError` before two samples are there."""
        if len(self._time_unix_s) < 2:
            raise TruthError(f"truth: expected at least two samples, found {len(self._time_unix_s)}")
        pairs = [sorted(pair) for pair in self._bias]
        return Truth(
            np.array(self._time_unix_s),
            self._agents,
            np.stack(self._position_m),
            np.stack(self._velocity_mps),
            np.array(pairs, int).reshape(len(pairs), 2),
            np.array(list(self._bias.values()), float),
        )
