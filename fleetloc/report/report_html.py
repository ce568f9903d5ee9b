"""A run's page: one file, no network, readable in any browser and on paper.

Where the plotting library is missing it has the figures alone, and says so.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from html import escape
from types import ModuleType
from typing import Any

from agent.config.tables import FleetConfig
from fleetloc.extras import is_installed, sentence
from fleetloc.report.fleet_results import FleetResults
from fleetloc.report.style import NO_PLOTS
from fleetloc.report.target_results import COLUMNS as TARGET_COLUMNS
from fleetloc.report.target_results import target_cells
from sim_bridge.world.sim_table import sim_table

CSS = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1b1b1b; background: #fff; max-width: 1100px;
       margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0.2em; } h2 { font-size: 1.15em; margin: 1.8em 0 0.2em; }
p.note { color: #555; margin: 0.2em 0 0.6em; } svg { width: 100%; height: auto; }
table { border-collapse: collapse; font-size: 0.92em; margin: 0.6em 0; }
th, td { padding: 0.25em 0.8em; text-align: right; border-bottom: 1px solid #ddd; }
th { color: #444; vertical-align: bottom; } td { white-space: nowrap; } td.words { white-space: normal; }
th:first-child, td:first-child { text-align: left; } tr.total td { font-weight: 600; border-top: 1px solid #888; }
.warning { background: #fff3d6; padding: 0.5em 0.8em; border-left: 4px solid #e69f00; margin: 0.3em 0; }
"""

PLOTS_LEFT_OUT = "The run was interrupted: the other plots were not waited for. fleetloc report draws them."

COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("ticks on time", lambda row: f"{row['ticks_on_time']} of {row['ticks_expected']}"),
    ("available %", lambda row: _number(row["availability"], 1, 100)),
    ("position RMSE m", lambda row: _number(row["position_rmse_m"], 3)),
    ("after 10 s", lambda row: _number(row["position_rmse_after_10s_m"], 3)),
    ("fleet error rms", lambda row: _number(row["norm_full_rms"], 3)),
    ("ANEES", lambda row: _number(row["anees"], 2)),
    ("tick p50 / p99 ms", lambda row: f"{_ms(row['tick_time_p50_s'])} / {_ms(row['tick_time_p99_s'])}"),
    ("CPU %", lambda row: _number(row["cpu_fraction"], 1, 100)),
    ("memory MB", lambda row: _number(row["rss_mb"], 0)),
)


def page(
    config: FleetConfig, results: FleetResults, figures: dict[str, Any], plots_until_s: float | None = None
) -> str:
    """The whole page of a run; ``figures`` is the content of ``report.json``.

    From ``plots_until_s`` of the monotonic clock on no plot is begun any more: who interrupts a run wants to go on.
    """
    name, fleet = escape(config.fleet.name), figures["fleet"]
    drawn, left_out = [], False
    for title, note, draw in _plots(config, results, figures):
        left_out = plots_until_s is not None and time.monotonic() >= plots_until_s
        if left_out:
            break
        drawn.append(f'<h2>{title}</h2>\n<p class="note">{escape(note)}</p>\n{draw()}')
    if left_out:
        drawn.append(f'<p class="note">{escape(PLOTS_LEFT_OUT)}</p>')
    body = "\n".join(drawn)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{name}</title>\n'
        f"<style>{CSS}</style>\n</head>\n<body>\n<h1>{name}</h1>\n"
        f'<p class="note">{escape(_summary(config, figures))}</p>\n{_warnings(fleet)}'
        f"{_table(figures)}{_targets(figures)}\n{body}\n</body>\n</html>\n"
    )


def _plots(
    config: FleetConfig, results: FleetResults, figures: dict[str, Any]
) -> Iterator[tuple[str, str, Callable[[], str]]]:
    """Title, note and what draws the SVG of each plot; none where the plotting library is missing."""
    if not is_installed("report"):
        return

    yield (
        "Where they were", "Truth pale and wide, each drone's own estimate thin on top; a dot marks the start.",
        lambda: _plots_module().trajectories(config, results),
    )  # fmt: skip
    yield (
        "Position error and its 3-sigma band",
        "Each drone's error of its own position; the shaded band is what it claims. Grey: its GPS is out.",
        lambda: _plots_module().errors(config, results),
    )
    if results.targets:
        yield (
            "Targets", "Error of each target's position as each drone had it; pale: the 3 sigma that it claimed.",
            lambda: _plots_module().targets(results),
        )  # fmt: skip
    yield (
        "Consistency", "Squared error of the whole fleet state in units of its covariance: near 1 is right, above "
        "the band the estimator is overconfident, below it is cautious. Samples of one run are correlated.",
        lambda: _plots_module().consistency(results),
    )  # fmt: skip
    yield (
        "Timing", "A tick's estimate has to be out within one period of the tick's end.",
        lambda: _plots_module().timing(results),
    )  # fmt: skip
    yield (
        "Packets", "On the radio between drones. Lost: missing in the sequence numbers; injected losses included.",
        lambda: _plots_module().packets(figures["agents"]),
    )  # fmt: skip


def _plots_module() -> ModuleType:
    """It takes a second or more to load, which a page without plots does not."""
    from fleetloc.report import report_plots

    return report_plots


def _summary(config: FleetConfig, figures: dict[str, Any]) -> str:
    how = "live, a process per drone"
    if figures["mode"] == "lockstep":
        how = f"in virtual time, {figures['fleet']['times_real_time']:.1f} times faster than real time"
    return (
        f"{counted(len(config.agents), 'drone')}, {figures['duration_s']:.0f} s {how}; {config.estimator.kind}, "
        f"window {config.estimator.window}, {counted(config.estimator.rounds, 'round')}, "
        f"{1 / config.fleet.period_s:g} Hz; world '{sim_table(config).profile}', seed {figures['seed']}; "
        f"loss {config.transport.loss:g}, delay {config.transport.delay_s:g} s"
    )


def _warnings(fleet: dict[str, Any]) -> str:
    sentences = [f"{death['name']} at {death['at_s']:.1f} s: {death['why']}" for death in fleet["deaths"]]
    if fleet["interrupted"]:
        sentences.append("the run was interrupted before its end")
    behind_s = (fleet["simulator"] or {}).get("max_behind_s", 0.0)
    if behind_s > 0.1:
        sentences.append(f"the simulator was up to {behind_s:.2f} s behind the clock: the machine was overloaded")
    if not is_installed("report"):
        sentences.append(sentence("report", NO_PLOTS))
    return "".join(f'<p class="warning">{escape(each)}</p>\n' for each in sentences)


def _table(figures: dict[str, Any]) -> str:
    head = "".join(f"<th>{escape(title)}</th>" for title, _ in COLUMNS)
    rows = [_row(f"drone {agent['id']}", agent) for agent in figures["agents"]]
    rows.append(_row("fleet", figures["fleet"], ' class="total"'))
    return f"<table>\n<tr><th></th>{head}</tr>\n{''.join(rows)}</table>"


def _targets(figures: dict[str, Any]) -> str:
    """What each drone knew of each target."""
    if not figures["targets"]:
        return ""
    head = "".join(f"<th>{escape(title)}</th>" for title, _ in TARGET_COLUMNS)
    rows = ("".join(f"<td>{escape(cell)}</td>" for cell in target_cells(row)) for row in figures["targets"])
    return f"\n<h2>Targets</h2>\n<table>\n<tr>{head}</tr>\n{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"


def _row(name: str, row: dict[str, Any], mark: str = "") -> str:
    cells = "".join(f"<td>{escape(show(row))}</td>" for _, show in COLUMNS)
    return f"<tr{mark}><td>{escape(name)}</td>{cells}</tr>\n"


def counted(count: int, what: str) -> str:
    """``1 drone``, ``3 drones``."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def _number(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _ms(value_s: float | None) -> str:
    return _number(value_s, 1, 1e3)
