"""What takes part in the study of the whole step: one interface, and any of our estimators behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from estimators.estimator import Estimate, Estimator
from estimators.model.measurements import Vector
from estimators.settings import EstimatorSettings
from fleetloc.bench.speed.fleet.flight import DroneTick, FleetFlight, estimator_of


class Contender(Protocol):
    """One way to go through a flight, tick by tick: `prepare` (not timed), then `step` (timed)."""

    name: str

    def restart(self) -> None:
        """Back to the flight's start."""
        ...

    def prepare(self, tick: int) -> None:
        """What the step takes as given."""
        ...

    def step(self, tick: int) -> Any:
        """Everything from the measurements of a tick to its estimate."""
        ...

    def mean(self, answer: Any) -> Vector:
        """The fleet's state ``(6n,)`` in a step's answer, NED m and m/s."""
        ...


@dataclass(slots=True)
class WholeStep:
    """Any kind of `Estimator`, as the agent calls it: begin, rounds of consensus, solve; mean and covariance."""

    name: str
    flight: FleetFlight
    settings: EstimatorSettings
    given: Sequence[DroneTick]
    _estimator: Estimator = field(init=False)

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """A fresh estimator."""
        self._estimator = estimator_of(self.flight, self.settings, self.flight.slot)

    def prepare(self, tick: int) -> None:
        """Nothing: what was received is there."""

    def step(self, tick: int) -> Estimate:
        """One tick of the drone."""
        estimator, given = self._estimator, self.given[tick]
        estimator.begin(tick, given.rows, given.inputs)
        for round_, received in enumerate(given.received):
            estimator.outgoing(round_)
            estimator.mix(round_, received)
        return estimator.solve()

    def mean(self, answer: Estimate) -> Vector:
        """The fleet's state."""
        return answer.mean
