"""The monitor as users run it: a process beside a fleet of processes, looked at with a browser."""

from __future__ import annotations

import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from fleetloc.errors import EnvironmentFault
from fleetloc.monitor.web import MAX_VIEWERS, Board, WebServer, page
from tests.support import chromium
from tests.support.beacon import ROOT, beacons
from tests.support.fleet_process import until
from tests.support.machine import Witness, witnessed
from tests.support.ports import bound

PATIENCE_S = 60.0
LOST_WITHIN_S = 3.0

needs_browser = pytest.mark.skipif(
    chromium.program() is None, reason="NO CHROMIUM on this machine: the web page was not looked at (set CHROMIUM)"
)


def fleet_file(folder: Path, security: str) -> Path:
    """The file of a fleet of three on free ports."""
    with ExitStack() as stack:
        listen = [stack.enter_context(bound(socket.SOCK_STREAM)) for _ in range(3)]
    link = "tls" if 'profile = "field"' in security else "tcp"
    agents = "\n".join(
        f'[[agents]]\nid = {i}\nmavlink = "udpin:127.0.0.1:{24550 + i}"\nlisten = ["{link}/127.0.0.1:{port}"]'
        for i, port in enumerate(listen, 1)
    )
    path = folder / "fleet.toml"
    path.write_text(
        '[fleet]\nname = "watched"\n[fleet.origin]\nlat_deg = 47.0\nlon_deg = 8.0\nalt_m = 500\n'
        f"{agents}\n[security]\n{security}\n[monitor]\nport = 0\n"
    )
    return path


@contextmanager
def monitor(config: Path) -> Iterator[str]:
    """A monitor without terminal; gives the address of its page, and ends it as Ctrl-C does."""
    command = [sys.executable, "-m", "fleetloc", "monitor", str(config), "--no-table"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"http://\S+/", line)
        assert found, line
        yield found[0]
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def picture(url: str) -> dict[str, Any]:
    """The monitor's picture of this moment."""
    host, port = url.removeprefix("http://").rstrip("/").split(":")
    with get((host, int(port)), "/picture.json") as answer:
        assert answer.status == 200
        shown: dict[str, Any] = json.loads(answer.read())
    return shown


def statuses(url: str) -> list[str]:
    return [drone["status"] for drone in picture(url).get("drones", [])]


def keys(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "fleetloc", "keys", *arguments], cwd=ROOT, check=True, timeout=120)


@needs_browser
@pytest.mark.slow
@pytest.mark.realtime
def test_the_page_loads_updates_and_shows_a_killed_drone_within_three_seconds(tmp_path: Path) -> None:
    # GIVEN three drones, a monitor, and its page in a browser
    config = fleet_file(tmp_path, 'mode = "unsigned"')
    with beacons(config, (1, 2, 3)) as drones, monitor(config) as url, chromium.browser(tmp_path / "profile") as seen:
        seen.open(url)
        status = "[...document.querySelectorAll('#drones tbody tr')].map(row => row.dataset.status).join()"
        until(lambda: seen.value(status) == "ok,ok,ok", "three drones on the page", PATIENCE_S)
        # THEN the map shows them with their ellipses, and moves
        assert seen.value("document.querySelectorAll('#top .drone .ellipse').length") == 3
        assert seen.value("document.getElementById('overall').textContent") == "all well"
        place = "document.querySelector('#drones tbody tr').cells[2].textContent"
        first = seen.value(place)
        until(lambda: seen.value(place) != first, "a drone that moves", PATIENCE_S)
        # WHEN one is killed
        with witnessed(tmp_path) as witness:
            killed_s = time.time()
            drones[2].kill()
            until(lambda: seen.value(status) == "ok,lost,ok", "a lost drone", PATIENCE_S)
            lost_s = time.time()
        # THEN the page shows it in time, as an alarm, in the table and on the map
        assert lost_s - killed_s < LOST_WITHIN_S + Witness(witness).lost_s(killed_s, lost_s)
        until(lambda: seen.value("document.querySelectorAll('#top .cross').length") == 1, "its cross", PATIENCE_S)
        assert "lost" in seen.value("document.querySelector('#alarms li.bad[data-drone=\"2\"]').textContent")
        assert seen.complaints == []


@needs_browser
@pytest.mark.slow
@pytest.mark.realtime
def test_a_narrow_window_still_has_a_map_and_the_page_follows_the_system_to_dark(tmp_path: Path) -> None:
    config = fleet_file(tmp_path, 'mode = "unsigned"')
    theme = "document.documentElement.dataset.theme"
    with monitor(config) as url, chromium.browser(tmp_path / "profile") as seen:
        seen.open(url, width=420, height=900)
        until(lambda: seen.value(theme) == "light", "the page", PATIENCE_S)
        assert seen.value("document.getElementById('top').getBoundingClientRect().height") > 400
        # WHEN the system turns dark THEN the page does, until somebody chooses, who is remembered
        seen.open(url, dark=True)
        until(lambda: seen.value(theme) == "dark", "the dark page", PATIENCE_S)
        seen.value("document.getElementById('theme').click()")
        seen.open(url, width=421, dark=True)
        until(lambda: seen.value("innerWidth") == 421 and seen.value(theme) is not None, "it again", PATIENCE_S)
        assert seen.value(theme) == "light"
        assert seen.complaints == []


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("security", ['profile = "field"', 'profile = "lossy_field"\nencrypt = true'])
def test_the_monitor_sees_a_secured_fleet_with_the_observers_files_alone(tmp_path: Path, security: str) -> None:
    # GIVEN a fleet with keys, and a laptop that has the observer's and everybody's public ones
    config = fleet_file(tmp_path, security)
    laptop = tmp_path / "laptop"
    laptop.mkdir()
    keys("init", str(config))
    keys("export", str(config), "--observer", "--out", str(laptop / "keys"))
    assert not list((laptop / "keys").glob("agent_*.[!p]*"))  # nobody's secret
    (laptop / config.name).write_bytes(config.read_bytes())
    # THEN it sees the fleet
    with beacons(config, (1, 2, 3)), monitor(laptop / config.name) as url:
        until(lambda: statuses(url) == ["ok"] * 3, "three drones", PATIENCE_S)
        assert picture(url)["refused"] == {}


class Recorder:
    """In the place of a Zenoh session: notes what is declared."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, str]] = []

    def __getattr__(self, name: str) -> Any:
        def call(key: object = "", *_: object, **__: object) -> Recorder:
            self.calls.append((name, str(key)))
            return self

        return call


async def test_the_monitor_declares_subscribers_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from agent.config.reading import load_config
    from fleetloc.monitor.listener import FleetListener

    recorder = Recorder()
    monkeypatch.setattr("zenoh.open", lambda _: recorder)
    config = load_config(fleet_file(tmp_path, 'mode = "unsigned"'))
    listener = FleetListener(config, tmp_path, lambda _: None, lambda *_: None)
    await listener.open()
    declared = [name for name, _ in recorder.calls if name not in ("liveliness", "undeclare", "close")]
    assert declared == ["declare_subscriber"] * 7  # est and diag of three drones, and who is there
    await listener.close()
    assert {name for name, _ in recorder.calls} == {"declare_subscriber", "liveliness", "undeclare", "close"}


# --- the server -----------------------------------------------------------------------------------------------------


@contextmanager
def server() -> Iterator[tuple[WebServer, Board, tuple[str, int]]]:
    board = Board()
    running = WebServer("127.0.0.1", 0, board, lambda: b"{}")
    running.start()
    try:
        host, port = re.fullmatch(r"http://(.+):(\d+)/", running.url).groups()  # type: ignore[union-attr]
        yield running, board, (host, int(port))
    finally:
        running.close()


@contextmanager
def get(address: tuple[str, int], path: str, **headers: str) -> Iterator[http.client.HTTPResponse]:
    with closing(http.client.HTTPConnection(*address, timeout=PATIENCE_S)) as connection:
        connection.request("GET", path, headers=headers)
        with connection.getresponse() as answer:
            yield answer


def test_the_page_is_one_file_that_asks_nobody_else_for_anything() -> None:
    html, policy = page()
    assert not re.search(rb"""(src|href)=["'](?!data:)""", html)
    assert set(re.findall(rb"https?://[^\s\"']+", html)) == {b"http://www.w3.org/2000/svg"}
    assert "default-src 'none'" in policy
    with server() as (_, _, address), get(address, "/") as answer:
        assert answer.read() == html
        assert answer.headers["Content-Security-Policy"] == policy


@pytest.mark.parametrize(
    ("path", "host", "status"),
    [
        ("/", "evil.example:80", 421),
        ("/events", "evil.example", 421),
        ("/", "localhost:1", 200),
        ("/", "127.0.0.1", 200),
        ("/../../etc/passwd", "localhost", 404),
        ("/picture.json", "[::1]:8470", 200),
    ],
)
def test_only_our_own_name_and_paths_are_answered(path: str, host: str, status: int) -> None:
    with server() as (_, _, address), get(address, path, Host=host) as answer:
        assert answer.status == status


def test_events_bring_the_tracks_and_then_every_newest_picture() -> None:
    with server() as (_, board, address):
        board.show(b'{"n": 1}')
        with get(address, "/events") as answer:
            read = [answer.readline() for _ in range(6)]
            assert read == [b"event: tracks\n", b"data: {}\n", b"\n", b"event: picture\n", b'data: {"n": 1}\n', b"\n"]
            board.show(b'{"n": 2}')
            assert [answer.readline() for _ in range(2)] == [b"event: picture\n", b'data: {"n": 2}\n']


def test_more_viewers_than_the_machine_bears_are_told_so() -> None:
    with server() as (_, _, address), ExitStack() as open_pages:
        answers = [open_pages.enter_context(get(address, "/events")).status for _ in range(MAX_VIEWERS + 1)]
        assert answers == [200] * MAX_VIEWERS + [503]


def test_a_port_that_is_taken_is_named() -> None:
    with bound(socket.SOCK_STREAM) as port, pytest.raises(EnvironmentFault, match=rf"monitor\.port .*:{port}: "):
        WebServer("127.0.0.1", port, Board(), lambda: b"{}")


def test_closing_the_server_ends_its_threads() -> None:
    with server() as (_, _, address), get(address, "/events") as answer:
        answer.readline()
    until(lambda: not any("process_request" in thread.name for thread in threading.enumerate()), "no thread", 10.0)
