"""The whole step of ``fleetloc bench speed``: gtsam solves our problem, any estimator takes part, turns are taken."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimators.model.measurements import Kind as RowKind
from estimators.settings import Kind
from fleetloc.bench.speed.fleet.contenders import WholeStep
from fleetloc.bench.speed.fleet.flight import (
    Fleet,
    FleetFlight,
    parse_fleet,
    record_drone,
    record_flight,
    transient_ticks,
)
from fleetloc.bench.speed.fleet.smoothers import INTEGRAL_SIGMA_M, GraphMaker, Smoother, smoothers
from fleetloc.bench.speed.fleet.study import FleetPlan, run_fleets, settings_of, time_flight
from fleetloc.errors import InputError

LINE = Fleet(3, "line")
TIMED = 3
needs_gtsam = pytest.mark.skipif(
    importlib.util.find_spec("gtsam") is None,
    reason="NOT TESTED: gtsam is missing (pip install 'fleetloc[studies]'), no smoother checks our estimate",
)


@pytest.fixture(scope="module")
def flight() -> FleetFlight:
    return record_flight(LINE, TIMED, seed=5)


def states_of_least_cost(flight: FleetFlight, ticks: int) -> Any:
    """All states ``(ticks, n, 2, 3)`` that fit the first ticks best, dense and without anybody's estimator."""
    n, dt = flight.agents, flight.recording.period_s
    prior = flight.prior_mean.reshape(n, 2, 3)
    sigma = np.sqrt(np.diag(flight.recording.P0)).reshape(n, 2, 3)

    def residuals(flat: Any) -> Any:
        x = flat.reshape(ticks, n, 2, 3)
        found = [(x[0] - prior) / sigma]
        for tick in range(ticks):
            for slot in range(n):
                if tick:
                    (accel,), (variance,) = flight.inputs[tick][slot]["accel"], flight.inputs[tick][slot]["variance"]
                    (p, v), (q, w) = x[tick - 1, slot], x[tick, slot]
                    found.append((w - v - dt * accel) / (dt * np.sqrt(variance)))
                    found.append((q - p - dt / 2 * (v + w)) / INTEGRAL_SIGMA_M)
                for row in flight.rows[tick][slot]:
                    p, v = x[tick, row["agent"]]
                    axis = np.array([row["x"], row["y"], row["z"]])
                    if row["kind"] == RowKind.RANGE:
                        predicted = np.linalg.norm(p - x[tick, row["other"], 0])
                    else:
                        predicted = axis @ (p if row["kind"] == RowKind.POSITION else v)
                    found.append((predicted - row["value"]) / np.sqrt(row["variance"]))
        return np.concatenate([np.ravel(part) for part in found])

    assert flight.recording.truth is not None
    start = flight.recording.truth[:ticks].ravel()
    best = least_squares(residuals, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return best.x.reshape(ticks, n, 2, 3)


@needs_gtsam
@pytest.mark.parametrize(("name", "distance"), [("gtsam_batch", 1e-6), ("gtsam_incremental_relinearised", 1e-4)])
def test_gtsam_finds_the_optimum_of_a_small_window(flight: FleetFlight, name: str, distance: float) -> None:
    # GIVEN a smoother whose lag holds the whole of four ticks
    ticks = 4
    (smoother,) = [each for each in smoothers(flight, ticks) if each.name == name]
    # WHEN it went through them
    for tick in range(ticks):
        smoother.prepare(tick)
        smoother.step(tick)
    # THEN all its states are those of the dense least-squares problem
    found = np.array(smoother.path(ticks - 1, ticks)).reshape(ticks, flight.agents, 2, 3)
    assert np.abs(found - states_of_least_cost(flight, ticks)).max() < distance


@needs_gtsam
def test_default_estimator_and_gtsam_have_the_same_estimate() -> None:
    # on a line of three every record arrives within its tick
    (fleet,) = run_fleets(FleetPlan(seed=5, fleets=(LINE,), ticks=TIMED, rounds=1), lambda what: None)
    assert not fleet.missing
    assert fleet.timed_steps >= TIMED
    ours, rival = fleet.steps["dmhe_shared"], fleet.steps["gtsam_incremental"]
    alike = "dmhe_shared without slow errors"
    assert fleet.steps[alike].distance_max < 1e-4
    # what is flown estimates more than the smoothers do
    assert ours.distance_max < 0.1
    assert fleet.steps["gtsam_batch"].distance_max == 0.0
    assert 0.0 < ours.cpu_median_us <= ours.cpu_p99_us
    assert ours.over_ours == 1.0
    assert fleet.over_incremental == {
        name: pytest.approx(fleet.steps[name].cpu_median_us / rival.cpu_median_us) for name in ("dmhe_shared", alike)
    }


@needs_gtsam
def test_gtsam_is_not_given_what_its_factors_do_not_say(flight: FleetFlight) -> None:
    maker = GraphMaker(flight)
    late = flight.rows[1][0].copy()
    late["offset_s"] = 0.02
    turned = flight.rows[1][0].copy()
    turned["x"], turned["y"] = turned["y"].copy(), turned["x"].copy()
    for rows, expected in ((late, "instant"), (turned, "NED axes")):
        flown = FleetFlight(flight.recording, flight.slot, [flight.rows[0], [rows] * flight.agents], flight.inputs)
        maker.flight = flown
        with pytest.raises(ValueError, match=expected):
            maker.tick(1, flight.prior_mean)


@needs_gtsam
def test_covariances_are_those_of_the_newest_states(flight: FleetFlight) -> None:
    covariances: Smoother
    (covariances,) = [each for each in smoothers(flight, 6) if each.covariances]
    covariances.prepare(0)
    mean, found = covariances.step(0)
    assert len(mean) == len(found) == 2 * flight.agents
    position = found[0]
    variance = flight.rows[0][0]["variance"][flight.rows[0][0]["kind"] == RowKind.POSITION]
    prior = np.diag(flight.recording.P0)[:3]
    assert (np.diag(position) <= 1.0 / (1.0 / variance + 1.0 / prior) * (1 + 1e-9)).all()


def test_without_gtsam_ours_are_timed_and_the_table_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec

    def without_gtsam(name: str, package: str | None = None) -> Any:
        return None if name == "gtsam" else find(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", without_gtsam)
    (fleet,) = run_fleets(FleetPlan(seed=5, fleets=(LINE,), ticks=TIMED, rounds=1), lambda what: None)
    assert list(fleet.steps) == ["dmhe_shared", "dmhe_shared without slow errors"]
    assert np.isnan(fleet.steps["dmhe_shared"].distance_max)
    (sentence,) = fleet.missing
    assert "gtsam is not installed" in sentence


@pytest.mark.parametrize("kind", get_args(Kind))
def test_every_kind_of_estimator_goes_through_the_flight(flight: FleetFlight, kind: Kind) -> None:
    settings = settings_of(kind)
    runner = WholeStep(kind, flight, settings, record_drone(flight, settings))
    truth = flight.recording.truth
    assert truth is not None
    paths = []
    for _ in range(2):
        runner.restart()
        answers = [runner.step(tick) for tick in range(flight.ticks)]
        paths.append(np.array([runner.mean(answer) for answer in answers]))
    assert np.array_equal(paths[0], paths[1]), "a restart forgets everything"
    own = slice(6 * flight.slot, 6 * flight.slot + 3)
    error = (paths[0] - truth.reshape(flight.ticks, -1))[transient_ticks() :, own]
    assert np.abs(error).max() < 0.3


def test_relayed_records_are_what_the_fleet_measured(flight: FleetFlight) -> None:
    given = record_drone(flight, settings_of("dmhe_shared"))
    every = np.concatenate([row for tick in flight.rows for row in tick])
    got = np.concatenate([each.rows for each in given])
    assert sorted(got.tolist()) == sorted(every.tolist())
    assert all(len(each.received) == settings_of("dmhe_shared").rounds for each in given)


@dataclass
class Walker:
    """A contender whose steps take a known time on a clock that only they move."""

    name: str
    cost_s: float
    watch: Watch
    prepared: int = -1

    def restart(self) -> None:
        self.prepared = -1
        self.watch.log.append(("restart", self.name, -1))

    def prepare(self, tick: int) -> None:
        self.prepared = tick
        self.watch.now_s += 100.0

    def step(self, tick: int) -> float:
        assert self.prepared == tick
        self.watch.log.append(("step", self.name, tick))
        self.watch.now_s += self.cost_s
        return float(tick)

    def mean(self, answer: float) -> Any:
        self.watch.now_s += 50.0
        return np.full(2, answer)


@dataclass
class Watch:
    now_s: float = 0.0
    log: list[tuple[str, str, int]] = field(default_factory=list)

    def __call__(self) -> float:
        return self.now_s


def test_contenders_take_turns_and_only_their_steps_are_timed() -> None:
    watch = Watch()
    walkers = [Walker("a", 1.0, watch), Walker("b", 2.0, watch)]
    cpu_s, means = time_flight(walkers, 4, 1, 2, np.random.default_rng(0), watch)
    assert cpu_s == {"a": [1.0] * 6, "b": [2.0] * 6}, "two rounds of four ticks, the first of each not timed"
    assert np.array_equal(means["b"][:, 0], np.arange(4.0))
    steps = [(name, tick) for what, name, tick in watch.log if what == "step"]
    for turn in range(0, len(steps), 2):  # both in a tick before the next tick
        assert {name for name, _ in steps[turn : turn + 2]} == {"a", "b"}
        assert steps[turn][1] == steps[turn + 1][1]
    assert len({steps[turn][0] for turn in range(0, len(steps), 2)}) == 2, "the order changes"


def test_fleets_are_named_by_size_and_graph() -> None:
    assert parse_fleet("3") == Fleet(3, "line")
    assert parse_fleet("10") == Fleet(10, "random geometric")
    assert parse_fleet("10ring") == Fleet(10, "ring")
    for wrong in ("2", "ring", "10star", "101", "-3", ""):
        with pytest.raises(InputError, match="--fleets"):
            parse_fleet(wrong)
