"""What the image, the compose files and the systemd unit name is there: files of ours, commands, options.

Nothing is built or started here; `make test-compose` does that where there is a container engine.
"""

from __future__ import annotations

import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from agent.exit_codes import ExitCode
from fleetloc.cli import build_app
from fleetloc.whole_config import load_whole
from tests.support.command_names import complaint

ROOT = Path(__file__).parents[1]
DOCKERFILE = ROOT / "Dockerfile"
UNIT = ROOT / "deploy" / "systemd" / "fleetloc@.service"
COMPOSE = ("docker-compose.yml", "docker-compose.lossy.yml")
IN_THE_IMAGE = "/etc/fleetloc/"
"""Where the image has what is in ``configs``."""
SCRIPTS = {"/opt/fleetloc/linger.sh": "docker/linger.sh", "/usr/local/bin/lossy_radio": "docker/lossy_radio.sh"}


def copied() -> Iterator[tuple[str, str]]:
    """(source, target) of everything that the image takes out of the tree."""
    text = DOCKERFILE.read_text().replace("\\\n", " ")
    for line in re.findall(r"^COPY (?!--from)(.+)$", text, re.MULTILINE):
        *sources, target = line.split()
        yield from ((source, target) for source in sources)


def tracked() -> set[str]:
    """The files and folders of the tree as a fresh clone has them."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    files = [Path(line) for line in listed.stdout.splitlines()]
    return {str(each) for file in files for each in (file, *file.parents)}


def services(name: str) -> dict[str, dict[str, Any]]:
    """The services of a compose file, variables at their defaults."""
    text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", (ROOT / name).read_text())
    found: dict[str, dict[str, Any]] = yaml.safe_load(text)["services"]
    return found


def commands() -> Iterator[tuple[str, list[str]]]:
    """(where, words after ``fleetloc``) of every command that a recipe starts."""
    for name in COMPOSE:
        for service, table in services(name).items():
            if "radio" not in service and "command" in table:
                yield f"{name}: {service}", table["command"]
    unit = UNIT.read_text()
    for line in re.findall(r"^Exec\w+=/opt/fleetloc/bin/fleetloc (.+)$", unit, re.MULTILINE):
        yield UNIT.name, shlex.split(line)
    health = re.search(r"CMD (\[.+\])", DOCKERFILE.read_text())
    assert health is not None
    words = yaml.safe_load(health[1])
    assert words[0] == "fleetloc"
    yield "HEALTHCHECK", words[1:]


def test_everything_that_the_image_copies_is_in_the_tree_and_let_through() -> None:
    known, let_through = tracked(), (ROOT / ".dockerignore").read_text().splitlines()
    for source, _ in copied():
        assert source in known, f"COPY {source}: no such file or folder in the tree"
        assert f"!{source.split('/')[0]}" in let_through, f"COPY {source}: .dockerignore keeps it out"
    # the package needs every folder that it is built from, and the links of fleetloc/data their targets
    sources = {source for source, _ in copied()}
    assert {"estimators", "transport", "agent", "sim_bridge", "fleetloc", "configs", "deploy", "setup.py"} <= sources


def test_the_scripts_that_recipes_start_are_copied_to_where_they_are_started() -> None:
    targets = {target: source for source, target in copied()}
    assert {script: targets.get(script) for script in SCRIPTS} == SCRIPTS
    assert targets["/etc/fleetloc"] == "configs"
    started = {table["entrypoint"][1] for table in services(COMPOSE[0]).values() if "entrypoint" in table}
    assert started <= SCRIPTS.keys()
    assert f'ENTRYPOINT ["/bin/sh", "{list(SCRIPTS)[1]}"]' in DOCKERFILE.read_text()


def test_the_commands_of_the_recipes_exist() -> None:
    app = typer.main.get_command(build_app())
    found = list(commands())
    assert len(found) > 10
    wrong = [f"{where}: {says}" for where, words in found if (says := complaint(app, shlex.join(words)))]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", [*COMPOSE, "docs/operating.md"])
def test_the_configurations_that_recipes_name_are_in_the_image(name: str) -> None:
    named = set(re.findall(rf"{IN_THE_IMAGE}([\w/]+\.toml)", (ROOT / name).read_text())) - {"fleet.toml"}
    assert named
    missing = [each for each in named if not (ROOT / "configs" / each).is_file()]
    assert not missing


def test_a_fleet_in_containers_has_a_service_for_every_drone_and_answers_its_health_check() -> None:
    names, health = services(COMPOSE[0]), dict(commands())["HEALTHCHECK"]
    for file, count in (("compose3.toml", 3), ("compose5.toml", 5)):
        config = load_whole(ROOT / "configs" / file)
        assert len(config.ids) == count
        for agent_id in config.ids:
            words = names[f"agent{agent_id}"]["command"]
            assert words[words.index("--id") + 1] == str(agent_id)
        assert config.health.socket == health[1]


def test_the_unit_does_not_start_anew_what_would_fail_again() -> None:
    found = re.search(r"^RestartPreventExitStatus=(.+)$", UNIT.read_text(), re.MULTILINE)
    assert found is not None
    assert {int(code) for code in found[1].split()} == {ExitCode.BAD_INPUT, ExitCode.KEYS}
