"""``fleetloc replay`` of our own flight logs (.mcap with a .tlog beside it): the same run again, tick by tick."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agent.config.documents import Override
from agent.config.reading import load_config
from agent.config.reading import recorded_config as config_in_log
from agent.config.tables import FleetConfig
from agent.log.estimate_mcap import EstimateMcap
from agent.log.flight_reader import FlightReader
from estimators.factory import make_estimator
from fleetloc.errors import InputError
from fleetloc.output import print_table, write_json
from sim_bridge.replay.flight_log_replay import FlightLogReplay, ReplayedTick, recorded_config, replay_flight_log
from sim_bridge.replay.naming import names_apart

RECORDED = "recorded"
"""In place of a configuration: the one that each record was flown with."""
FIGURES = "report.json"


def replay_records(
    config: Path, records: Sequence[Path], overrides: Sequence[Override], folder: Path, json_file: Path | None
) -> bool:
    """Repeat the runs of flight logs and compare every estimate with the recorded one; whether all are equal.

    Writes the estimates made again as ``agent_001.again.mcap`` (``A-agent_001.again.mcap`` where only their folders
    tell records apart) and the comparison as ``report.json``. Another configuration or ``overrides`` (``key=value``)
    answer what would have been estimated with them. Raises `LogFileError`, `ConfigError`, `InputError`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = names_apart(records)
    rows = []
    for record in records:
        used = _config(config, record, overrides)
        agents = used or recorded_config(FlightReader(record).start, record)
        path = folder / f"{names[record].removesuffix(record.suffix).replace('/', '-')}.again.mcap"
        writer = EstimateMcap(path, agents.ids, agents.fleet.period_s, agents.fleet.epoch_unix_s)

        def write(agent_id: int, tick: ReplayedTick, writer: EstimateMcap = writer) -> None:
            if tick.ready is not None:
                writer.write(agent_id, tick.ready, tick.published_s)

        try:
            rows += [_row(result) for result in replay_flight_log([record], used, make_estimator, write)]
        finally:
            writer.close()
    _print(rows)
    for target in (folder / FIGURES, *([json_file] if json_file else [])):
        write_json(target, {"mode": "record", "records": rows})
    return all(row["equal"] for row in rows)


def refuse_mixture(logs: Sequence[Path]) -> None:
    """Flight logs are replayed alone: they hold packets and ranges too. Raises `InputError`."""
    others = [path.name for path in logs if path.suffix != ".mcap"]
    if others:
        raise InputError("logs", "", "flight logs (.mcap) or logs, not both", f"also {', '.join(others)}")


def _config(config: Path, record: Path, overrides: Sequence[Override]) -> FleetConfig | None:
    """``None`` for the configuration in the record as it is."""
    if str(config) != RECORDED:
        return load_config(config, overrides)
    if not overrides:
        return None
    start = FlightReader(record).start
    return config_in_log(start.config, f"{record}: configuration", start.software, overrides)


def _row(result: FlightLogReplay) -> dict[str, Any]:
    return {
        "record": result.path.name,
        "agent": result.agent_id,
        "ended": result.ended,
        "inputs": result.inputs,
        "ticks": result.ticks,
        "compared": result.compared,
        "only_recorded": result.only_recorded,
        "different_in_a_bit": result.different,
        "different_status_or_age": result.contradicted,
        "max_mean_difference": result.max_mean_difference,
        "max_sigma_difference": result.max_sigma_difference,
        "equal": result.equal,
        "counters": result.counters,
    }


def _print(rows: list[dict[str, Any]]) -> None:
    columns = ["record", "agent", "ended", "inputs", "ticks", "compared", "different", "largest difference", "equal"]
    print_table(
        columns,
        [
            [
                row["record"],
                str(row["agent"]),
                row["ended"],
                str(row["inputs"]),
                str(row["ticks"]),
                str(row["compared"]),
                str(row["different_in_a_bit"]),
                f"{max(row['max_mean_difference'], row['max_sigma_difference']):.2g}",
                "yes" if row["equal"] else "no",
            ]
            for row in rows
        ],
        title="estimates made again, against those recorded",
    )
