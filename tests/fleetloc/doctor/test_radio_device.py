"""What `fleetloc doctor` says of the radio's device."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.config.tables import FleetConfig
from fleetloc.doctor.examination import Mark
from fleetloc.doctor.radio_device import SOLICIT, device_of, of_radio
from tests.fleetloc.doctor.test_doctor import fleet

LOOPBACK_DEVICE = device_of("127.0.0.1")

pytestmark = pytest.mark.skipif(LOOPBACK_DEVICE is None, reason="no device of this machine has 127.0.0.1")


def with_radio(address: str, link: str) -> FleetConfig:
    agent = {"id": 1, "mavlink": "udpin:127.0.0.1:14561", "radio": address}
    return fleet(agents=[agent], transport={"link": link})


def settings(folder: Path, questions: int) -> Path:
    """As the kernel shows them for the loopback device."""
    device = folder / str(LOOPBACK_DEVICE)
    device.mkdir()
    for kind in SOLICIT:
        (device / kind).write_text(f"{questions}\n")
    return folder


def test_a_kernel_that_soon_gives_up_is_told_with_the_remedy(tmp_path: Path) -> None:
    [line] = of_radio(with_radio("127.0.0.1", "udp"), 1, settings(tmp_path, 3))

    assert line.mark is Mark.UNWISE
    assert f"sysctl -w net.ipv4.neigh.{LOOPBACK_DEVICE}.ucast_solicit=10 net.ipv4.neigh" in line.to_do


@pytest.mark.parametrize(("link", "questions"), [("udp", 10), ("tcp", 3)])
def test_a_patient_kernel_and_a_link_that_sends_again_are_well(tmp_path: Path, link: str, questions: int) -> None:
    [line] = of_radio(with_radio("127.0.0.1", link), 1, settings(tmp_path, questions))

    assert (line.mark, line.found) == (Mark.GOOD, f"127.0.0.1 is {LOOPBACK_DEVICE}")


def test_an_address_of_somebody_else_is_wrong(tmp_path: Path) -> None:
    [line] = of_radio(with_radio("192.0.2.1", "udp"), 1, settings(tmp_path, 10))

    assert (line.mark, "192.0.2.1" in line.found) == (Mark.WRONG, True)


def test_nothing_is_said_without_a_radio_or_where_the_system_does_not_tell(tmp_path: Path) -> None:
    assert of_radio(fleet(), 1, settings(tmp_path, 3)) == []
    assert of_radio(with_radio("127.0.0.1", "udp"), 1, tmp_path / "none") == []
