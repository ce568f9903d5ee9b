"""Range finders above flat ground: the attitude turns their beam."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.sensing.frames import from_euler
from agent.sensing.ground import SIGMA_FLOOR_M, altitude_of
from agent.sensing.samples import GroundSample
from agent.sensing.timeline import Orientation

STILL = (0.0, 0.0, 0.0)


@given(st.floats(-0.35, 0.35), st.floats(-0.35, 0.35), st.floats(-3.0, 3.0), st.floats(0.5, 40.0))
def test_a_beam_to_flat_ground_tells_the_height_at_any_attitude(
    roll: float, pitch: float, yaw: float, height_m: float
) -> None:
    distance_m = height_m / (math.cos(roll) * math.cos(pitch))
    lies = Orientation(from_euler(roll, pitch, yaw), STILL)
    found = altitude_of(GroundSample(1.0, distance_m, 0.02), lies, 5.0)
    assert not isinstance(found, str)
    assert found[0] == pytest.approx(5.0 + height_m, abs=1e-6)
    assert found[1] >= SIGMA_FLOOR_M


@pytest.mark.parametrize(
    ("lies", "reason"),
    [(None, "attitude unknown"), (Orientation(from_euler(0.6, 0.0, 0.0), STILL), "too much tilt")],
)
def test_without_an_attitude_or_level_flight_there_is_none(lies: Orientation | None, reason: str) -> None:
    assert altitude_of(GroundSample(1.0, 10.0, 0.02), lies, 0.0) == reason
