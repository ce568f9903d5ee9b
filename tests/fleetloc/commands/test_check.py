"""``fleetloc check``: all mistakes at once, warnings, and the same for programs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fleetloc import cli

ROOT = Path(__file__).parents[3]
CONFIGS = ROOT / "configs"
LINE3 = CONFIGS / "line3.toml"
WHOLE = sorted(path for path in CONFIGS.rglob("*.toml") if "[fleet]" in path.read_text())
ALONE = "drone {} is alone: fleet.edges names it in no pair, so it hears and ranges nobody"
UNSIGNED = "packets are not signed (security.mode is unsigned)"


def check(capsys: pytest.CaptureFixture[str], path: Path, *options: str) -> tuple[int, str, list[str]]:
    """Exit code, stdout and the lines on stderr."""
    code = cli.main(["check", str(path), *options])
    out, err = capsys.readouterr()
    return code, out, err.splitlines()


@pytest.mark.parametrize("path", WHOLE, ids=lambda path: path.stem)
def test_every_shipped_configuration_has_no_mistake(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--print"]  # keys are made by the user
    if path.stem == "single":  # a replay takes its origin from the log
        options += ["--set", "fleet.origin={lat_deg=47.0, lon_deg=8.0, alt_m=400.0}"]
    code, _, lines = check(capsys, path, *options)
    assert (code, lines) == (0, [])


@pytest.mark.parametrize("path", sorted((CONFIGS / "links").glob("*.toml")), ids=lambda path: path.stem)
def test_every_link_profile_can_be_laid_over_a_fleet(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, lines = check(capsys, LINE3, "--with", str(path), "--print")
    assert (code, lines) == (0, [])


def test_mistakes_of_all_tables_are_told_with_their_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "fleet.toml"
    text = LINE3.read_text()
    for old, new in (
        ("period_s = 0.1", "period_s = 20.0"),
        ("uwb_bound_m", "uwb_bond_m"),
        ("lap_s = 24.0", "lap_s = -1.0"),
        ('profile = "paper"', 'profile = "papper"'),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    text += "[sitl]\nvehicles = [{ agent = 9, simulator = 'tcp:127.0.0.1:5760' }]\n[monitor]\nport = 99999\n"
    path.write_text(text)
    lines_of = {key: 1 + n for n, line in enumerate(path.read_text().splitlines()) for key in [line.split(" = ")[0]]}
    code, out, lines = check(capsys, path)
    assert (code, out) == (2, "")
    start = f"fleetloc: error: {path}"
    assert [line for line in lines if not line.startswith("warning: ")] == [
        f"{start}:{lines_of['period_s']}: fleet.period_s: expected a number <= 10, found 20.0",
        next(line for line in lines if line.startswith(f"{start}:{lines_of['uwb_bond_m']}: sensors.uwb_bond_m: ")),
        f"{start}:{lines_of['profile']}: sim.profile: expected one of paper, realistic, nom, found 'papper'; "
        "did you mean paper?",
        next(line for line in lines if "sim.paths of agent 1, lap_s: expected a number > 0, found -1.0" in line),
        f"{start}:{lines_of['vehicles']}: sitl.vehicles of agent 9, agent: expected ids of agents (1, 2, 3), found 9",
        f"{start}:{lines_of['port']}: monitor.port: expected a whole number <= 65535, found 99999",
    ]
    assert "found an unknown key; did you mean uwb_bound_m?" in "\n".join(lines)


def test_a_daemon_is_not_refused_for_a_mistake_in_a_table_of_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text(LINE3.read_text().replace('profile = "paper"', 'profile = "papper"'))
    assert check(capsys, path)[0] == 2
    assert cli.main(["agent", str(path), "--id", "9"]) == 2  # it gets as far as looking for its agent
    assert "--id: expected one of 1, 2, 3, found 9" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("edges", "warnings"),
    [
        ("[[1, 2], [2, 3]]", []),
        ("[[1, 2]]", [ALONE.format(3)]),
        ("[]", [ALONE.format(1), ALONE.format(2), ALONE.format(3)]),
    ],
)
def test_a_drone_left_alone_is_warned_of(
    capsys: pytest.CaptureFixture[str], edges: str, warnings: list[str]
) -> None:
    code, _, lines = check(capsys, LINE3, "--set", f"fleet.edges={edges}")
    assert code == 0
    assert [line.removeprefix("warning: ") for line in lines if UNSIGNED not in line] == warnings


def test_a_fleet_in_two_islands_is_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, lines = check(capsys, CONFIGS / "mesh5.toml", "--set", "fleet.edges=[[1,3],[2,4],[4,5]]")
    assert code == 0
    assert "warning: the fleet is in 2 islands that never hear each other: 1, 3 | 2, 4, 5 (fleet.edges)" in lines


def test_unsigned_packets_are_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    _, _, lines = check(capsys, LINE3)
    (line,) = lines
    assert line.startswith(f"warning: {UNSIGNED}")


def test_a_drone_of_its_own_is_not_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "one.toml"
    path.write_text((CONFIGS / "single.toml").read_text().replace('"single"', '"one"'))
    _, _, lines = check(capsys, path, "--set", "fleet.origin={lat_deg=47.0, lon_deg=8.0, alt_m=400.0}")
    assert not [line for line in lines if "alone" in line or "islands" in line]


def test_programs_read_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = check(capsys, LINE3, "--set", "fleet.edges=[[1,7]]", "--json", "-")
    assert code == 2
    told = json.loads(out)
    (mistake,) = told["mistakes"]
    assert (told["ok"], told["file"]) == (False, str(LINE3))
    assert (mistake["where"], mistake["line"], mistake["key"]) == ("--set", None, "fleet.edges, entry 1")
    assert (mistake["expected"], mistake["found"]) == ("ids of agents (1, 2, 3)", "7")
    file = tmp_path / "checked.json"
    assert check(capsys, LINE3, "--json", str(file))[0] == 0
    told = json.loads(file.read_text())
    assert (told["ok"], told["mistakes"]) == (True, [])
    assert len(told["warnings"]) == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["fleet", "--loss", "30"], "--loss: expected a number <= 1, found 30.0"),
        (["fleet", "--delay=-1"], "--delay: expected a number >= 0, found -1.0"),
        (["fleet", "--duration", "0"], "--duration: expected a number > 0, found 0.0"),
        (["sim", "--seed=-4"], "--seed: expected a whole number >= 0, found -4"),
        (["sitl", "--loss", "2"], "--loss: expected a number <= 1, found 2.0"),
        (["sitl", "--with", "nowhere.toml"], "nowhere.toml: expected a TOML file, found no such file"),
        (["fleet", "--set", "agents.1.mavlink=/dev/ttyUSB0"], "found '/dev/ttyUSB0', which is 57600 baud as it says"),
    ],
)
def test_an_option_is_named_as_it_was_typed(
    capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    command, *options = arguments
    assert cli.main([command, str(LINE3), *options]) == 2
    err = capsys.readouterr().err
    assert says in err
    assert err.count("\n") == 1
