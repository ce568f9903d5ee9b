"""Bodies that stand and were found while drones had fixes hold the drones when all fixes are gone."""

from __future__ import annotations

import numpy as np

from estimators.estimator import Estimate, Status
from estimators.factory import make_estimator
from estimators.model.layout import BodyKind, Layout, block, position
from estimators.model.measurements import empty_inputs, input_rows, position_rows, range_row
from estimators.settings import EstimatorSettings

PERIOD_S, LAP_S = 0.2, 30.0
DRONES, FIXED_TICKS, BLIND_TICKS = 3, 50, 50
MASTS = np.array([[25.0, 25, -3], [25, -25, -1], [-25, -25, -6], [-25, 25, 0]])


def state(slot: int, tick: int) -> np.ndarray:
    """Drones that circle over the masts at different heights, NED m and m/s."""
    turn = 2.0 * np.pi / LAP_S
    phase = turn * tick * PERIOD_S + 2.1 * slot
    place = [15.0 * np.cos(phase), 15.0 * np.sin(phase) + 3.0 * slot, -14.0 - 6.0 * slot]
    return np.array([*place, -15.0 * turn * np.sin(phase), 15.0 * turn * np.cos(phase), 0.0])


def fly(kind: BodyKind) -> list[Estimate]:
    """The estimates of drone 1, of a fleet that ranges four bodies of a kind and loses all fixes on the way."""
    rng = np.random.default_rng(6)
    bodies = (1, 2, 3, 11, 12, 13, 14)
    layout = Layout.of(bodies, dict.fromkeys(bodies[DRONES:], kind))
    mean = np.concatenate([*(state(slot, 0) for slot in range(DRONES)), *([*mast, 0, 0, 0] for mast in MASTS)])
    covariance = np.diag([0.01] * (6 * DRONES) + ([9.0] * 3 + [1e-7] * 3) * len(MASTS))
    start = mean + np.sqrt(covariance.diagonal()) * rng.normal(size=len(mean))
    settings = EstimatorSettings(kind="dmhe_shared", window=5, rounds=0, systematic_errors=True)
    estimator = make_estimator(settings, layout, 0, start, covariance, PERIOD_S)
    found = []
    for tick in range(FIXED_TICKS + BLIND_TICKS):
        at = np.array([state(slot, tick) for slot in range(DRONES)])
        tables, push = [], []
        for slot in range(DRONES):
            if tick < FIXED_TICKS:
                tables.append(position_rows(tick, slot, at[slot, :3] + 0.1 * rng.normal(size=3), [0.01] * 3))
            others = np.concatenate((at[slot + 1 :, :3], MASTS))
            for other, place in zip(range(slot + 1, len(bodies)), others, strict=True):
                away = float(np.linalg.norm(at[slot, :3] - place)) + 0.1 * float(rng.normal())
                tables.append(range_row(tick, slot, other, away, 0.01))
            accel = (at[slot, 3:] - state(slot, tick - 1)[3:]) / PERIOD_S + 0.05 * rng.normal(size=3)
            push.append(input_rows(tick - 1, slot, accel, 0.0025))
        estimator.begin(tick, np.concatenate(tables), np.concatenate(push) if tick else empty_inputs())
        found.append(estimator.solve())
    return found


def test_drones_without_fixes_know_where_they_are_by_masts_that_they_have_surveyed() -> None:
    found = fly(BodyKind.ANCHOR)
    # WHEN the fixes have been gone for some seconds THEN the drone knows where it is, and says so
    blind = found[FIXED_TICKS:]
    assert [each.status for each in blind] == [Status.OK] * BLIND_TICKS
    errors = np.array([each.mean[position(0)] - state(0, FIXED_TICKS + k)[:3] for k, each in enumerate(blind)])
    sigmas = np.array([np.sqrt(each.covariance.diagonal()[position(0)]) for each in blind])
    assert np.linalg.norm(errors, axis=1).max() < 0.4
    assert sigmas.max() < 0.5
    assert (np.abs(errors) < 4.0 * sigmas).all()
    # and the masts are where they were found
    for slot, mast in enumerate(MASTS, start=DRONES):
        off = found[-1].mean[position(slot)] - mast
        assert np.linalg.norm(off) < 0.6
        assert (np.abs(off) < 4.0 * np.sqrt(found[-1].covariance.diagonal()[position(slot)])).all()


def test_bodies_that_may_move_hold_nobody() -> None:
    # WHEN the same bodies are ones that may drive off with the fleet THEN nothing says where it is
    found = fly(BodyKind.TARGET)
    assert found[FIXED_TICKS - 1].status is Status.OK
    assert {each.status for each in found[-20:]} == {Status.NOT_OBSERVABLE}
    assert np.isfinite(found[-1].covariance[block(0), block(0)]).all()
