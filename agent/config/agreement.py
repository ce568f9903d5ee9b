"""What all drones of a fleet have to be given alike, or they would misread each other's packets."""

from __future__ import annotations

from collections.abc import Iterable

from agent.config.tables import FleetConfig
from transport.messages.agreement_body import Agreement, agreement_of


def shared_settings(config: FleetConfig) -> Agreement:
    """The settings that have to be the same in every drone's configuration, by key.

    Those that say what numbers in packets mean (frame, time, who is who), and those without which neighbours could
    not use each other's information pairs or records.
    """
    fleet, estimator = config.fleet, config.estimator
    origin = fleet.origin
    tags_m = {a.id: [list(map(float, tag)) for tag in a.uwb_tags_m] for a in config.agents if a.uwb_tags_m}
    edges = None if fleet.edges is None else sorted({(min(pair), max(pair)) for pair in fleet.edges})
    return agreement_of({
        "agents.id": _listed(map(str, sorted(config.ids))),
        "agents.uwb_tags_m": _listed(f"{agent_id}:{tags}" for agent_id, tags in sorted(tags_m.items())),
        "estimator.kind": estimator.kind,
        "estimator.relay_hops": str(estimator.relay_hops),
        "estimator.rounds": str(estimator.rounds),
        "estimator.share_inputs": estimator.share_inputs,
        "estimator.window": str(estimator.window),
        "fleet.edges": "absent" if edges is None else _listed(f"{a}-{b}" for a, b in edges),
        "fleet.epoch_unix_s": repr(float(fleet.epoch_unix_s)),
        "fleet.joint_bodies": str(fleet.joint_bodies),
        "fleet.origin": f"{origin.lat_deg:.9f} {origin.lon_deg:.9f} {origin.alt_m:.3f} {origin.altitude}",
        "fleet.period_s": repr(float(fleet.period_s)),
        "targets.id": _listed(sorted(f"{target.id} {target.motion}" for target in config.targets)),
    })  # fmt: skip


def _listed(texts: Iterable[str]) -> str:
    return " ".join(texts) or "none"
