"""Fu, Bi and Gao's estimators, corrected: the frozen cases, and what must hold of each by itself."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimators.algorithms.lossy_fusion import (
    AgeCompensation,
    CentralFilter,
    LeaderFusion,
    LocalFilter,
    Rule,
    SentEstimate,
    StampedFilter,
    TargetModel,
    combine,
    second_moment,
)

CASES = Path(__file__).parents[2] / "data" / "lossy"
"""Of an independent implementation; tests/data/lossy/README.md says what is in them."""
MODEL = TargetModel(1.0, 5.0, 10.0)
START, COVARIANCE = np.array([100.0, 100.0, 100.0, 10.0, 10.0, 0.0]), np.diag([100.0] * 3 + [5.0] * 3)
ON_TIME, LATE = np.array([1.0, 0.4]), np.array([0.0, 0.3])
Floats = NDArray[np.float64]


def case(name: str) -> dict[str, Floats]:
    with np.load(CASES / f"{name}.npz") as arrays:
        return dict(arrays)


def model_of(frozen: dict[str, Floats]) -> TargetModel:
    return TargetModel(float(frozen["T"]), float(frozen["q"]), float(frozen["r"]))


def moment_by_enumeration(moment: Floats, measured: Floats, on_time: Floats, late: Floats) -> Floats:
    """E[dH q dH'] over every outcome of every agent's channel."""
    rows, states = measured.shape
    width = rows // len(on_time)
    total = np.zeros((rows, rows))
    held = 1 - on_time - late

    def arrival(now: Floats, then: Floats) -> Floats:
        a, b = np.diag(np.repeat(now, width)), np.diag(np.repeat(then, width))
        return np.hstack([a @ measured, b, np.eye(rows) - a - b])

    mean = arrival(on_time, late)
    for outcome in itertools.product((0, 1, 2), repeat=len(on_time)):
        kinds = np.array(outcome)
        chance = np.prod(np.choose(kinds, [held, on_time, late]))
        difference = arrival((kinds == 1).astype(float), (kinds == 2).astype(float)) - mean
        total += chance * difference @ moment @ difference.T
    assert states == 6
    return total


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
@settings(max_examples=30, deadline=None)
def test_the_second_moment_is_that_of_all_outcomes(seed: int, agents: int) -> None:
    rng = np.random.default_rng(seed)
    shares = rng.dirichlet(np.ones(3), agents)
    root = rng.normal(size=(6 + 6 * agents, 6 + 6 * agents))
    measured = np.tile(MODEL.measured, (agents, 1))
    arguments = (root @ root.T, measured, shares[:, 0], shares[:, 1])
    np.testing.assert_allclose(second_moment(*arguments), moment_by_enumeration(*arguments), rtol=1e-11, atol=1e-11)


def test_the_frozen_second_moment() -> None:
    frozen = case("fu_second_moment")
    ours = second_moment(frozen["q"], frozen["H"], frozen["a1"], frozen["a2"])
    np.testing.assert_allclose(ours, frozen["D"], rtol=float(frozen["rtol"]))


def test_the_frozen_central_filter() -> None:
    frozen = case("fu_central_conditional")
    central = CentralFilter(model_of(frozen), frozen["a1"], frozen["a2"], frozen["x0"], frozen["P0"])
    for k, received in enumerate(frozen["Y"]):
        mean, covariance = central.step(received)
        np.testing.assert_allclose(mean, frozen["xhat"][k], rtol=1e-11)
        np.testing.assert_allclose(covariance, frozen["P"][k], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize(("rule", "name"), [(Rule.TRACE, "tr"), (Rule.SAFE, "safe"), (Rule.INTERSECTION, "ci")])
def test_the_frozen_distributed_scheme(rule: Rule, name: str, feedback: bool) -> None:
    """Where both covariances are equal any weight of an intersection is as good: there only its covariance counts."""
    frozen = case("fu_distributed_age")
    model, expected = model_of(frozen), (frozen[f"x_{name}_fb{int(feedback)}"], frozen[f"P_{name}_fb{int(feedback)}"])
    leader = LeaderFusion(model, frozen["x0"], frozen["P0"], rule, feedback=feedback)
    follower = LocalFilter(model, frozen["x0"], frozen["P0"])
    sent: list[SentEstimate] = []
    compared = 0
    for k, (measured, outcome) in enumerate(zip(frozen["Z"], frozen["XI"][:, 1], strict=True)):
        sent.append(SentEstimate(k, *follower.step(measured[1])))
        packet = {1: sent[k], 2: sent[k - 1] if k else None, 0: None}[int(outcome)]
        mean, covariance = leader.step(measured[0], packet)
        np.testing.assert_allclose(covariance, expected[1][k], rtol=1e-9, atol=1e-9)
        tie = rule is Rule.INTERSECTION and outcome == 1
        if not tie:
            np.testing.assert_allclose(mean, expected[0][k], rtol=1e-9)
            compared += 1
        if feedback and rule is Rule.INTERSECTION:
            leader.own.mean = expected[0][k]  # on from the reference's choice at a tie
    assert compared > 20


def test_what_is_held_is_known_exactly() -> None:
    """GIVEN the predictor WHEN y came THEN the last block of the next X is that y, without doubt."""
    rng = np.random.default_rng(1)
    for conditional in (False, True):
        central = CentralFilter(MODEL, ON_TIME, LATE, START, COVARIANCE, conditional=conditional)
        for _ in range(5):
            received = START[:3] + rng.normal(0.0, 10.0, (2, 3))
            central.step(received)
            np.testing.assert_allclose(central.predicted[-6:], received.ravel(), rtol=1e-12)
            np.testing.assert_allclose(central.predicted_covariance[-6:], 0.0, atol=1e-7)


def test_the_central_filter_does_not_depend_on_the_origin() -> None:
    rng = np.random.default_rng(2)
    shift = np.array([100.0, -50.0, 30.0])
    here = CentralFilter(MODEL, ON_TIME, LATE, START, COVARIANCE, conditional=False)
    there = CentralFilter(
        MODEL, ON_TIME, LATE, START + np.concatenate([shift, np.zeros(3)]), COVARIANCE, conditional=False
    )
    for k in range(10):
        received = START[:3] + 10.0 * k + rng.normal(0.0, 3.0, (2, 3))
        mean, covariance = here.step(received)
        moved, moved_covariance = there.step(received + shift)
        np.testing.assert_allclose(moved[:3] - shift, mean[:3], atol=1e-10)
        np.testing.assert_allclose(moved[3:], mean[3:], atol=1e-10)
        np.testing.assert_allclose(moved_covariance, covariance, rtol=1e-10, atol=1e-10)


def test_without_loss_all_are_the_kalman_filter() -> None:
    rng = np.random.default_rng(3)
    always, never = np.ones(1), np.zeros(1)
    central = CentralFilter(MODEL, always, never, START, COVARIANCE)
    stamped, local = StampedFilter(MODEL, 1, START, COVARIANCE), LocalFilter(MODEL, START, COVARIANCE)
    before = np.zeros((1, 3))
    for _ in range(10):
        measured = START[:3] + rng.normal(0.0, 10.0, (1, 3))
        mean, covariance = local.step(measured[0])
        for other, spread in (central.step(measured), stamped.step(measured, before, [1])):
            np.testing.assert_allclose(other, mean, rtol=1e-12)
            np.testing.assert_allclose(spread, covariance, rtol=1e-9, atol=1e-9)
        before = measured


def test_a_stamped_measurement_one_step_late_counts_as_if_it_had_been_on_time() -> None:
    """GIVEN a late measurement WHEN it is put where it belongs THEN the estimate is that of the whole sequence."""
    rng = np.random.default_rng(4)
    measured = START[:3] + rng.normal(0.0, 10.0, (2, 1, 3))
    late = StampedFilter(MODEL, 1, START, COVARIANCE)
    late.step(measured[0], measured[0], [0])
    mean, covariance = late.step(measured[1], measured[0], [2])
    on_time = LocalFilter(MODEL, START, COVARIANCE)
    on_time.step(measured[0, 0])
    expected = MODEL.predict(on_time.mean, on_time.covariance)
    np.testing.assert_allclose(mean, expected[0], rtol=1e-12)
    np.testing.assert_allclose(covariance, expected[1], rtol=1e-12, atol=1e-12)
    again, _ = late.step(measured[1], measured[1], [2])
    assert np.all(np.isfinite(again))


def test_a_measurement_repeated_late_is_not_used_twice() -> None:
    measured = np.array([[101.0, 99.0, 100.0]])
    twice, once = (StampedFilter(MODEL, 1, START, COVARIANCE) for _ in range(2))
    for stamped in (twice, once):
        stamped.step(measured, measured, [1])
    repeated, expected = twice.step(measured, measured, [2]), once.step(measured, measured, [0])
    np.testing.assert_array_equal(repeated[0], expected[0])
    np.testing.assert_array_equal(repeated[1], expected[1])


def test_an_older_packet_says_nothing_new_and_the_newest_ages() -> None:
    compensation = AgeCompensation(MODEL, START, COVARIANCE)
    newest = SentEstimate(4, START + 1.0, COVARIANCE / 2)
    compensation.take(newest)
    compensation.take(SentEstimate(3, START - 50.0, COVARIANCE / 9))
    mean, covariance = compensation.at(7)
    expected = MODEL.predict(newest.mean, newest.covariance, 3)
    np.testing.assert_array_equal(mean, expected[0])
    np.testing.assert_array_equal(covariance, expected[1])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_a_safe_combination_bounds_any_correlation(seed: int) -> None:
    """GIVEN two estimates with any correlation WHEN combined THEN safe rules claim no less than is true."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(12, 12))
    joint = root @ root.T + 0.1 * np.eye(12)
    P1, P2 = joint[:6, :6], joint[6:, 6:]
    for rule in (Rule.SAFE, Rule.INTERSECTION, Rule.INTERSECTION_GRID):
        # the combination is linear: its gain is found from unit estimates
        gain = np.column_stack([
            combine((unit[:6], P1), (unit[6:], P2), rule)[0] for unit in np.eye(12)
        ])  # fmt: skip
        claimed = combine((np.zeros(6), P1), (np.zeros(6), P2), rule)[1]
        assert np.linalg.eigvalsh(claimed - gain @ joint @ gain.T).min() > -1e-8 * np.trace(claimed)
