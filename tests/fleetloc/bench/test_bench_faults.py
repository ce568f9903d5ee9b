"""``fleetloc bench faults``: rows as data, figures by hand, and the command from end to end."""

from __future__ import annotations

import json
import math
import typing
from pathlib import Path

import msgspec
import numpy as np
import pytest

from agent.config.reading import load_config
from agent.radio.radio_faults import RadioOutage
from fleetloc import cli
from fleetloc.bench.fault_flights import Flight, History
from fleetloc.bench.fault_rows import ROWS_FILE, FaultRow, RadioSpell, chosen_rows, read_rows
from fleetloc.bench.faults import Pooled, back_after_s, row_figures
from fleetloc.errors import InputError
from sim_bridge.faults.fault_tables import FaultTable, GpsOff, GpsWrong, UwbSwapped, UwbWrong, about, wrong_settings

CONFIGS = Path(__file__).parents[3] / "configs"
PERIOD_S = 0.1

# --- rows ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fleet", ["line3", "mesh5"])
def test_every_row_that_comes_along_can_be_flown_by_the_shipped_fleets(fleet: str) -> None:
    config = load_config(CONFIGS / f"{fleet}.toml")
    placed = {row.name: row.placed(config.ids) for row in read_rows(ROWS_FILE)}
    assert {name for name, row in placed.items() if row is None} == (
        {"gps_loss_300_three"} if fleet == "line3" else set()
    )
    for row in placed.values():
        if row is not None:
            assert not list(wrong_settings(row.faults, config, "rows"))
            assert row.begin_s < row.end_s < row.duration_s
    kinds = {fault.__struct_config__.tag for row in read_rows(ROWS_FILE) for fault in row.faults}
    assert kinds == {kind.__struct_config__.tag for kind in typing.get_args(FaultTable)}


def test_agents_of_a_row_are_places_in_the_fleet() -> None:
    row = FaultRow(
        name="x",
        title="x",
        faults=(
            GpsOff(agents=(1, 2, 9), to_s=5.0),
            GpsOff(agents=(8, 9), to_s=6.0),
            UwbWrong(pairs=((1, 3), (1, 9)), to_s=7.0, bias_m=1.0),
            UwbWrong(to_s=8.0, bias_m=1.0),
            UwbSwapped(agents=(2,), between=(3, 1), to_s=8.0),
            UwbSwapped(agents=(2,), between=(3, 4), to_s=8.0),
        ),
    )
    placed = row.placed((10, 20, 30))
    assert placed is not None
    assert [sorted(about(fault)) for fault in placed.faults] == [[10, 20], [10, 30], [], [20]]
    assert placed.faults[1].pairs == ((10, 30),)
    assert placed.faults[3].between == (30, 10)
    assert msgspec.structs.replace(row, smallest_fleet=4).placed((10, 20, 30)) is None
    assert msgspec.structs.replace(row, faults=row.faults[1:2]).placed((10, 20, 30)) is None


def test_what_a_row_does_to_the_radio_comes_on_top_of_the_fleets_own() -> None:
    radio = RadioSpell(
        from_s=5.0,
        to_s=8.0,
        loss=0.3,
        duplicate=0.5,
        outages=(RadioOutage(from_s=5.0, to_s=8.0, receivers=(2,), senders=(1, 9)),),
    )
    row = FaultRow(name="x", title="x", radio=radio, after_s=2.0)
    assert (row.begin_s, row.end_s, row.duration_s) == (5.0, 8.0, 10.0)
    placed = row.placed((10, 20, 30))
    assert placed is not None
    assert placed.radio is not None
    config = load_config(CONFIGS / "line3.toml", ["transport.loss=0.1", "transport.delay_s=0.02"])
    transport = Flight(config, 4, (), row.duration_s, placed.radio).configured().transport
    assert (transport.loss, transport.delay_s, transport.seed) == (0.3, 0.02, 4)
    assert transport.faults.duplicate == 0.5
    (outage,) = transport.faults.outages
    assert (outage.receivers, outage.senders) == ((20,), (10,))
    assert Flight(config, 4, (), row.duration_s).configured().transport.loss == 0.1


def test_rows_are_chosen_by_name() -> None:
    rows = read_rows(ROWS_FILE)
    assert chosen_rows(rows, "") == rows
    assert [row.name for row in chosen_rows(rows, " liar, gps_freeze")] == ["gps_freeze", "liar"]
    with pytest.raises(InputError, match=r"--rows: expected some of gps_jump_33, .*, found lair"):
        chosen_rows(rows, "lair")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("rows = 3", "rows: expected an array of tables, found 3"),
        ("[[rows]]\nname = 'a'\ntitle = 'a'\nfaults = []", r"rows\[0\]: expected faults or a radio, found neither"),
        (
            "[[rows]]\nname = 'a'\ntitle = 'a'\nradio = {from_s = 3.0, to_s = 2.0}",
            r"rows\[0\].radio.to_s: expected later than from_s = 3, found 2",
        ),
        ("[[rows]]\nname = 'a'\ntitle = 'a'\nfaults = [{kind = 'gps_of'}]", "one of gps_off, .*, found 'gps_of'"),
        (
            "[[rows]]\nname = 'a'\ntitle = 'a'\nfaults = [{kind = 'gps_off', agents = [1]}]",
            r"rows\[0\].faults\[0\].to_s: expected an end after from_s = 0, found None",
        ),
        ("rows = [", "expected TOML"),
    ],
)
def test_a_file_of_rows_that_cannot_be_used_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "rows.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_rows(path)


# --- figures ------------------------------------------------------------------------------------------------------

ROW = FaultRow(
    name="jump",
    title="",
    faults=(GpsWrong(agents=(20,), from_s=4.0, to_s=6.0, offset_m=(9.0, 0.0, 0.0)),),
    after_s=4.0,
    ratio_at_most=2.0,
    back_within_s=2.0,
)
TICKS = 100


def history(**changes: np.ndarray) -> History:
    """Two drones, all ticks alike: error 0.2 m, sigma 0.1 m, NEES 1, nothing flagged."""
    level = np.ones((TICKS, 2))
    calm = np.zeros((TICKS, 2), bool)
    given = {
        "error_m": 0.2 * level, "sigma_m": 0.1 * level, "fleet_m": 0.2 * level, "nees": level,
        "nees_fleet": level, "available": ~calm, "flagged": calm, "alarm": calm,
    }  # fmt: skip
    return History(**{**given, **changes})


def faulted() -> History:
    """Drone 20 is 4 m off during the fault and 0.4 m for 1.5 s after it; flagged from 0.5 s in, silent for 1 s."""
    error = np.full((TICKS, 2), 0.2)
    error[40:60, 1], error[60:75, 1] = 4.0, 0.4
    flagged = np.zeros((TICKS, 2), bool)
    flagged[45:60, 1] = True
    available = np.ones((TICKS, 2), bool)
    available[60:70, 1] = False
    return history(error_m=error, flagged=flagged, available=available)


def pooled(*faulty: History) -> Pooled:
    return Pooled((10, 20), PERIOD_S, [history() for _ in faulty], faulty)


def history_with(flown: History, **changes: np.ndarray) -> History:
    return History(**{name: changes.get(name, getattr(flown, name)) for name in History.__slots__})


def test_errors_before_during_and_after_beside_the_same_seeds_without() -> None:
    figures = row_figures(ROW, pooled(faulted(), faulted()))
    assert (figures["hit"], figures["seeds"]) == ([20], 2)
    assert figures["before"]["position_rmse_all_m"] == pytest.approx(0.2)
    assert figures["during"]["position_rmse_hit_m"] == pytest.approx(4.0)
    assert figures["during"]["position_rmse_all_m"] == pytest.approx(math.sqrt((0.2**2 + 4.0**2) / 2))
    assert figures["during"]["position_ratio_hit"] == pytest.approx(20.0)
    assert figures["during"]["position_ratio_others"] == pytest.approx(1.0)
    assert figures["during"]["worst_m"] == 4.0
    assert figures["during"]["fleet_rmse_m"] == pytest.approx(0.2)
    after = (15 * 0.4**2 + 25 * 0.2**2) / 40
    assert figures["after"]["position_rmse_hit_m"] == pytest.approx(math.sqrt(after))
    assert figures["after"]["availability"] == pytest.approx(70 / 80)


def test_what_the_drones_say_of_it() -> None:
    figures = row_figures(ROW, pooled(faulted()))
    assert figures["sigmas_p99"] == pytest.approx(40.0)
    assert figures["claimed_over_actual_hit"] == pytest.approx(0.1 / 4.0)
    assert figures["flagged_after_s"] == pytest.approx(0.5)
    assert figures["flagged_share"] == pytest.approx(15 / 120)
    assert figures["misleading_without_alarm_share"] == pytest.approx(20 / 120)
    assert figures["misses"] == ["ratio 14.2 > 2", "sigmas 40 > 3", "misleads"]
    # an alarm, or a sigma that says so, does not mislead
    alarm = np.ones((TICKS, 2), bool)
    told = row_figures(ROW, pooled(history_with(faulted(), alarm=alarm)))
    assert told["misleading_share"] == pytest.approx(20 / 120)
    assert told["misleading_without_alarm_share"] == 0.0
    unsure = row_figures(ROW, pooled(history_with(faulted(), sigma_m=np.full((TICKS, 2), 2.0))))
    assert unsure["misleading_share"] == 0.0
    assert unsure["misses"] == ["ratio 14.2 > 2"]
    # a seed without a flag is a fault that is not flagged
    quiet = history_with(faulted(), flagged=np.zeros((TICKS, 2), bool))
    assert row_figures(ROW, pooled(faulted(), quiet))["flagged_after_s"] is None
    prompt, late = (msgspec.structs.replace(ROW, flag_within_s=bound_s) for bound_s in (0.5, 0.4))
    assert "flag s 0.5 > 0.4" in row_figures(late, pooled(faulted()))["misses"]
    assert not [each for each in row_figures(prompt, pooled(faulted()))["misses"] if each.startswith("flag")]
    assert "flag s inf > 0.5" in row_figures(prompt, pooled(quiet))["misses"]


def test_fleets_too_small_to_tell_whose_fault_it_is_are_held_to_what_they_say_of_it() -> None:
    of_few = msgspec.structs.replace(ROW, attributable_from=3, told_within_s=0.5)
    silent = row_figures(of_few, pooled(faulted()))
    assert not silent["attributable"]
    assert silent["misses"] == ["sigmas 40 > 3", "misleads"]
    alarm = np.zeros((TICKS, 2), bool)
    alarm[40:61, 1] = True
    told = row_figures(of_few, pooled(history_with(faulted(), alarm=alarm)))
    assert told["sigmas_p99"] == pytest.approx(40.0)
    assert told["sigmas_p99_unalarmed"] == pytest.approx(4.0)  # after it, when the alarm is gone
    assert told["misses"] == ["sigmas 4 > 3"]
    # until it has to be told nobody can know
    alarm[:45] = False
    error = faulted().error_m.copy()
    error[60:] = 0.2
    late = row_figures(of_few, pooled(history_with(faulted(), alarm=alarm, error_m=error)))
    assert late["misses"] == ["misleads"]
    prompt = row_figures(
        msgspec.structs.replace(of_few, told_within_s=0.4), pooled(history_with(faulted(), alarm=alarm))
    )
    assert "told s 0.5 > 0.4" in prompt["misses"]
    # a fleet that can tell is held to all
    assert (
        "ratio 14.2 > 2"
        in row_figures(msgspec.structs.replace(of_few, attributable_from=2), pooled(faulted()))["misses"]
    )


def test_a_fleet_is_back_when_it_stays_as_good_as_without_the_fault() -> None:
    # the error of 0.4 m until 1.5 s after the end is beyond 1.5 times; the mean over a second forgets it gradually
    back_s = back_after_s(pooled(faulted()), 60, 100)
    assert back_s is not None
    assert 0.5 <= back_s <= 1.5
    assert back_after_s(pooled(history()), 60, 100) == 0.0
    never = history_with(history(), error_m=np.full((TICKS, 2), 0.5))
    assert back_after_s(pooled(never), 60, 100) is None
    assert "back s inf > 2" in row_figures(ROW, pooled(never))["misses"]


def test_ticks_without_an_estimate_show_in_the_availability_and_poison_no_figure() -> None:
    error = faulted().error_m.copy()
    error[50:55] = np.nan
    gap = row_figures(ROW, pooled(history_with(faulted(), error_m=error)))
    assert gap["during"]["position_rmse_hit_m"] == pytest.approx(4.0)
    assert all(math.isfinite(value) for value in gap["during"].values())


# --- the command --------------------------------------------------------------------------------------------------


def test_the_command_flies_rows_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = tmp_path / "rows.toml"
    rows.write_text(
        """
[[rows]]
name = "jump"
title = "a jump of 20 m"
faults = [{ kind = "gps_wrong", agents = [3], from_s = 4.0, to_s = 5.0, offset_m = [20.0, 0.0, 0.0] }]
after_s = 1.0
ratio_at_most = 1e-6
"""
    )
    found = tmp_path / "found.json"
    line3 = str(CONFIGS / "line3.toml")
    arguments = ["bench", "faults", line3, "--rows-from", str(rows), "--runs", "1", "--seed", "4", "--jobs", "1"]
    assert cli.main([*arguments, "--json", str(found)]) == 0
    (row,) = json.loads(found.read_text())["rows"]
    assert (row["row"], row["hit"], row["from_s"], row["to_s"]) == ("jump", [3], 4.0, 5.0)
    assert row["before"]["position_ratio_all"] == pytest.approx(1.0)  # the same flight up to the fault
    assert row["during"]["position_ratio_hit"] != pytest.approx(1.0, rel=1e-3)  # it is another flight from then on
    assert row["during"]["availability"] == 1.0
    assert any(each.startswith("ratio ") for each in row["misses"])
    assert "jump" in capsys.readouterr().out


def test_rows_that_no_drone_of_the_fleet_can_fly_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    line3 = str(CONFIGS / "line3.toml")
    assert cli.main(["bench", "faults", line3, "--rows", "gps_loss_300_three"]) == 2
    assert "--rows: expected rows for a fleet of 3, found gps_loss_300_three" in capsys.readouterr().err
