"""Protection levels, and the state that follows from them and from what was found."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.protection.levels import (
    EXCEEDED,
    ProtectionLevel,
    error_ellipse,
    protection_level,
    relative_covariance,
)
from estimators.integrity.protection.statement import (
    ALIKE,
    ONE_OF_FEW,
    AlertLimits,
    IntegrityState,
    judged,
    undetectable,
)
from estimators.integrity.protection.targets import TargetState, target_state
from estimators.integrity.thresholds import DEGRADED_SIGMA_M, TARGET_UNSEEN_S

LIMITS = AlertLimits(4.0, 6.0)
SMALL = ProtectionLevel(1.0, 1.5)


def test_a_round_error_exceeds_its_level_once_in_a_thousand() -> None:
    rng = np.random.default_rng(0)
    level = protection_level(4.0 * np.eye(3), np.zeros(3))
    errors = 2.0 * rng.normal(size=(400_000, 3))
    beyond = np.mean(np.hypot(errors[:, 0], errors[:, 1]) > level.horizontal_m)
    assert 0.85 * EXCEEDED < beyond < 1.15 * EXCEEDED
    assert 0.85 * EXCEEDED < np.mean(np.abs(errors[:, 2]) > level.vertical_m) < 1.15 * EXCEEDED


def test_what_a_receiver_left_out_moves_counts_where_it_is_more() -> None:
    level = protection_level(0.01 * np.eye(3), np.array([3.0, 4.0, -2.0]))
    assert (level.horizontal_m, level.vertical_m) == (5.0, 2.0)
    assert protection_level(9.0 * np.eye(3), np.array([3.0, 4.0, -2.0])).horizontal_m > 5.0


def test_the_ellipse_of_three_sigma() -> None:
    turn = np.array([[np.cos(0.3), -np.sin(0.3), 0.0], [np.sin(0.3), np.cos(0.3), 0.0], [0.0, 0.0, 1.0]])
    ellipse = error_ellipse(turn @ np.diag([4.0, 1.0, 0.25]) @ turn.T)
    assert (ellipse.major_m, ellipse.minor_m, ellipse.up_m) == pytest.approx((6.0, 3.0, 1.5))
    assert np.tan(ellipse.angle_rad) == pytest.approx(np.tan(0.3))


def test_errors_that_two_drones_share_are_not_relative() -> None:
    shared, own = np.eye(12), 0.1 * np.eye(12)
    shared[:6, 6:] = shared[6:, :6] = np.eye(6)
    np.testing.assert_allclose(relative_covariance(shared + own, 0, 1), 0.2 * np.eye(3))


@pytest.mark.parametrize(
    ("findings", "level", "state", "reason"),
    [
        ((), SMALL, IntegrityState.NOMINAL, ""),
        ((Finding(What.LATENCY, Gravity.NOTED),), SMALL, IntegrityState.NOMINAL, ""),
        ((Finding(What.NO_FIX, Gravity.DEGRADED),), SMALL, IntegrityState.DEGRADED, What.NO_FIX),
        ((Finding(What.NO_DATA, Gravity.DEGRADED),), SMALL, IntegrityState.DEAD_RECKONING, What.NO_DATA),
        ((Finding(What.FIXES_CONTRADICT, Gravity.ALARM),), SMALL, IntegrityState.ALERT, What.FIXES_CONTRADICT),
        ((), ProtectionLevel(4.1, 1.0), IntegrityState.ALERT, "horizontal protection level 4.1 m above 4 m"),
        ((), ProtectionLevel(1.0, 6.5), IntegrityState.ALERT, "vertical protection level 6.5 m above 6 m"),
        (
            (Finding(What.NOT_OBSERVABLE, Gravity.ALARM),),
            ProtectionLevel(50.0, 50.0),
            IntegrityState.NOT_OBSERVABLE,
            What.NOT_OBSERVABLE,
        ),
        ((Finding(What.NO_ESTIMATE, Gravity.ABSENT),), SMALL, IntegrityState.NOT_OBSERVABLE, What.NO_ESTIMATE),
    ],
)
def test_the_state_and_what_it_follows_from(
    findings: tuple[Finding, ...], level: ProtectionLevel, state: IntegrityState, reason: What | str
) -> None:
    found, why = judged(findings, level, LIMITS)
    assert found is state
    assert (why.what if isinstance(why, Finding) else why) == reason


def test_what_cannot_be_seen_is_always_said() -> None:
    assert undetectable(5) == (ALIKE,)
    assert undetectable(3) == (ALIKE, ONE_OF_FEW)


@pytest.mark.parametrize(
    ("sigma_m", "unseen_s", "observable", "state"),
    [
        (0.9 * DEGRADED_SIGMA_M, 0.0, True, TargetState.KNOWN),
        (0.9 * DEGRADED_SIGMA_M, 1.1 * TARGET_UNSEEN_S, True, TargetState.UNSEEN),
        (1.1 * DEGRADED_SIGMA_M, 1.1 * TARGET_UNSEEN_S, True, TargetState.POOR),
        (0.1, 0.0, False, TargetState.NOT_OBSERVABLE),
    ],
)
def test_what_is_stated_of_a_target_is_the_worst_that_is_known_of_it(
    sigma_m: float, unseen_s: float, observable: bool, state: TargetState
) -> None:
    assert target_state(sigma_m, unseen_s, observable=observable) is state
