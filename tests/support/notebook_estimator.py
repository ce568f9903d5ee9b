"""An estimator that keeps books of its calls, and a core that runs on it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from agent.config.tables import FleetConfig
from agent.core import AgentCore
from agent.sensing.samples import GpsSample
from estimators.estimator import Estimate, Payload, Status
from estimators.model.gaussian import Prior
from estimators.model.layout import Layout
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.settings import EstimatorSettings
from tests.support.onboard import CONNECTED, onboard_of
from transport.messages.header import PacketKind
from transport.messages.measurement_body import Measurements
from transport.security.opening import Received

MakeConfig = Callable[..., FleetConfig]


class Notebook:
    """An estimator that notes its calls and answers with its prior; ``fail`` says what goes wrong when."""

    fixed_members = True

    def __init__(
        self,
        settings: EstimatorSettings,
        layout: Layout,
        slot: int,
        mean: Vector,
        covariance: Matrix,
        period_s: float,
    ) -> None:
        self.layout, self.rounds, self.dropped = layout, settings.rounds, 0
        self.mean, self.covariance = mean, covariance
        self.calls: list[tuple[Any, ...]] = []
        self.tick = 0

    @property
    def prior_tick(self) -> int:
        return self.tick

    fail: Callable[[str, int], None] = staticmethod(lambda call, tick: None)

    def begin(self, tick: int, measurements: RowTable, inputs: InputTable) -> None:
        self.tick = tick
        self.calls.append(("begin", tick, measurements, inputs))
        self.fail("begin", tick)

    def outgoing(self, round_: int) -> Payload:
        self.fail("outgoing", self.tick)
        return Payload(self.tick, np.linalg.inv(self.covariance), self.mean, 6)

    def mix(self, round_: int, received: Mapping[int, Payload]) -> Collection[int]:
        self.calls.append(("mix", round_, tuple(received)))
        self.mixed = dict(received)
        self.fail("mix", self.tick)
        return ()

    def solve(self, budget: int | None = None) -> Estimate:
        self.fail("solve", self.tick)
        mean = np.full_like(self.mean, np.nan) if self.fail("nan", self.tick) else self.mean
        ages = np.zeros(self.layout.size, np.int64)
        return Estimate(self.tick, mean, self.covariance, Status.OK, ages)

    def change_members(self, agents: Sequence[int], own: int, fresh: Mapping[int, Prior]) -> None:
        raise RuntimeError("the fleet of a notebook is fixed")


def received(sender: int, message: Any, now_s: float = 0.0) -> Received:
    kind = PacketKind.MEAS if isinstance(message, Measurements) else PacketKind.INFO
    return Received(sender, kind, 1, 0, now_s, message)


def fix(t_s: float) -> GpsSample:
    return GpsSample(t_s, (1.0, 2.0, 3.0), 0.3, 0.5, None, 1.0, 0.1, 3)


def lone(make_config: MakeConfig, *overrides: str, count: int = 1) -> tuple[AgentCore, list[Notebook]]:
    """A core with notebooks for estimators, in the order in which they were made."""
    made: list[Notebook] = []

    def factory(*arguments: Any) -> Notebook:
        made.append(Notebook(*arguments))
        return made[-1]

    config = make_config(count, "initial.position_m=[0.0, 0.0, 0.0]", *overrides)
    return onboard_of(config, factory).core, made


def tick_through(core: AgentCore, start_s: float, duration_s: float) -> list[Any]:
    outputs = []
    for step in range(round(duration_s / 0.01)):
        outputs += core.advance(start_s + 0.01 * step, CONNECTED)
    return outputs
