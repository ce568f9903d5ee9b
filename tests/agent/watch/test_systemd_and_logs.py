"""What the service manager hears, and log files that stay within their limits; the disk is the test's."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.config.observer_tables import LogTable
from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.errors import ConfigError, LogFileError
from agent.exit_codes import ExitCode
from agent.mavlink.adsb import AdsbReporter
from agent.watch.health import Health, State
from agent.watch.log_lines import LimitedLogFile, configure_logging, level_of, log_file
from agent.watch.metrics import Metrics
from agent.watch.observer_list import observers_of
from agent.watch.observers import DaemonState
from agent.watch.systemd import ServiceManager


def state_of(state: State, *reasons: str) -> DaemonState:
    return DaemonState(7, 12.5, Health(state, reasons), {}, {}, {})


class Manager:
    """A service manager's end of the socket."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.setblocking(False)

    def heard(self) -> list[str]:
        messages = []
        while True:
            try:
                messages.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return messages


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    one = Manager(str(tmp_path / "notify"))
    yield one
    one.socket.close()


def test_the_unit_gives_up_only_where_another_start_cannot_help() -> None:
    unit = (Path(__file__).parents[3] / "deploy" / "systemd" / "fleetloc@.service").read_text()
    (codes,) = (line for line in unit.splitlines() if line.startswith("RestartPreventExitStatus="))
    final = {ExitCode(int(code)) for code in codes.partition("=")[2].split()}
    assert final == {ExitCode.BAD_INPUT, ExitCode.KEYS}
    assert "Restart=always" in unit


async def test_a_watched_service_says_ready_alive_and_stopping(tmp_path: Path, manager: Manager) -> None:
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "42"}
    service = ServiceManager.of(environment, process_id=42)
    assert service is not None
    await service.open()
    service.on_second(state_of(State.DEGRADED, "no GPS"))
    service.on_second(state_of(State.DEGRADED, "no GPS"))
    await service.close(state_of(State.DEGRADED))
    expected = ["READY=1", "WATCHDOG=1\nSTATUS=agent 7: degraded: no GPS", "WATCHDOG=1", "STOPPING=1"]
    assert manager.heard() == expected


WATCHES: list[dict[str, str]] = [{}, {"WATCHDOG_USEC": "9000000", "WATCHDOG_PID": "41"}, {"WATCHDOG_USEC": "x"}]


async def test_the_watchdog_is_fed_when_no_descriptor_is_left(
    tmp_path: Path, manager: Manager, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "10000000"}
    told = ServiceManager.of(environment)
    assert told is not None
    await told.open()
    with monkeypatch.context() as patch:
        patch.setattr(socket, "socket", lambda *_: (_ for _ in ()).throw(OSError(24, "Too many open files")))
        told.on_second(state_of(State.OK))
        await told.close(state_of(State.OK))
    assert manager.heard() == ["READY=1", "WATCHDOG=1\nSTATUS=agent 7: ok", "STOPPING=1"]
    assert told.failed == 0


@pytest.mark.parametrize(
    ("health", "level"),
    [
        (Health(State.OK, ()), logging.INFO),
        (Health(State.ALIGNING, ()), logging.INFO),
        (Health(State.ALIGNING, ("not observable",), alarm=True), logging.WARNING),
        (Health(State.DEGRADED, ("no GPS",)), logging.WARNING),
        (Health(State.FAULT, ("position unknown",)), logging.ERROR),
        (Health(State.DEGRADED, ("not observable",), alarm=True), logging.ERROR),
    ],
)
def test_what_may_not_be_used_is_told_as_an_error(health: Health, level: int) -> None:
    assert level_of(health) == level


@pytest.mark.parametrize("watch", WATCHES)
async def test_a_foreign_watchdog_is_not_fed(tmp_path: Path, manager: Manager, watch: dict[str, str]) -> None:
    service = ServiceManager.of({"NOTIFY_SOCKET": str(tmp_path / "notify"), **watch}, process_id=42)
    assert service is not None
    service.on_second(state_of(State.OK))
    service.on_second(state_of(State.OK))
    await service.close(state_of(State.OK))
    assert manager.heard() == ["STATUS=agent 7: ok", "STOPPING=1"]


def test_a_watchdog_without_patience_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    ServiceManager.of({"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "500000"}, process_id=1)
    assert "WatchdogSec of 0.5 s: expected 3 s or more" in caplog.text


async def test_an_abstract_socket_is_reached_and_one_that_is_gone_is_only_counted(tmp_path: Path) -> None:
    name = f"@fleetloc-test-{tmp_path.name}-{id(tmp_path)}"
    manager = Manager(f"\0{name[1:]}")
    service = ServiceManager.of({"NOTIFY_SOCKET": name})
    assert service is not None
    await service.open()
    assert manager.heard() == ["READY=1"]
    manager.socket.close()
    service.on_second(state_of(State.OK))
    assert service.failed == 1
    await service.close(state_of(State.OK))


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1234"}])
def test_without_a_manager_there_is_nobody_to_tell(environment: dict[str, str]) -> None:
    assert ServiceManager.of(environment) is None


# --- who is asked for -----------------------------------------------------------------------------------------------


def fleet(**tables: object) -> FleetConfig:
    document = {
        "fleet": {"name": "seen", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 500.0}},
        "agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:24551"}],
    }
    return config_from(document | tables, "test")


def test_nobody_looks_on_unless_asked_for_and_the_manager_hears_ready_last(tmp_path: Path) -> None:
    assert observers_of(fleet(), 1, tmp_path, {}) == []
    asked = fleet(metrics={"base_port": 9400}, adsb={"address": "udpout:127.0.0.1:14550"})
    found = observers_of(asked, 1, tmp_path, {"NOTIFY_SOCKET": "/run/notify"})
    assert [type(one) for one in found] == [Metrics, AdsbReporter, ServiceManager]


def test_a_field_fleet_sends_no_unsigned_traffic_over_the_air(tmp_path: Path) -> None:
    tables = {"security": {"profile": "field"}, "mavlink": {"signing": "off"}}
    observers_of(fleet(**tables, adsb={"address": "udpout:127.0.0.1:14550"}), 1, tmp_path, {})
    with pytest.raises(ConfigError, match=r"mavlink\.signing: expected .* for adsb\.address"):
        observers_of(fleet(**tables, adsb={"address": "udpout:192.168.7.1:14550"}), 1, tmp_path, {})


# --- log files ------------------------------------------------------------------------------------------------------


def line(handler: logging.Handler, text: str, created_s: float = 0.0) -> None:
    record = logging.LogRecord("fleetloc", logging.INFO, "", 0, text, None, None)
    record.created = created_s
    handler.handle(record)


def test_a_file_that_is_full_is_put_aside_and_the_oldest_goes(tmp_path: Path) -> None:
    handler = LimitedLogFile(tmp_path / "a.log", max_bytes=100, keep=2, min_free_bytes=0)
    for number in range(40):
        line(handler, f"line {number:02d} of twenty bytes", float(number))
    handler.close()
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == ["a.log", "a.log.1", "a.log.2"]
    assert all((tmp_path / name).stat().st_size <= 100 for name in files)
    assert "line 39" in (tmp_path / "a.log").read_text()


def test_a_disk_that_fills_up_costs_old_files_first_and_then_lines_that_are_counted(tmp_path: Path) -> None:
    # GIVEN a disk with room for two of three files put aside
    for number in (1, 2, 3):
        (tmp_path / f"a.log.{number}").write_text("old")
    free = {"bytes": 100}

    def left(folder: Path) -> int:
        return free["bytes"] - 10 * len(list(folder.glob("a.log.*")))

    handler = LimitedLogFile(tmp_path / "a.log", max_bytes=10_000, keep=3, min_free_bytes=80, free=left)
    line(handler, "first", 0.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.log", "a.log.1", "a.log.2"]
    # WHEN others fill it up
    free["bytes"] = 50
    line(handler, "second", 2.0)
    line(handler, "third", 2.1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.log"]
    assert handler.dropped == 2
    # THEN the log says what is missing once there is room again
    free["bytes"] = 1000
    line(handler, "fourth", 3.5)
    handler.close()
    assert (tmp_path / "a.log").read_text().splitlines() == [
        "first", "2 lines lost: the disk was nearly full", "fourth",
    ]  # fmt: skip


def test_a_folder_that_went_away_stops_nobody(tmp_path: Path) -> None:
    def gone(folder: Path) -> int:
        raise FileNotFoundError(folder)

    handler = LimitedLogFile(tmp_path / "a.log", max_bytes=100, keep=1, min_free_bytes=1, free=gone)
    line(handler, "unheard", 1.0)
    handler.close()
    assert handler.dropped == 1


def test_the_log_goes_to_the_file_of_its_agent(tmp_path: Path) -> None:
    assert log_file(LogTable(), 3) is None
    handler = log_file(LogTable(directory=str(tmp_path / "log")), 3)
    configure_logging(1, handler)
    logging.getLogger("fleetloc.agent").info("agent 3: ok")
    configure_logging(1)  # closes it
    assert "INFO agent 3: ok" in (tmp_path / "log" / "agent_003.log").read_text()


def test_a_log_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LogFileError, match=r"log .*agent_003\.log: cannot be written"):
        log_file(LogTable(directory=str(tmp_path / "file")), 3)
