"""A recorded flight of a fleet, and what one drone of it is handed tick by tick.

The flight is that of the windows (`fleetloc.bench.speed.windows`), but every drone measures its velocity instead of
its speed. Records and inputs travel over hops by the model of `sim_bridge.studies.relay`, so that a drone holds what
the fleet measured as late as the hops take. What neighbours send in the consensus rounds depends on the estimator:
`record_drone` runs the whole fleet once and keeps it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimators.estimator import Estimator, Payload
from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import (
    InputTable,
    Kind,
    RowTable,
    Vector,
    empty_inputs,
    empty_rows,
    velocity_rows,
)
from estimators.settings import EstimatorSettings
from fleetloc.bench.speed.windows import (
    MEAN_DEGREE,
    TICKS_BETWEEN_WINDOWS,
    TRANSIENT_TICKS,
    Graph,
    Size,
    study_recording,
)
from fleetloc.errors import InputError
from sim_bridge.studies.lockstep import Links, neighbours, own_input, own_rows
from sim_bridge.studies.relay import MeasurementRelay
from sim_bridge.studies.study_input import StudyInput


@dataclass(frozen=True, slots=True)
class Fleet:
    """Number of drones and the kind of graph along which they hear and range each other."""

    agents: int
    graph: Graph

    @property
    def label(self) -> str:
        """Both in words."""
        return f"n={self.agents} ({self.graph})"


DEFAULT_FLEETS = (Fleet(3, "line"), Fleet(10, "random geometric"), Fleet(10, "ring"))
SMALLEST_FLEET, LARGEST_FLEET = 3, 100


def parse_fleet(text: str) -> Fleet:
    """``"10"``: ten drones, a random geometric graph (a line of three, a ring of five); ``"10ring"``: a ring of ten.

    Raises `InputError`.
    """
    graph: Graph | None = "ring" if text.endswith("ring") else "line" if text.endswith("line") else None
    digits = text if graph is None else text[:-4]
    if not (digits.isdecimal() and SMALLEST_FLEET <= int(digits) <= LARGEST_FLEET):
        expected = f"{SMALLEST_FLEET} to {LARGEST_FLEET} drones, with or without line or ring, such as 10ring"
        raise InputError("--fleets", "", expected, repr(text))
    agents = int(digits)
    return Fleet(agents, Size(agents, 1).graph if graph is None else graph)


@dataclass(frozen=True, slots=True)
class FleetFlight:
    """What the fleet measured.

    ``rows[k][slot]`` and ``inputs[k][slot]`` are a drone's own of tick k, positions and velocities along the NED axes
    in threes; the input is the acceleration over the tick that ends at k. ``slot`` is the drone that is timed.
    """

    recording: StudyInput
    slot: int
    rows: list[list[RowTable]]
    inputs: list[list[InputTable]]

    @property
    def prior_mean(self) -> Vector:
        """What the timed drone believes of the fleet at the first tick ``(6n,)``, NED m and m/s."""
        return np.asarray(self.recording.x0[self.slot], np.float64)

    @property
    def agents(self) -> int:
        """Number of drones n."""
        return len(self.recording.agents)

    @property
    def ticks(self) -> int:
        """Number of ticks; the first is 0."""
        return len(self.rows)


@dataclass(frozen=True, slots=True)
class DroneTick:
    """What an estimator is given in one tick: what arrived since the last, and the pairs of each consensus round."""

    rows: RowTable
    inputs: InputTable
    received: list[Mapping[int, Payload]]


def record_flight(fleet: Fleet, timed_ticks: int, seed: int) -> FleetFlight:
    """Fly a fleet for the transient and at least ``timed_ticks`` more; repeatable.

    The timed drone is the one whose number of neighbours is nearest to `MEAN_DEGREE`.
    """
    # the horizon is part of the seed and of nothing else
    agents, size = fleet.agents, Size(fleet.agents, 1)
    recording = study_recording(size, 1 + -(-timed_ticks // TICKS_BETWEEN_WINDOWS), seed, fleet.graph)
    rng = np.random.default_rng([seed, agents, 11])
    adjacent = neighbours(recording)
    ticks = range(recording.ticks + 1)
    return FleetFlight(
        recording=recording,
        slot=min(range(agents), key=lambda slot: abs(len(adjacent[slot]) - MEAN_DEGREE)),
        rows=[[_own_rows(recording, tick, slot, rng) for slot in range(agents)] for tick in ticks],
        inputs=[[own_input(recording, tick, slot) for slot in range(agents)] for tick in ticks],
    )


def _own_rows(recording: StudyInput, tick: int, slot: int, rng: np.random.Generator) -> RowTable:
    """Position, velocity and ranges of one drone and tick."""
    assert recording.truth is not None
    rows = own_rows(recording, tick, slot)
    bound = float(recording.gps_half_width[3])
    measured = recording.truth[tick, slot, 3:] + rng.uniform(-bound, bound, 3)
    velocity = velocity_rows(tick, slot, measured, np.full(3, bound**2 / 3), half_width_mps=bound)
    return np.concatenate([rows[rows["kind"] != Kind.SPEED], velocity])


def record_drone(flight: FleetFlight, settings: EstimatorSettings) -> list[DroneTick]:
    """Run one estimator per drone over the flight and keep what the timed one was given.

    Packets are cut as with a speed in place of each velocity (16 bytes less a tick).
    """
    recording = flight.recording
    fleet = [estimator_of(flight, settings, slot) for slot in range(flight.agents)]
    links, relay = Links(recording), MeasurementRelay(recording, settings)
    reach = {"none": 0, "neighbours": 1, "fleet": flight.agents}[settings.share_inputs]
    kept = []
    for tick in range(flight.ticks):
        arrivals = relay.exchange(tick)
        for slot, estimator in enumerate(fleet):
            rows = [flight.rows[each.tick][each.slot] for each in arrivals[slot]]
            inputs = [flight.inputs[each.tick][each.slot] for each in arrivals[slot] if each.hops <= reach]
            given = np.concatenate([empty_rows(), *rows]), np.concatenate([empty_inputs(), *inputs])
            estimator.begin(tick, *given)
            if slot == flight.slot:
                kept.append(DroneTick(*given, []))
        for round_ in range(fleet[0].rounds):
            sent = [estimator.outgoing(round_) for estimator in fleet]
            for slot, estimator in enumerate(fleet):
                received = {sender: sent[sender] for sender in links.heard(tick, slot)}
                estimator.mix(round_, received)
                if slot == flight.slot:
                    kept[-1].received.append(received)
        for estimator in fleet:
            estimator.solve()
    return kept


def estimator_of(flight: FleetFlight, settings: EstimatorSettings, slot: int) -> Estimator:
    """A fresh estimator of one drone; all begin with what the timed drone believes."""
    recording = flight.recording
    layout = Layout(tuple(int(agent) for agent in recording.agents))
    return make_estimator(settings, layout, slot, flight.prior_mean, recording.P0, recording.period_s)


def transient_ticks() -> int:
    """Ticks at the start of a flight that are not timed."""
    return TRANSIENT_TICKS
