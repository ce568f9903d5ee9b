"""A fleet in virtual time with the files of a live run."""

from __future__ import annotations

import gc
from pathlib import Path

from agent.config.tables import FleetConfig
from agent.log.estimate_log import EstimateLogWriter, header_of
from agent.log.run_logs import ESTIMATES_MB, MB
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from fleetloc.output import progress_bar
from fleetloc.run import run_files
from fleetloc.run.fleet_run import RunOutcome
from sim_bridge.virtual.fleet_lockstep import FleetLockstep
from sim_bridge.world.sim_table import sim_table
from transport.messages.report_body import Diagnostics


def fly_in_lockstep(config: FleetConfig, directory: Path) -> RunOutcome:
    """Fly the scenario and write truth and records; there is no computing time in virtual time, it is given as 0."""
    recorders = {
        agent_id: EstimateLogWriter(
            run_files.record_path(directory, agent_id),
            header_of(config, agent_id),
            int(ESTIMATES_MB * MB),
        )
        for agent_id in config.ids
    }

    def on_estimate(agent: OnboardAgent, ready: EstimateReady) -> None:
        recorders[agent.agent_id].write(ready, ready.ready_s, 0.0)

    run = FleetLockstep(config, make_estimator, on_estimate)
    gc.collect()
    gc.freeze()  # full collections over all modules would take a tenth of the time
    try:
        duration_s = sim_table(config).duration_s
        with progress_bar("simulated seconds", int(duration_s)) as advance:
            report = run.run(duration_s, lambda _time_s: advance())
    finally:
        for recorder in recorders.values():
            recorder.close()
    report.truth.save(directory / run_files.TRUTH)
    lives = {
        agent_id: [Diagnostics(agent_id, "", counters=counters)] for agent_id, counters in report.counters.items()
    }
    return RunOutcome(lives=lives)
