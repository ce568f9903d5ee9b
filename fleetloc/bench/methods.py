"""The estimators that the studies compare."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from estimators.settings import EstimatorSettings, default_settings, present_name
from fleetloc.errors import InputError
from sim_bridge.studies.genie import Genie
from sim_bridge.studies.monte_carlo import Method

FLAGSHIP = "dmhe_shared"
CENTRALISED = "centralized_iekf"
"""The yardstick: all rows and all inputs at once, whatever the links do."""
GENIE = "genie"

UNKNOWN_ACCEL_VARIANCE = 4.0 / 3.0


def default_methods(other_accel_variance: float = UNKNOWN_ACCEL_VARIANCE) -> dict[str, Method]:
    """The estimators of an accuracy study; the variance is the paper's family's, the flagship has its own default."""
    q = other_accel_variance
    return {
        "dmhe_pre_ekf": EstimatorSettings(kind="dmhe_pre_ekf", other_accel_variance=q),
        "dmhe": EstimatorSettings(kind="dmhe", other_accel_variance=q),
        "dekf_ci": EstimatorSettings(kind="dekf_ci", other_accel_variance=q),
        "dekf_ci_shared": EstimatorSettings(kind="dekf_ci", share_inputs="neighbours", other_accel_variance=q),
        "dmhe_pre_ekf_shared": EstimatorSettings(share_inputs="neighbours", other_accel_variance=q),
        FLAGSHIP: default_settings(),
        CENTRALISED: EstimatorSettings(kind="centralized_ekf", iterations_ekf=20),
    }


def methods_with_genie() -> dict[str, Method]:
    """The same with the genie of the flagship's model beside it."""
    methods = default_methods()
    centralised = methods.pop(CENTRALISED)
    return {**methods, GENIE: Genie(default_settings()), CENTRALISED: centralised}


def chosen(methods: Mapping[str, Method], names: str, always: Sequence[str] = ()) -> dict[str, Method]:
    """Those of the comma-separated ``names`` (empty: all), and those that a study needs; raises `InputError`."""
    wanted = [present_name(name.strip()) for name in names.split(",") if name.strip()]
    unknown = [name for name in wanted if name not in methods]
    if unknown:
        raise InputError("--methods", "", f"some of {', '.join(methods)}", ", ".join(unknown))
    return {name: method for name, method in methods.items() if not wanted or name in wanted or name in always}
