"""What sensors say, in SI units and NED, each with its own time on the fleet clock.

Fleet time is seconds of UTC since the configured epoch. Adapters (MAVLink, UWB, logs) make these values;
everything behind them knows neither protocol nor vendor.
"""

from __future__ import annotations

from dataclasses import dataclass

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""Unit quaternion ``(w, x, y, z)`` that rotates body FRD vectors into NED."""


@dataclass(frozen=True, slots=True)
class ImuSample:
    """Specific force in m/s2 (at rest ``(0, 0, -g)``) and turn rate in rad/s, both body FRD."""

    t_s: float
    specific_force_mps2: Triple
    gyro_radps: Triple


@dataclass(frozen=True, slots=True)
class AttitudeSample:
    """Attitude of the body; ``aided``: not without position, when an autopilot takes its own motion for gravity."""

    t_s: float
    quaternion: Quaternion
    aided: bool = True
    receiver_frozen: bool = False
    """Whether a receiver repeats a fix that its own velocity contradicts, by then; such fixes give no samples."""


@dataclass(frozen=True, slots=True)
class LatencyPrior:
    """How much older than its stamp a sample's value is, as far as it is known beforehand.

    ``source`` names autopilot and stamp; what is learned of the latency holds for samples of an equal prior.
    ``sigma_s`` is its 1-sigma, 0 = exactly known.
    """

    source: str
    latency_s: float
    sigma_s: float


NO_LATENCY = LatencyPrior("exact", 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class GpsSample:
    """A fix, with what the receiver says of its own accuracy (1-sigma per axis).

    ``t_s`` is what its stamp says; the value is older by ``latency`` (`agent.latency.gps_prior`).
    ``ground_velocity_mps`` (north, east) or ``speed_mps`` (norm of the velocity), whichever the receiver
    gives; ``fix_type`` as in MAVLink (3 = 3-D). ``receiver`` counts the drone's receivers from 0; ``shift_mps`` says
    how its antenna moves against the body, NED, where ``speed_mps`` is that of the antenna.
    """

    t_s: float
    position_m: Triple
    horizontal_sigma_m: float
    vertical_sigma_m: float
    ground_velocity_mps: tuple[float, float] | None
    speed_mps: float | None
    speed_sigma_mps: float
    fix_type: int
    latency: LatencyPrior = NO_LATENCY
    receiver: int = 0
    shift_mps: Triple = (0.0, 0.0, 0.0)
    speed_may_be_norm: bool = False
    """Whether the length of ``ground_velocity_mps`` may be that of the velocity in all three axes."""


@dataclass(frozen=True, slots=True)
class BaroSample:
    """What a barometer said, as an altitude in m (up) in the standard atmosphere, or above what its user says."""

    t_s: float
    altitude_m: float


@dataclass(frozen=True, slots=True)
class GroundSample:
    """The distance in m along the body's down axis to the ground, 1-sigma in m."""

    t_s: float
    distance_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class VelocitySample:
    """A velocity in m/s of another sensor than the receiver, 1-sigma per axis (inf: not measured).

    ``in_body``: body FRD, else NED.
    """

    t_s: float
    velocity_mps: Triple
    sigma_mps: Triple
    in_body: bool


@dataclass(frozen=True, slots=True)
class FlowSample:
    """How the ground below passes by a camera that looks down: speed over distance, forward and to the right, rad/s.

    The body's turning is taken off; 1-sigma per axis. ``distance_m`` along the camera's axis, ``None``: not told.
    """

    t_s: float
    passing_radps: tuple[float, float]
    sigma_radps: float
    distance_m: float | None


@dataclass(frozen=True, slots=True)
class RangeSample:
    """A range in m from agent ``observer`` to agent ``target``, 1-sigma in m; of which of their antennas."""

    t_s: float
    observer: int
    target: int
    range_m: float
    sigma_m: float
    tag: int = 0
    other_tag: int = 0


@dataclass(frozen=True, slots=True)
class AutopilotEstimate:
    """The autopilot's own estimate about its own origin, NED m and m/s: to compare, never a measurement."""

    t_s: float
    position_m: Triple
    velocity_mps: Triple


Sample = (
    ImuSample
    | AttitudeSample
    | GpsSample
    | BaroSample
    | GroundSample
    | VelocitySample
    | FlowSample
    | RangeSample
    | AutopilotEstimate
)
