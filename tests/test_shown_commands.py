"""The commands that the pages show are run, in the order of a page, in a folder that has what a reader would have.

What cannot be run in a test's time, or at all, is named in ``LEFT_OUT`` or ``OTHER_PROGRAMS`` with the reason.
`tests.test_docs` holds the names of all commands and options to the code.
"""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from fleetloc.cli import main
from tests.support.doc_pages import DOCS, FENCE, ROOT, blocks, shell_lines, written_commands
from tests.support.frozen_cases import case_recording, load_case

LEFT_OUT = {
    r"fleet (?!.*--lockstep)": "flies live, up to a minute; tests/fleet flies such fleets",
    r"fleet configs/\S+ (?=.*--lockstep)(?=.*--(seed|loss|duration 60))": "flights for tables; shorter ones are run",
    r"(fleet|survey) configs/awareness/survey.toml": "two minutes of flight; tests/fleetloc/report/test_survey.py",
    r"(agent|sim|monitor|ros2|uwb) ": "runs until it is stopped; tests/fleet and tests/fleetloc run them",
    r"sitl ": "needs autopilots in simulators",
    r"doctor ": "listens to an autopilot; tests/fleetloc/doctor plays one",
    r"bench ": "a study takes minutes; tests/fleetloc/bench runs each with few runs",
}
OTHER_PROGRAMS = {
    "make": "is what runs this test, or installs and flies for a minute",
    "git": "needs the network",
    "pip": "needs the network",
    "uv": "needs the network",
    "pipx": "needs the network",
    "source": "needs an environment of its own",
    "python3": "makes an environment and needs the network",
    "python": "live measurements of tests/fleet; the UWB script, which tests/test_docs.py runs without a radio",
    "while": "feeds the UWB script for ever",
    "kill": "ends a process of a live fleet",
    "docker": "needs an engine; tests/compose",
    "sudo": "needs root",
    "useradd": "needs root",
    "install": "needs root",
    "systemctl": "needs systemd",
    "ros2": "needs ROS 2",
    "export": "of the ROS 2 example",
    "FLEETLOC_CONFIG=/etc/fleetloc/compose5.toml": "docker again",
    "cd": "the reader's folder; the test is in it already",
    "cp": "copies between the reader's machines",
}
SHELLS_OF_SIMULATORS = ("sitl.md",)
"""Their blocks start ArduPilot and PX4."""
BEFORE = {page: ["keys init fleet.toml"] for page in ("operating.md", "security.md", "uwb.md")}
"""Commands that a page takes for granted."""
MAKES_ITS_FILE = "first-configuration.md"
"""The page whose reader has no ``fleet.toml`` yet."""
ASIDE = {"security.md": {"keys add fleet.toml --id 4": "[[agents]]\nid = 4\nmavlink = 'udpin:127.0.0.1:14554'\n"}}
"""What a reader adds to ``fleet.toml`` before a command, as the page says."""

FLOWN = {"agent_001": "two_places_002", "agent_002": "two_places_002", "agent_003": "two_places_003"}
"""Flight logs kept of two drones, in the places of three."""


def is_whole(command: str) -> bool:
    """Whether a command could be typed: it names a file or has a value, and nothing stands for something else."""
    words = shlex.split(command, comments=True)
    if any(re.fullmatch(r"\[?[A-Z]+(\.npz|\.\.\.)?\]?|\.\.\.|.*[\[|].*", word) for word in words):
        return False
    return len(words) > 1 and any(re.search(r"[.\d]", word) for word in words)


def commands_of(page: str) -> list[str]:
    """The commands of a page that are run."""
    shown = [shlex.join(shlex.split(text, comments=True)) for name, text in written_commands() if name == page]
    in_blocks = [each for each in shown if each in ("warmup",) or is_whole(each)]
    return [each for each in dict.fromkeys(in_blocks) if not any(re.match(left_out, each) for left_out in LEFT_OUT)]


PAGES_WITH_COMMANDS = [page for page in dict.fromkeys(page for page, _ in written_commands()) if commands_of(page)]


def first_configuration() -> str:
    """The file of the newcomer's page, whose fleet every page flies."""
    return next(
        block.text for block in blocks() if block.page == "first-configuration.md" and block.language == "toml"
    )


def give_files(folder: Path) -> None:
    """What a reader has: the example configurations, a fleet's file, logs of flights, ranges, a study input."""
    shutil.copytree(ROOT / "configs", folder / "configs")
    (folder / "fleet.toml").write_text(first_configuration(), encoding="utf-8")
    for name in ("uav1.tlog", "uav2.tlog", "uav3.tlog", "flight.tlog"):
        shutil.copy(ROOT / "tests/data/logs/copter.tlog.gz", folder / name)
    for agent, log in FLOWN.items():
        for place in ("out/line3", "records"):
            (folder / place).mkdir(parents=True, exist_ok=True)
            for suffix in (".mcap", ".tlog"):
                shutil.copy(ROOT / f"tests/data/records/{log}{suffix}", folder / f"{place}/{agent}{suffix}")
    calibration = FENCE.finditer((DOCS / "uwb.md").read_text(encoding="utf-8"))
    (text,) = [found["text"] for found in calibration if "observer,target,range_m,true_m" in found["text"]]
    (folder / "calibration.csv").write_text("\n".join(line.strip() for line in text.splitlines()), encoding="utf-8")
    arrays, options = load_case(ROOT / "tests/data/dmhe/c09_pre_loss30_drop.npz")
    np.savez_compressed(folder / "run.npz", **case_recording(arrays, options))


def arguments_of(command: str, folder: Path) -> list[str]:
    """The words of a command, patterns of files expanded as the shell does."""
    words: list[str] = []
    for word in shlex.split(command):
        words += sorted(str(path.relative_to(folder)) for path in folder.glob(word)) if "*" in word else [word]
    return words


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS)
def test_the_commands_of_a_page_do_what_they_say(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN the folder of a reader WHEN the commands of a page are run in its order THEN each ends well."""
    give_files(tmp_path)
    if page == MAKES_ITS_FILE:
        (tmp_path / "fleet.toml").unlink()
    for command in [*BEFORE.get(page, []), *commands_of(page)]:
        fleet = tmp_path / "fleet.toml"
        if aside := ASIDE.get(page, {}).get(command):
            fleet.write_text(fleet.read_text() + aside)
        inside = tmp_path / "records" if "../fleet.toml" in command else tmp_path
        monkeypatch.chdir(inside)
        code = main(arguments_of(command, inside))
        assert code == 0, f"{page}: fleetloc {command}: exit code {code}: {capsys.readouterr().err}"


def test_what_is_left_out_is_shown_somewhere() -> None:
    shown = [text for _, text in written_commands()]
    for pattern in LEFT_OUT:
        assert any(re.match(pattern, text) for text in shown), pattern


def test_every_line_of_shell_is_run_or_left_out_for_a_reason() -> None:
    """GIVEN a line of shell WHEN it is no command of fleetloc THEN its program is one that is named."""
    programs = set()
    for block in blocks():
        if block.language == "sh" and block.page not in SHELLS_OF_SIMULATORS:
            for line in block.text.replace("\\\n", " ").splitlines():
                if line.strip():
                    programs.add(line.split()[0])
    others = {program for program in programs if Path(program).name != "fleetloc"}
    assert others == OTHER_PROGRAMS.keys()
    assert sum(1 for _ in shell_lines()) > 80
