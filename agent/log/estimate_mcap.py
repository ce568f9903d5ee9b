"""Estimates in MCAP files (https://mcap.dev) that Foxglove and PlotJuggler open, and the file under them.

Two channels per agent, both JSON with a schema:

======================  ====================================================================================
``/agent_001/estimate``  agent 1's estimate of the whole fleet: NED m and m/s with 1-sigma, age, status
``/agent_001/poses``     the same positions as ``foxglove.PosesInFrame``, for a 3D panel (axes north up: ENU);
                         drones that are no part of the estimate are not there
======================  ====================================================================================

Numbers are written with as many digits as a float64 needs, so what is read is what was estimated, bit by bit.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

from agent.errors import LogFileError
from agent.outputs import EstimateReady
from estimators.integrity.protection.statement import Statement
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Vector
from transport.messages.estimate_body import MAX_AGE_TICKS

SUFFIX = ".mcap"
CHUNK_BYTES = 64 * 1024
"""What a killed process may lose of the file: about a second of flight. Of every chunk the writer keeps 1 kB for its
index until the file is closed."""
ESTIMATE_SCHEMA, POSES_SCHEMA = "fleetloc.FleetEstimate", "foxglove.PosesInFrame"
POSES_FRAME = "fleet_enu"
AXES = ("north", "east", "down")


class Ned(msgspec.Struct, frozen=True):
    """A vector in the fleet's frame; the key it stands under names the unit."""

    north: float
    east: float
    down: float


class AgentEstimate(msgspec.Struct, frozen=True, omit_defaults=True):
    """One agent as another sees it; ``age_s`` of the newest information on it is left out if there is none."""

    position_m: Ned
    velocity_mps: Ned
    position_sigma_m: Ned
    velocity_sigma_mps: Ned
    age_s: float | None = None


class Promise(msgspec.Struct, frozen=True, omit_defaults=True):
    """What an agent promises of its own position (docs/integrity.md); ``off_m``: whose fixes are off, by how much."""

    state: str
    reason: str
    protection_horizontal_m: float
    protection_vertical_m: float
    off_m: dict[str, float] = {}
    relative_horizontal_m: dict[str, float] = {}
    relative_vertical_m: dict[str, float] = {}
    """Protection levels of the positions of others relative to the own one."""
    guaranteed_half_axes_m: dict[str, list[float]] = {}
    """Of the sets that certainly hold those, where there are any."""
    least_range_m: dict[str, float] = {}
    targets: dict[str, str] = {}
    """What is known of each target (`estimators.integrity.protection.targets`)."""


class EstimateMessage(msgspec.Struct, frozen=True, omit_defaults=True):
    """One message of an estimate channel.

    The estimate is of fleet time ``t_s``, the start of its tick, and was out at ``published_s``. ``agents`` by
    `agent_key`. ``inputs``: how many inputs the agent had taken in by then, in a flight log.
    """

    tick: int
    t_s: float
    published_s: float
    status: int
    """`estimators.estimator.Status`."""
    on_time: bool
    agents: dict[str, AgentEstimate]
    inputs: int | None = None
    integrity: Promise | None = None

    def arrays(self) -> tuple[Vector, Vector]:
        """Mean and 1-sigma ``(6n,)`` in NED m and m/s, in the order of the file."""
        seen = self.agents.values()
        mean = [_triple(vector) for a in seen for vector in (a.position_m, a.velocity_mps)]
        sigma = [_triple(vector) for a in seen for vector in (a.position_sigma_m, a.velocity_sigma_mps)]
        return np.array(mean).ravel(), np.array(sigma).ravel()


def _triple(vector: Ned) -> tuple[float, float, float]:
    return vector.north, vector.east, vector.down


def agent_key(agent_id: int) -> str:
    """What an agent is called in topics and messages."""
    return f"agent_{agent_id:03d}"


def estimate_topic(agent_id: int) -> str:
    """Topic of an agent's estimates."""
    return f"/{agent_key(agent_id)}/estimate"


def estimate_message(
    ready: EstimateReady, published_s: float, agents: tuple[int, ...], period_s: float, inputs: int | None = None
) -> EstimateMessage:
    """An estimate as it is recorded; ``agents`` in the order of the blocks of the state."""
    estimate = ready.estimate
    mean = estimate.mean.reshape(len(agents), STATES_PER_AGENT).tolist()
    sigma = np.sqrt(estimate.covariance.diagonal()).reshape(len(agents), STATES_PER_AGENT).tolist()
    known = {
        agent_key(agent_id): AgentEstimate(
            Ned(*mean[slot][:3]),
            Ned(*mean[slot][3:]),
            Ned(*sigma[slot][:3]),
            Ned(*sigma[slot][3:]),
            None if (age := int(estimate.age_ticks[slot])) >= MAX_AGE_TICKS else age * period_s,
        )
        for slot, agent_id in enumerate(agents)
    }
    return EstimateMessage(
        estimate.tick,
        ready.t_s,
        published_s,
        int(estimate.status),
        ready.on_time,
        known,
        inputs,
        None if ready.integrity is None else _promise(ready.integrity),
    )


def _promise(stated: Statement) -> Promise:
    return Promise(
        str(stated.state),
        stated.reason,
        stated.own.horizontal_m,
        stated.own.vertical_m,
        {agent_key(each): off_m for each, off_m in stated.off.items()},
        {agent_key(each): level.horizontal_m for each, level in stated.relative.items()},
        {agent_key(each): level.vertical_m for each, level in stated.relative.items()},
        {agent_key(each): held.half_axes_m.tolist() for each, held in stated.guaranteed.items()},
        {agent_key(each): held.least_range_m for each, held in stated.guaranteed.items()},
        {agent_key(each): str(state) for each, state in stated.targets.items()},
    )


class McapFile:
    """An MCAP file that is appended to; what a killed process leaves can be read to its last whole chunk.

    Raises `OSError` wherever the disk does.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._writer = Writer(stream, chunk_size=CHUNK_BYTES)
        self._writer.start(library="fleetloc")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def add(self, channel: int, unix_ns: int, data: bytes, sequence: int = 0) -> None:
        """Append a message to a channel."""
        self._writer.add_message(channel, unix_ns, data, unix_ns, sequence)

    def channel(self, topic: str, schema: str, definition: dict[str, Any]) -> int:
        """The channel of JSON messages with a JSON schema; made when first asked for."""
        if topic not in self._channels:
            if schema not in self._schemas:
                content = msgspec.json.encode(definition)
                self._schemas[schema] = self._writer.register_schema(schema, SchemaEncoding.JSONSchema, content)
            number = self._writer.register_channel(topic, MessageEncoding.JSON, self._schemas[schema])
            self._channels[topic] = number
        return self._channels[topic]

    def metadata(self, name: str, content: dict[str, str]) -> None:
        """Write named texts, which are there at once."""
        self._writer.add_metadata(name, content)
        self._stream.flush()

    @property
    def size_bytes(self) -> int:
        """Bytes written so far, but for a chunk that is not full yet."""
        return self._stream.tell()

    def flush(self) -> None:
        """Give the operating system what is there, but for a chunk that is not full yet."""
        self._stream.flush()

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._stream.close()


class EstimateChannels:
    """Writes estimates to a file that also holds other things."""

    def __init__(
        self, file: McapFile, agents: tuple[int, ...], period_s: float, epoch_unix_s: float, *, whole: bool = True
    ) -> None:
        """``whole``: drones that are no part of an estimate are in its message too, as the estimator holds them."""
        self._file = file
        self._whole = whole
        self._agents = agents
        self._period_s = period_s
        self._epoch_unix_s = epoch_unix_s
        self._estimate_schema = estimate_schema(agents)

    def write(self, agent_id: int, ready: EstimateReady, published_s: float, inputs: int | None = None) -> None:
        """Append what an agent estimated; ``published_s`` fleet time."""
        message = estimate_message(ready, published_s, self._agents, self._period_s, inputs)
        unix_ns = round((self._epoch_unix_s + published_s) * 1e9)
        there = {name: agent for name, agent in message.agents.items() if agent.age_s is not None}
        poses = _poses(message.t_s, there, self._epoch_unix_s)
        if not self._whole:
            message = msgspec.structs.replace(message, agents=there)
        channel = self._file.channel(estimate_topic(agent_id), ESTIMATE_SCHEMA, self._estimate_schema)
        self._file.add(channel, unix_ns, msgspec.json.encode(message), ready.estimate.tick & 0xFFFFFFFF)
        channel = self._file.channel(f"/{agent_key(agent_id)}/poses", POSES_SCHEMA, POSES)
        self._file.add(channel, unix_ns, msgspec.json.encode(poses))


class EstimateMcap:
    """An MCAP file of estimates alone, of one agent or of several."""

    def __init__(self, path: Path, agents: tuple[int, ...], period_s: float, epoch_unix_s: float) -> None:
        """Make the file anew; raises `LogFileError` if that cannot be done.

        ``agents`` in the order of the blocks of the state, ``epoch_unix_s`` Unix time of fleet time zero.
        """
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = McapFile(path.open("wb"))
        except OSError as error:
            raise _unwritable(path, error) from error
        self._channels = EstimateChannels(self._file, agents, period_s, epoch_unix_s, whole=False)

    @property
    def file(self) -> McapFile:
        """For whoever adds channels of its own; that raises `OSError`."""
        return self._file

    def write(self, agent_id: int, ready: EstimateReady, published_s: float) -> None:
        """Append what an agent estimated, of the drones that it knows; ``published_s`` fleet time.

        Raises `LogFileError`.
        """
        try:
            self._channels.write(agent_id, ready, published_s)
        except OSError as error:
            raise _unwritable(self.path, error) from error

    def close(self) -> None:
        """Write the index and close the file; raises `LogFileError`."""
        try:
            self._file.close()
        except OSError as error:
            raise _unwritable(self.path, error) from error


def _unwritable(path: Path, error: OSError) -> LogFileError:
    return LogFileError(f"record {path}: cannot be written: {error.strerror or error}")


# --- schemas -------------------------------------------------------------------------------------------------


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_NUMBER, _INTEGER = {"type": "number"}, {"type": "integer"}
_NED = _object(**dict.fromkeys(AXES, _NUMBER))
_AGENT = _object(position_m=_NED, velocity_mps=_NED, position_sigma_m=_NED, velocity_sigma_mps=_NED, age_s=_NUMBER)
_PROMISE = _object(
    state={"type": "string"},
    reason={"type": "string"},
    protection_horizontal_m=_NUMBER,
    protection_vertical_m=_NUMBER,
    off_m={"type": "object"},
    relative_horizontal_m={"type": "object"},
    relative_vertical_m={"type": "object"},
    guaranteed_half_axes_m={"type": "object"},
    least_range_m={"type": "object"},
)
_TIME = _object(sec=_INTEGER, nsec=_INTEGER)
_POSE = _object(
    position=_object(**dict.fromkeys("xyz", _NUMBER)), orientation=_object(**dict.fromkeys("xyzw", _NUMBER))
)
POSES = {
    "title": POSES_SCHEMA,
    **_object(timestamp=_TIME, frame_id={"type": "string"}, poses={"type": "array", "items": _POSE}),
}
"""What Foxglove defines under this name (https://docs.foxglove.dev/docs/sdk/schemas/poses-in-frame)."""


def estimate_schema(agents: tuple[int, ...]) -> dict[str, Any]:
    """JSON schema of `EstimateMessage`: every agent by name, so that a viewer can offer its curves."""
    fields = _object(
        tick=_INTEGER,
        t_s=_NUMBER,
        published_s=_NUMBER,
        status=_INTEGER,
        on_time={"type": "boolean"},
        inputs=_INTEGER,
        integrity=_PROMISE,
        agents=_object(**{agent_key(agent_id): _AGENT for agent_id in agents}),
    )
    return {"title": ESTIMATE_SCHEMA, **fields}


def _poses(t_s: float, there: dict[str, AgentEstimate], epoch_unix_s: float) -> dict[str, Any]:
    """Positions as Foxglove's 3D panel wants them: z up. Attitudes are not estimated: none is turned."""
    return {
        "timestamp": stamp(epoch_unix_s + t_s),
        "frame_id": POSES_FRAME,
        "poses": [{"position": enu(agent.position_m), "orientation": LEVEL} for agent in there.values()],
    }


LEVEL = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def stamp(unix_s: float) -> dict[str, int]:
    """A time as Foxglove's messages have it."""
    sec, nsec = divmod(round(unix_s * 1e9), 10**9)
    return {"sec": sec, "nsec": nsec}


def enu(place_m: Ned) -> dict[str, float]:
    """A place in `POSES_FRAME`."""
    return {"x": place_m.east, "y": place_m.north, "z": -place_m.down}
