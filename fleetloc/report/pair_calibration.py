"""What is known of the ranges of each pair after a calibration, and the lines that a configuration has for it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fleetloc.output import print_table


@dataclass(frozen=True, slots=True)
class CalibratedPair:
    """``bias_m`` of the ranges of a pair and its 1-sigma; ``sigma_m`` of one range, where it was looked at.

    ``tags``: between which of their antennas, where one of the two has several.
    """

    pair: tuple[int, int]
    count: int
    bias_m: float
    bias_sigma_m: float
    sigma_m: float | None = None
    tags: tuple[int, int] | None = None


def lines(pairs: Iterable[CalibratedPair]) -> str:
    """``[[sensors.uwb_pairs]]`` of a configuration, or of a file laid over one."""
    text = ""
    for each in pairs:
        one, other = each.pair
        text += f"[[sensors.uwb_pairs]]  # +- {each.bias_sigma_m:.3f} m, {each.count} ranges\n"
        text += f"pair = [{one}, {other}]\n"
        if each.tags is not None:
            text += f"tags = {list(each.tags)}\n"
        text += f"bias_m = {each.bias_m:.3f}\n"
        if each.sigma_m is not None:
            text += f"sigma_m = {max(each.sigma_m, 1e-3):.3f}\n"
        text += "\n"
    return text


def write_lines(pairs: Iterable[CalibratedPair], path: Path | None) -> None:
    """Write them to a file, where one is asked for; raises `OSError`."""
    if path is not None:
        path.write_text(lines(pairs), encoding="utf-8")


def name_of(pair: tuple[int, int], tags: tuple[int, int] | None) -> str:
    """A pair, or two of its antennas, for people."""
    if tags is None:
        return f"{pair[0]} - {pair[1]}"
    return f"{pair[0]} tag {tags[0]} - {pair[1]} tag {tags[1]}"


def print_pairs(pairs: Sequence[CalibratedPair], title: str) -> None:
    """A table for people."""
    rows = [
        [
            name_of(each.pair, each.tags),
            str(each.count),
            f"{each.bias_m:+.3f}",
            f"{each.bias_sigma_m:.3f}",
            "-" if each.sigma_m is None else f"{each.sigma_m:.3f}",
        ]
        for each in pairs
    ]
    print_table(["pair", "ranges", "bias m", "+- m", "robust sigma m"], rows, title=title)


def as_json(pairs: Iterable[CalibratedPair]) -> list[dict[str, object]]:
    """The same for machines."""
    return [
        {
            "pair": list(each.pair),
            "tags": None if each.tags is None else list(each.tags),
            "count": each.count,
            "bias_m": each.bias_m,
            "bias_sigma_m": each.bias_sigma_m,
            "robust_sigma_m": each.sigma_m,
        }
        for each in pairs
    ]
