"""What a driver of a UWB module needs: one object that publishes ranges to the daemon of its own drone."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from agent.errors import ConfigError
from agent.radio.security import driver_session
from fleetloc.whole_config import load_whole
from transport.link.session import Handlers, Session, open_session
from transport.link.streams import Stream, key_expression
from transport.messages.detection_body import Detection, DetectionFrame, encode_detections
from transport.messages.uwb_body import UwbFrame, UwbRange, encode_uwb_json


class UwbDriver:
    """Publishes the ranges of one drone's UWB module; an asynchronous context.

    ::

        async with UwbDriver("fleet.toml", 1) as driver:
            driver.publish([UwbRange(2, 12.34, sigma_m=0.1)], taken_ns=time.monotonic_ns())

    It dials the drone's daemon, again and again where that is not there yet, and seals frames and uses certificates
    as the security profile asks.
    """

    def __init__(self, config_file: str | Path, agent_id: int) -> None:
        """Read the fleet's configuration and the drone's keys; raises `ConfigError`, `KeyFileError`."""
        self._config = load_whole(config_file)
        if agent_id not in self._config.ids:
            expected = f"the id of a drone of the fleet, one of {', '.join(map(str, self._config.ids))}"
            raise ConfigError(str(config_file), "agents", expected, str(agent_id))
        self.agent_id = agent_id
        self.frames = 0
        """Frames made so far; the next one's sequence number."""
        self._settings = driver_session(self._config, agent_id, Path(config_file).parent)
        self._session: Session | None = None

    @property
    def key(self) -> str:
        """The Zenoh key that frames are published on, ``cl/v1/FLEET/agent/001/uwb``."""
        return key_expression(self._config.fleet.name, self.agent_id, Stream.UWB)

    async def __aenter__(self) -> Self:
        """Open the session; raises `SessionError`."""
        handlers = Handlers(lambda *_: None)
        name, ids = self._config.fleet.name, self._config.ids
        self._session = await open_session(self._settings, name, self.agent_id, ids, handlers)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        if self._session is not None:
            await self._session.close()
            self._session = None

    def publish(
        self,
        ranges: Sequence[UwbRange],
        taken_ns: int | None = None,
        clock: Literal["mono", "unix", "none"] = "mono",
    ) -> bool:
        """Publish what the module measured at one instant; False if the session could not take it.

        ``taken_ns`` on ``clock``: ``mono`` is ``time.monotonic_ns()`` of this very host, ``unix`` UTC, ``none`` takes
        the arrival; by default now. Raises `EncodeError` (a `ValueError`) for ranges that make no frame, and
        `RuntimeError` outside of the context.
        """
        taken_ns = _now_ns(clock) if taken_ns is None else taken_ns
        return self._put(encode_uwb_json(UwbFrame(self.frames, clock, taken_ns, tuple(ranges), self.agent_id)))

    def publish_detections(
        self,
        detections: Sequence[Detection],
        taken_ns: int | None = None,
        clock: Literal["mono", "unix", "none"] = "mono",
        axes: Literal["body", "ned"] = "body",
    ) -> bool:
        """The same of what a camera saw of targets, in ``axes`` of the drone's body, FRD, or NED."""
        taken_ns = _now_ns(clock) if taken_ns is None else taken_ns
        frame = DetectionFrame(self.frames, clock, taken_ns, tuple(detections), self.agent_id, axes)
        return self._put(encode_detections(frame))

    def _put(self, frame: bytes) -> bool:
        if self._session is None:
            raise RuntimeError("publish within `async with UwbDriver(...) as driver`")
        self.frames += 1
        return self._session.publish(Stream.UWB, frame)


def _now_ns(clock: Literal["mono", "unix", "none"]) -> int:
    return time.time_ns() if clock == "unix" else time.monotonic_ns()
