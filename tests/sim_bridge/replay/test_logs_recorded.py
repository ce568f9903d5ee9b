"""Cuts of recorded flights of real autopilots, against the simulators' truth by an independent route."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.sensing.samples import AttitudeSample, AutopilotEstimate, GpsSample, ImuSample
from sim_bridge.replay.logs.events import LogEvent, LogSource, TruthSample
from sim_bridge.world.quaternions import conjugate, multiply, rotate, to_rotation_vector
from tests.support.logs import LOGS, Truth, load_truth, read

Floats = NDArray[np.float64]
CUTS = {"copter.tlog.gz": "copter", "copter.BIN.gz": "copter", "px4.tlog.gz": "px4", "px4.ulg.gz": "px4"}
GRAVITY_MPS2 = {"copter": 9.7976, "px4": 9.8066}


class Cut:
    """A cut, its events and the truth on its clock."""

    def __init__(self, name: str) -> None:
        self.name = CUTS[name]
        self.truth: Truth = load_truth(self.name)
        if name.endswith(".ulg.gz"):
            pytest.importorskip("pyulog", reason="the extra [ulog] is not installed")
        self.source: LogSource
        self.events: list[LogEvent]
        self.source, self.events = read(LOGS / name, self.truth.frame)
        self.by_unix = self.source.format == "tlog"

    def truth_at(self, times_s: Floats) -> Floats:
        if self.by_unix:
            return self.truth.at(times_s + self.source.survey().unix.unix_s, self.truth.unix_s)
        return self.truth.at(times_s, self.truth.boot_s)

    def of(self, kind: type) -> list[object]:
        return [event.sample for event in self.events if type(event.sample) is kind]


@pytest.fixture(params=CUTS)
def cut(request: pytest.FixtureRequest) -> Cut:
    return Cut(request.param)


def errors(cut: Cut, kind: type, late_s: float = 0.0) -> Floats:
    """Position minus truth, m, of all samples of a kind."""
    samples = cut.of(kind)
    times_s = np.array([sample.t_s for sample in samples]) - late_s  # type: ignore[attr-defined]
    return np.array([sample.position_m for sample in samples]) - cut.truth_at(times_s)[:, :3]  # type: ignore[attr-defined]


def test_everything_was_used(cut: Cut) -> None:
    used = cut.source.counts.used
    assert set(used) == {1}
    pressure = {"baro"} if cut.by_unix else set()  # the cuts of the other formats hold none
    assert set(used[1]) == {"imu", "attitude", "gps", "autopilot estimate", "truth"} | pressure
    assert not {reason for reason in cut.source.counts.skipped if "damaged" in reason or "garbage" in reason}


def test_the_logs_own_truth_is_the_truth(cut: Cut) -> None:
    """To the quantisation of 1 cm, and in a tlog 5 ms of clock at 3 m/s. A .BIN shows home by places, of which the
    simulator's are 3 mm off per metre north of it: 10 m in this cut."""
    bound_m = {"tlog": 0.05, "dataflash": 0.035, "ulog": 0.001}[cut.source.format]
    assert np.abs(errors(cut, TruthSample)).max() < bound_m


def test_fixes_are_near_the_truth_of_their_instant(cut: Cut) -> None:
    """ArduCopter's simulated fixes are of 85 ms before their stamp, to centimetres; PX4's have noise."""
    copter = cut.source.survey().systems[1].flavour == "ardupilot"
    if copter:
        assert np.abs(errors(cut, GpsSample, 0.085)).max() < 0.08
    else:
        assert np.sqrt((errors(cut, GpsSample) ** 2).mean(axis=0)) == pytest.approx([0.2, 0.2, 0.5], abs=0.25)


def test_the_autopilots_estimate_is_in_the_fleets_frame(cut: Cut) -> None:
    assert np.abs(errors(cut, AutopilotEstimate)).max() < 1.5


def attitudes(cut: Cut) -> tuple[Floats, Floats]:
    samples = [sample for sample in cut.of(AttitudeSample) if isinstance(sample, AttitudeSample)]
    return np.array([sample.t_s for sample in samples]), np.array([sample.quaternion for sample in samples])


def test_attitude_turns_body_into_ned(cut: Cut) -> None:
    times_s, quaternions = attitudes(cut)
    true = cut.truth_at(times_s)[:, 6:]
    angles = to_rotation_vector(multiply(conjugate(true / np.linalg.norm(true, axis=1, keepdims=True)), quaternions))
    assert np.degrees(np.linalg.norm(angles, axis=1)).mean() < 4.0


def test_rotated_specific_force_less_gravity_is_the_change_of_velocity(cut: Cut) -> None:
    """GIVEN the whole cut THEN the mean acceleration is that of the true velocity, to the sensor's bias."""
    samples = [sample for sample in cut.of(ImuSample) if isinstance(sample, ImuSample)]
    attitude_s, quaternions = attitudes(cut)
    times_s = np.array([sample.t_s for sample in samples])
    inside = (times_s >= attitude_s[0]) & (times_s <= attitude_s[-1])
    times_s = times_s[inside]
    force = np.array([sample.specific_force_mps2 for sample in samples])[inside]
    signs = np.where((quaternions * quaternions[:1]).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    between = np.stack([np.interp(times_s, attitude_s, axis) for axis in (signs * quaternions).T], axis=1)
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    gravity = np.array((0.0, 0.0, GRAVITY_MPS2[cut.name]))
    accel = rotate(between, force) + gravity
    gained = (0.5 * (accel[1:] + accel[:-1]) * np.diff(times_s)[:, None]).sum(axis=0)
    true = cut.truth_at(times_s[[0, -1]])[:, 3:6]
    mean_error = (gained - (true[1] - true[0])) / (times_s[-1] - times_s[0])
    assert np.abs(mean_error).max() < 0.25


def test_arrival_is_never_before_the_instant(cut: Cut) -> None:
    lateness = np.array([event.arrival_s - event.sample.t_s for event in cut.events])
    assert lateness.min() > -0.006  # the boot clock of a tlog is fitted
    assert np.median(lateness) < 0.02
