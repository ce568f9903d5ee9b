"""The table of a replay's errors: which parts of a run have a line, and what they are called."""

from __future__ import annotations

from typing import Any

import pytest

from fleetloc.report.replay_figures import is_refusal
from fleetloc.report.replay_tables import error_table

FIGURES = (
    "position_rmse_m", "horizontal_rmse_m", "position_median_m", "position_p95_m", "anees", "anees_own",
    "autopilot_horizontal_rmse_m", "gps_as_received_horizontal_rmse_m", "to_autopilot_horizontal_rms_m",
)  # fmt: skip


def lines(**ticks: int) -> list[str]:
    """The first cells of the table of one drone whose phases have so many ticks with a truth."""
    phases: dict[str, Any] = {
        name: {"ticks_with_truth": count} | dict.fromkeys(FIGURES, 0.5 if count else None)
        for name, count in ticks.items()
    }
    columns, rows = error_table({"agents": [{"id": 3, "phases": phases}]})
    assert {len(row) for row in rows} == {len(columns)}
    return [row[0] for row in rows]


@pytest.mark.parametrize(
    ("ticks", "shown"),
    [
        ({"all": 200, "after_10s": 100}, ["3, all", "3, after 10 s"]),
        # truth that begins later: both are the same
        ({"all": 100, "after_10s": 100}, ["3, after 10 s"]),
        # a run that ended before
        ({"all": 50, "after_10s": 0}, ["3, all"]),
        ({"all": 200, "after_10s": 100, "dropout 5..9 s": 0}, ["3, all", "3, after 10 s", "3, dropout 5..9 s"]),
        # no truth at all
        ({"all": 0, "after_10s": 0}, ["3, all", "3, after 10 s"]),
    ],
)
def test_each_part_of_a_run_that_says_something_has_a_line(ticks: dict[str, int], shown: list[str]) -> None:
    assert lines(**ticks) == shown


@pytest.mark.parametrize(
    ("counter", "counts"),
    [
        ("refused heard: not proven, of 3", True),
        ("refused own: out of range", True),
        ("impossible rows of 2", True),
        ("gps: refused", True),
        ("information: refused of 2", True),
        ("refused not located", False),
        ("refused heard: too old", False),
        ("gps: late", False),
    ],
)
def test_only_what_was_not_believed_counts_as_refused(counter: str, counts: bool) -> None:
    assert is_refusal(counter) is counts
