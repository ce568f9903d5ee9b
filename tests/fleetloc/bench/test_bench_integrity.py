"""``fleetloc bench integrity``: figures by hand, and the command from end to end, resumed."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from agent.config.reading import load_config
from fleetloc import cli
from fleetloc.bench.fault_rows import FaultRow, RadioSpell
from fleetloc.bench.integrity.flights import Promises, first_drones
from fleetloc.bench.integrity.study import SizedRow, case_figures, cases
from fleetloc.errors import InputError
from sim_bridge.faults.fault_tables import GpsWrong, UwbWrong
from sim_bridge.world.sim_table import sim_table

CONFIGS = Path(__file__).parents[3] / "configs"
JUMP = GpsWrong(agents=(2,), from_s=15.0, to_s=16.0, offset_m=(30.0, 0.0, 0.0))
ROW = FaultRow(name="jump", title="x", faults=(JUMP,))
TICKS, BEGIN = 200, 150


def promises(drones: int) -> Promises:
    """Errors of a metre, levels of three, no alert; drone 2 is named half a second after the fault began."""
    both = TICKS, drones
    fixes = np.zeros((TICKS, drones, drones), np.bool_)
    fixes[BEGIN + 5 :, :, 1] = True
    nothing = np.zeros(both, np.bool_)
    error, level = np.ones((*both, 2)), np.full((*both, 2), 3.0)
    return Promises(error, level, nothing.copy(), fixes, np.zeros_like(fixes), nothing)


def case(size: int = 5, row: FaultRow | None = ROW) -> SizedRow:
    return SizedRow(first_drones(load_config(CONFIGS / "spoof.toml"), size), row, 20.0)


def test_epochs_are_counted_by_error_level_and_limit() -> None:
    flown = promises(5)
    flown.error_m[120, 0, 0] = 3.5  # beyond the level of 3 m, within the limit of 4 m
    flown.error_m[130:133, 1, 1] = 7.0  # beyond the level, and the limit of 6 m
    flown.error_m[140, 2, 0] = 9.0
    flown.alert[140, 2] = True
    found = case_figures(case(), [flown])
    assert found["epochs"] == 5 * (TICKS - 100)
    assert (found["misleading"], found["hazardously_misleading"]) == (4, 3)
    assert found["longest_alert_delay_s"] == pytest.approx(0.3)
    assert found["availability"] == pytest.approx(1.0 - 1.0 / 500.0)


def test_times_and_culprits() -> None:
    right, wrong, early = promises(5), promises(5), promises(5)
    wrong.fixes_off[BEGIN + 2 :, 3, 4] = True
    early.fixes_off[BEGIN - 20 : BEGIN - 10, 0, 1] = True
    found = case_figures(case(), [right, wrong, early])
    assert found["named_after_s"] == [0.5, 0.5, 0.5]
    assert found["detected_after_s"] == [0.5, 0.2, 0.5]
    assert (found["wrong_named_seeds"], found["false_alarm_seeds"]) == (1, 1)


def test_of_three_drones_nobody_can_tell() -> None:
    assert case(3).undetectable
    assert not case(5).undetectable
    assert not case(3, None).undetectable
    bias = FaultRow(name="bias", title="x", faults=(UwbWrong(pairs=((1, 2),), to_s=5.0, bias_m=0.4),))
    assert not case(3, bias).undetectable
    bias = msgspec.structs.replace(bias, attributable_from=4)
    assert case(3, bias).undetectable
    assert not case(4, bias).undetectable


def test_smaller_fleets_are_the_first_drones() -> None:
    fleet = first_drones(load_config(CONFIGS / "spoof.toml"), 3)
    assert fleet.ids == (1, 2, 3)
    assert sim_table(fleet).faults == ()
    assert {path.agent for path in sim_table(fleet).paths} == {1, 2, 3}


def test_a_bad_radio_is_flown_too_and_has_no_culprit() -> None:
    row = FaultRow(name="loss", title="x", radio=RadioSpell(from_s=15.0, to_s=35.0, loss=0.6))
    _, bad = cases(load_config(CONFIGS / "spoof.toml"), [row], [4], 20.0)
    (flight,) = bad.flights([1])
    assert flight.configured().transport.loss == 0.6
    assert bad.culprits == (frozenset(), frozenset())
    assert not bad.undetectable


def test_sizes_beyond_the_fleet_are_refused() -> None:
    with pytest.raises(InputError, match="--sizes"):
        cases(load_config(CONFIGS / "spoof.toml"), [ROW], [9], 20.0)


def test_the_command_from_end_to_end_and_again(tmp_path: Path) -> None:
    rows = tmp_path / "rows.toml"
    rows.write_text(
        '[[rows]]\nname = "jump"\ntitle = "x"\nafter_s = 1.0\n'
        'faults = [{ kind = "gps_wrong", agents = [2], from_s = 12.0, to_s = 15.0, offset_m = [30.0, 0.0, 0.0] }]\n'
    )
    given = ["bench", "integrity", str(CONFIGS / "spoof.toml"), "--rows-from", str(rows), "--sizes", "4"]
    given += ["--runs", "1", "--clean", "20", "--out", str(tmp_path / "out")]
    assert cli.main([*given, "--json", str(tmp_path / "first.json")]) == 0
    first = json.loads((tmp_path / "first.json").read_text())
    clean, jump = first["rows"]
    assert (clean["row"], jump["row"], jump["drones"]) == ("none", "jump", 4)
    assert clean["false_alarm_seeds"] == 0
    assert 0.0 < jump["named_after_s"][0] <= 2.0
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "flights").iterdir()}
    assert len(kept) == 2
    assert cli.main([*given, "--json", str(tmp_path / "again.json")]) == 0
    assert json.loads((tmp_path / "again.json").read_text()) == first
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
