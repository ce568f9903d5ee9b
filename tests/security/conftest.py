"""A fleet of three with keys that the command made, for everything that attacks it."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.config.reading import load_config
from agent.config.tables import FleetConfig
from fleetloc import cli
from tests.support.fleet_process import on_free_ports

PROFILES = Path(__file__).parents[2] / "configs" / "security"
MakeFleet = Callable[..., tuple[FleetConfig, Path]]


@pytest.fixture(scope="session")
def keys_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of a profile's configuration with keys as the command makes them; to be copied, not changed."""

    @functools.cache
    def made(profile: str) -> Path:
        folder = tmp_path_factory.mktemp(profile)
        file = folder / "fleet.toml"
        file.write_text((PROFILES / f"{profile}.toml").read_text())
        assert cli.main(["keys", "init", str(file)]) == 0
        return folder

    return made


@pytest.fixture
def make_fleet(
    tmp_path: Path, keys_of: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> MakeFleet:
    """(profile, overrides) -> configuration on free ports and its folder, with keys unless ``keys=False``."""

    def make(profile: str, *overrides: str, keys: bool = True) -> tuple[FleetConfig, Path]:
        folder = tmp_path / profile
        shutil.copytree(keys_of(profile), folder)
        if not keys:
            shutil.rmtree(folder / "keys")
        capsys.readouterr()
        link = "tls" if profile == "field" else "tcp"
        ports = [override.replace("tcp/", f"{link}/") for override in on_free_ports(3)]
        if profile == "lossy_field" and "transport.link=tcp" not in overrides:
            ports = []  # its links are made from transport.base_port; nothing that opens them uses it as it is
        return load_config(folder / "fleet.toml", [*ports, *overrides]), folder

    return make
