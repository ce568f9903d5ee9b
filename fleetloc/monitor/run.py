"""The shell of the monitor: listener, picture, terminal and web server, until it is told to stop."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
from rich.console import Console
from rich.live import Live

from agent.config.tables import FleetConfig
from fleetloc.monitor import table
from fleetloc.monitor.listener import FleetListener
from fleetloc.monitor.monitor_table import monitor_table
from fleetloc.monitor.picture import FleetPicture
from fleetloc.monitor.views import Picture
from fleetloc.monitor.web import Board, WebServer
from transport.messages.estimate_body import FleetEstimate
from transport.messages.far_body import FarReports
from transport.messages.report_body import Diagnostics
from transport.security.opening import Received

REFRESH_S = 0.2
"""The picture is renewed this often."""
LINE_PERIOD_S = 10.0
TERMINAL_PERIOD_S = 0.5
FIRST_PRINT_S = 1.5
TRACKS_TIMEOUT_S = 5.0
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class LiveMonitor:
    """Made for one `run`; ``picture`` is there to be looked at."""

    def __init__(
        self,
        config: FleetConfig,
        base: Path,
        *,
        endpoints: Sequence[str] = (),
        web: bool = True,
        terminal: bool = True,
        console: Console | None = None,
    ) -> None:
        """Read keys and certificates; raises `SecurityError`, `KeyFileError`, `SettingsError`."""
        self._config = config
        self._settings = monitor_table(config)
        self._web, self._terminal = web, terminal
        self._console = console or Console()
        self.picture = FleetPicture(config)
        self._listener = FleetListener(config, base, self._on_message, self.picture.on_presence, endpoints)
        self._board = Board()
        self._where = ""
        self._stop = asyncio.Event()

    def stop(self) -> None:
        """End `run`; what a signal does."""
        self._stop.set()

    async def run(self, duration_s: float | None = None) -> None:
        """Show the fleet until stopped, or for so long; raises `EnvironmentFault`, `SessionError`."""
        loop = asyncio.get_running_loop()
        for number in STOP_SIGNALS:
            loop.add_signal_handler(number, self.stop)
        server: WebServer | None = None
        shower: asyncio.Task[None] | None = None
        try:
            if self._web:
                where = self._settings
                server = WebServer(where.host, where.port, self._board, self._tracks(loop))
                server.start()
                self._where = server.url
                self._say(f"web page at {server.url}")
            await self._listener.open()
            shower = asyncio.create_task(self._show(), name="show")
            shower.add_done_callback(lambda _: self.stop())
            await asyncio.wait_for(self._stop.wait(), duration_s)
        except TimeoutError:
            return  # the time is over
        finally:
            if shower is not None:
                shower.cancel()
                await asyncio.gather(shower, return_exceptions=True)
            if server is not None:
                await asyncio.to_thread(server.close)
            await self._listener.close()
            for number in STOP_SIGNALS:
                loop.remove_signal_handler(number)
        if not shower.cancelled():
            shower.result()  # it ended by itself: say why

    # --- in -------------------------------------------------------------------------------------------------

    def _on_message(self, received: Received) -> None:
        if isinstance(received.message, FleetEstimate):
            self.picture.on_estimate(received.sender, received.message, received.received_s)
        elif isinstance(received.message, FarReports):
            self.picture.on_far_reports(received.sender, received.message, received.received_s)
        elif isinstance(received.message, Diagnostics):
            self.picture.on_diagnostics(received.message, received.received_s)

    # --- out ------------------------------------------------------------------------------------------------

    def _now(self) -> Picture:
        now_s = time.monotonic()
        self.picture.on_refused(self._listener.refusals(), now_s)
        return self.picture.at(now_s, time.time())

    def _tracks(self, loop: asyncio.AbstractEventLoop) -> Callable[[], bytes]:
        async def read() -> bytes:
            return msgspec.json.encode(self.picture.tracks())

        return lambda: asyncio.run_coroutine_threadsafe(read(), loop).result(TRACKS_TIMEOUT_S)

    async def _show(self) -> None:
        """Renew the picture on all screens."""
        if self._terminal and self._console.is_terminal:
            with Live(console=self._console, auto_refresh=False) as live:
                await self._refresh(
                    TERMINAL_PERIOD_S, lambda now: live.update(table.table(now, self._where), refresh=True)
                )
        else:
            await self._refresh(LINE_PERIOD_S, self._print)

    async def _refresh(self, terminal_period_s: float, print_: Callable[[Picture], None]) -> None:
        next_print_s = time.monotonic() + FIRST_PRINT_S  # all had time to show themselves
        while True:
            now = self._now()
            self._board.show(msgspec.json.encode(now))
            if self._terminal and time.monotonic() >= next_print_s:
                next_print_s = time.monotonic() + terminal_period_s
                print_(now)
            await asyncio.sleep(REFRESH_S)

    def _print(self, picture: Picture) -> None:
        for line in table.lines(picture):
            self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _say(self, sentence: str) -> None:
        self._console.print(f"fleetloc: {sentence}", markup=False, highlight=False, soft_wrap=True)
