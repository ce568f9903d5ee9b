"""Ranges made of the truth of a log: what UWB modules would have measured on that flight, noise and all.

A report on a run with them says so on its face: they show what the fleet could have known, not what it did.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping

import msgspec
import numpy as np

from agent.sensing.frames import interpolated, rotated
from agent.sensing.samples import Triple
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.logs.events import TruthSample
from sim_bridge.replay.side_files.range_files import RangeLine

MAX_GAP_S = 0.5
"""Between samples of truth further apart nobody knows where a drone was."""
MAX_CATCH_UP_S = 5.0
"""After a longer break the ranges begin anew instead of being made up for."""
OPTION = "--ranges synthetic"


class SyntheticNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The modules: white noise, regular cycles, losses. Each agent ranges each neighbour once per cycle.

    Agents take turns within a cycle; the two directions of a pair are measurements of their own.
    """

    sigma_m: float = 0.1
    """White, 1-sigma, also what the module says of itself."""
    rate_hz: float = 10.0
    dropout: float = 0.0
    """Probability that a range fails."""
    max_range_m: float = 200.0
    bias_m: float = 0.0
    """Half width of a constant per pair (antenna delays), uniform."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("sigma_m", 1e-4, 100.0), ("rate_hz", 0.1, 200.0), ("dropout", 0.0, 1.0), ("max_range_m", 0.1, 2000.0),
            ("bias_m", 0.0, 10.0),
        ):  # fmt: skip
            value = getattr(self, name)
            if not low <= value <= high:
                raise ReplayError(f"{OPTION}: {name}", f"{low:g}..{high:g}", f"{value:g}")

    @classmethod
    def parsed(cls, text: str) -> SyntheticNoise:
        """``sigma_m=0.1,rate_hz=10,dropout=0.05``; raises `ReplayError` naming what is wrong."""
        values: dict[str, float] = {}
        for item in filter(None, text.split(",")):
            name, _, value = item.partition("=")
            try:
                values[name.strip()] = float(value)
            except ValueError as error:
                raise ReplayError(f"{OPTION}: {name}", "NAME=NUMBER", repr(item)) from error
        try:
            return cls(**values)
        except TypeError as error:
            names = ", ".join(cls.__struct_fields__)
            raise ReplayError(OPTION, f"settings out of {names}", repr(text)) from error

    def described(self) -> str:
        """The model in one line, for the report."""
        bias = f", pair biases within {self.bias_m:g} m" if self.bias_m else ""
        return (
            f"white noise of {self.sigma_m:g} m (1-sigma), {self.rate_hz:g} Hz per directed pair, "
            f"{100 * self.dropout:g} % lost, up to {self.max_range_m:g} m{bias}"
        )


class Synthesiser:
    """Ranges out of truth samples as they come; ``neighbours`` says who ranges whom.

    ``made`` counts ranges by what became of them. One generator per directed pair: another drone more changes
    nothing for the others.
    """

    def __init__(
        self,
        neighbours: Mapping[int, tuple[int, ...]],
        noise: SyntheticNoise,
        seed: int,
        arms_m: Mapping[int, Triple] | None = None,
    ) -> None:
        """``arms_m``: where the modules' antennas are in body axes, by agent; others are at the body."""
        self._arms = {agent: arm for agent, arm in (arms_m or {}).items() if any(arm)}
        self._neighbours = dict(neighbours)
        self._noise = noise
        self._tracks: dict[int, list[TruthSample]] = {}
        pairs = [(a, b) for a, others in neighbours.items() for b in others]
        self._rngs = {pair: np.random.default_rng([seed, *pair]) for pair in pairs}
        self._bias_m = {
            (min(pair), max(pair)): noise.bias_m
            * float(np.random.default_rng([seed, 0, min(pair), max(pair)]).uniform(-1.0, 1.0))
            for pair in pairs
        }
        self._next: list[int] | None = None
        """Number of the next cycle of each observer."""
        self.made: Counter[str] = Counter()

    def on_truth(self, agent_id: int, sample: TruthSample) -> Iterator[RangeLine]:
        """Note where an agent was; gives the ranges of which both ends are known now, in order of time."""
        if agent_id not in self._neighbours or not sample.has_height:
            return iter(())
        if agent_id in self._arms and sample.quaternion is None:
            self.made["no attitude"] += 1
            return iter(())
        track = self._tracks.setdefault(agent_id, [])
        if track and sample.t_s <= track[-1].t_s:
            return iter(())
        track.append(sample)
        del track[:-64]
        return self._due()

    def _due(self) -> Iterator[RangeLine]:
        """All measurements up to the instant that every track reaches."""
        if len(self._tracks) < 2:
            return
        heads = {agent: track[-1].t_s for agent, track in self._tracks.items()}
        latest_s = max(heads.values())
        # a track that ended holds up nobody
        until_s = min(head_s for head_s in heads.values() if latest_s - head_s <= 2 * MAX_GAP_S)
        rate_hz, count = self._noise.rate_hz, len(self._neighbours)
        if self._next is None:
            self._next = [math.ceil(until_s * rate_hz)] * count
        lines: list[RangeLine] = []
        for slot, observer in enumerate(self._neighbours):
            phase_s = slot / count / rate_hz
            last = math.floor((until_s - phase_s) * rate_hz)
            first = max(self._next[slot], last - math.ceil(MAX_CATCH_UP_S * rate_hz))
            for cycle in range(first, last + 1):
                lines += self._measure_all(observer, cycle / rate_hz + phase_s)
            self._next[slot] = max(self._next[slot], last + 1)
        yield from sorted(lines, key=lambda line: line.time_s)

    def _measure_all(self, observer: int, t_s: float) -> Iterator[RangeLine]:
        here = self._position(observer, t_s)
        for target in self._neighbours[observer]:
            there = self._position(target, t_s)
            if here is None or there is None:
                self.made["no truth"] += 1
                continue
            yield from self._measure(observer, target, t_s, math.dist(here, there))

    def _measure(self, observer: int, target: int, t_s: float, true_m: float) -> Iterator[RangeLine]:
        noise, rng = self._noise, self._rngs[observer, target]
        lost, white = float(rng.random()), noise.sigma_m * float(rng.standard_normal())
        if true_m > noise.max_range_m:
            self.made["too far"] += 1
        elif lost < noise.dropout:
            self.made["lost"] += 1
        else:
            self.made["measured"] += 1
            bias_m = self._bias_m[min(observer, target), max(observer, target)]
            yield RangeLine(t_s, observer, target, max(true_m + bias_m + white, 0.01), noise.sigma_m)

    def _position(self, agent_id: int, t_s: float) -> Triple | None:
        """Where an agent was, linear between samples 20 to 100 ms apart; ``None`` if that is not known."""
        track = self._tracks.get(agent_id, [])
        for before, after in zip(reversed(track[:-1]), reversed(track), strict=False):
            if before.t_s <= t_s <= after.t_s:
                if after.t_s - before.t_s > MAX_GAP_S:
                    return None
                share = (t_s - before.t_s) / (after.t_s - before.t_s)
                return self._at_antenna(agent_id, before, after, share)
        return None

    def _at_antenna(self, agent_id: int, before: TruthSample, after: TruthSample, share: float) -> Triple:
        """Where the antenna of an agent's module was between two samples."""
        place, arm = _between(before, after, share), self._arms.get(agent_id)
        if arm is None or before.quaternion is None or after.quaternion is None:
            return place
        north, east, down = rotated(interpolated(before.quaternion, after.quaternion, share), arm)
        return place[0] + north, place[1] + east, place[2] + down


def _between(before: TruthSample, after: TruthSample, share: float) -> Triple:
    """Cubic Hermite where velocities are known: 4 m/s2 over 0.1 s would be 5 mm off the straight line."""
    step_s = after.t_s - before.t_s
    a, b = before.position_m, after.position_m
    if before.velocity_mps is None or after.velocity_mps is None:
        x, y, z = (p + share * (q - p) for p, q in zip(a, b, strict=True))
        return x, y, z
    s = share
    x, y, z = (
        (2 * s**3 - 3 * s**2 + 1) * p
        + (s**3 - 2 * s**2 + s) * step_s * v
        + (3 * s**2 - 2 * s**3) * q
        + (s**3 - s**2) * step_s * w
        for p, q, v, w in zip(a, b, before.velocity_mps, after.velocity_mps, strict=True)
    )
    return x, y, z
