"""The sessions over which simulated UWB modules bring their ranges to the agents, as a drone's own driver does."""

from __future__ import annotations

from pathlib import Path

from agent.config.tables import FleetConfig
from agent.radio.security import driver_session, is_field
from transport.errors import TransportError
from transport.link.session import Handlers, Session, open_session
from transport.link.session_settings import SessionSettings
from transport.link.streams import Stream


def range_session_settings(config: FleetConfig) -> SessionSettings:
    """Zenoh settings of the UWB drivers' session on plain links: dials every agent, listens nowhere."""
    endpoints = (endpoint for agent in config.ids for endpoint in config.device_endpoints(agent))
    return SessionSettings(connect=tuple(dict.fromkeys(endpoints)))


class RangeSessions:
    """The UWB drivers' sessions with their agents, which they dial.

    One session for all in `lab`, where nobody asks who it is; in the field profiles one for each agent, with its
    certificate or its seal.
    """

    def __init__(self, sessions: dict[int, Session]) -> None:
        self._sessions = sessions

    def publish(self, observer: int, payload: bytes) -> bool:
        """Put ranges that an agent measured on its key; whether they were taken."""
        return self._sessions[observer].publish(Stream.UWB, payload, agent_id=observer)

    async def close(self) -> None:
        """Leave."""
        for session in dict.fromkeys(self._sessions.values()):
            await session.close()


async def open_range_sessions(
    config: FleetConfig, base: Path, settings: SessionSettings | None = None
) -> RangeSessions:
    """The sessions of all UWB drivers, or with ``settings`` one of these; keys are looked for relative to ``base``.

    Raises `SessionError`, `KeyFileError`.
    """
    fleet, handlers = config.fleet.name, Handlers(lambda _key, _payload, _arrived_s: None)
    if settings is not None or not is_field(config):
        settings = settings or range_session_settings(config)
        session = await open_session(settings, fleet, None, config.ids, handlers)
        return RangeSessions(dict.fromkeys(config.ids, session))
    sessions: dict[int, Session] = {}
    try:
        for agent_id in config.ids:
            own = driver_session(config, agent_id, base)
            sessions[agent_id] = await open_session(own, fleet, agent_id, config.ids, handlers)
    except TransportError:
        await RangeSessions(sessions).close()
        raise
    return RangeSessions(sessions)
