"""Flight logs: what went in comes out, however the files end; and a disk that fails never stops anything."""

from __future__ import annotations

import logging
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from nacl.signing import SigningKey

from agent.config.reading import config_from, dump
from agent.config.tables import FleetConfig
from agent.errors import LogFileError
from agent.inputs import Due, Gone, HouseKept, Input, MavlinkIn, PacketIn, Served, UwbIn
from agent.log import flight_log
from agent.log.disk import DiskLimit
from agent.log.estimate_mcap import CHUNK_BYTES, EstimateMcap, EstimateMessage
from agent.log.flight_format import CLOSED, CUT_OFF, trust_from, trust_text
from agent.log.flight_log import FlightLog
from agent.log.flight_reader import FlightReader, RecordedEntry, RecordedInput
from agent.log.run_logs import flight_start
from agent.mavlink.codec import Decoder, Encoder, mavlink
from agent.outputs import EstimateReady
from estimators.estimator import Estimate, SolverReport, Status
from transport.security.auth import UNSIGNED

ROOM = 10**9
UNIX_S = 1_780_000_000.0
HOST_S = 1 / 3
"""No round number in binary."""


@pytest.fixture(scope="module")
def config() -> FleetConfig:
    document: dict[str, Any] = {
        "fleet": {"name": "test", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}},
        "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{15000 + i}"} for i in (1, 2)],
        "security": {"mode": "unsigned"},
    }
    return config_from(document, "test")


def make_record(directory: Path, config: FleetConfig, *, threaded: bool = False, **limits: Any) -> FlightLog:
    limit = DiskLimit(directory, limits.get("max_bytes", ROOM), 1000, limits.get("free", lambda _: ROOM))
    start = flight_start(config, 1, UNSIGNED, UNIX_S + HOST_S, HOST_S)
    return FlightLog(directory / "agent_001", config, start, limit, threaded=threaded)


def ready(tick: int) -> EstimateReady:
    estimate = Estimate(tick, np.full(12, tick / 7), np.eye(12) / 3, Status.OK, np.zeros(2, int), SolverReport())
    return EstimateReady(estimate, 0.1 * tick, 0.1 * tick + 0.12, True)


def heartbeat(encoder: Encoder) -> bytes:
    return encoder.encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))


def write_flight(record: FlightLog, ticks: int) -> list[Input]:
    """Inputs of every sort and an estimate per tick."""
    encoder, decoder = Encoder(1, 1), Decoder(datagrams=True)
    rng, inputs = np.random.default_rng(1), []
    for tick in range(ticks):
        host_s = HOST_S + 0.1 * tick
        data = b"".join(heartbeat(encoder) for _ in range(4))
        decoder.feed(data)
        batch: list[Input] = [
            MavlinkIn(host_s, data, decoder.frames),
            Served(host_s + 0.01),
            PacketIn(host_s, 10**18 + tick, host_s - 1e-4, "cl/v1/test/agent/002/meas", rng.bytes(700)),
            UwbIn(host_s, rng.bytes(60)),
            Gone(host_s, 2),
            HouseKept(host_s, UNIX_S + host_s),
            Due(host_s + 0.02),
        ]
        for event in batch:
            record.note(event, UNIX_S + host_s)
        record.note_sent([heartbeat(encoder)], UNIX_S + host_s)
        record.on_estimate(ready(tick), 0.1 * tick + 0.12, UNIX_S + host_s)
        inputs += batch
    return inputs


def read(path: Path) -> tuple[list[Input], list[EstimateMessage], str]:
    reader = FlightReader(path)
    entries: list[RecordedEntry] = list(reader)
    inputs = [entry.event for entry in entries if isinstance(entry, RecordedInput)]
    return inputs, [entry for entry in entries if isinstance(entry, EstimateMessage)], reader.ended


# --- whole records -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("threaded", [False, True])
def test_everything_comes_back_in_order_to_the_last_bit(tmp_path: Path, config: FleetConfig, threaded: bool) -> None:
    record = make_record(tmp_path, config, threaded=threaded)
    written = write_flight(record, 50)
    record.close()
    inputs, estimates, ended = read(tmp_path / "agent_001.mcap")
    assert inputs == written
    assert ended == CLOSED
    assert [estimate.tick for estimate in estimates] == list(range(50))
    assert estimates[3].inputs == 4 * 7  # what the estimate had taken in
    assert np.array_equal(estimates[10].arrays()[0], ready(10).estimate.mean)
    start = FlightReader(tmp_path / "agent_001.mcap").start
    assert (start.unix_s, start.host_s, start.agent) == (UNIX_S + HOST_S, HOST_S, 1)
    assert start.config == dump(config)


def test_public_keys_go_in_and_come_out_and_nothing_secret_does(tmp_path: Path, config: FleetConfig) -> None:
    keys = {i: SigningKey.generate() for i in (1, 2)}
    trust = {i: (key.verify_key,) for i, key in keys.items()}
    start = flight_start(config, 1, trust, UNIX_S, HOST_S)
    assert trust_from(start.trust) == trust
    assert trust_from(trust_text(UNSIGNED)) is UNSIGNED
    texts = "".join(start.texts().values())
    assert not any(key.encode().hex() in texts for key in keys.values())
    with pytest.raises(LogFileError, match="public keys: expected"):
        trust_from("{]")


# --- MAVLink bytes, however they are read --------------------------------------------------------------------


@st.composite
def streams(draw: st.DrawFn) -> list[bytes]:
    """Reads of a byte stream of frames with garbage and half frames between them."""
    encoder, stream = Encoder(1, 1), b""
    for _ in range(draw(st.integers(1, 12))):
        frame = heartbeat(encoder)
        kind = draw(st.sampled_from(["whole", "whole", "whole", "garbage", "half", "flipped"]))
        if kind == "whole":
            stream += frame
        elif kind == "garbage":
            stream += draw(st.binary(max_size=30))
        elif kind == "half":
            stream += frame[: draw(st.integers(1, len(frame)))]
        else:
            stream += frame[:-1] + bytes((frame[-1] ^ 1,))
    cuts = sorted(draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    return [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True) if b > a]


@settings(max_examples=60, deadline=None)
@given(reads=streams(), datagrams=st.booleans())
def test_the_very_bytes_of_every_read_come_back(
    tmp_path_factory: pytest.TempPathFactory, config: FleetConfig, reads: list[bytes], datagrams: bool
) -> None:
    directory = tmp_path_factory.mktemp("reads")
    record, decoder = make_record(directory, config), Decoder(datagrams=datagrams)
    for data in reads:
        decoder.feed(data)
        record.note(MavlinkIn(HOST_S, data, decoder.frames), UNIX_S)
    record.close()
    inputs, _, ended = read(directory / "agent_001.mcap")
    assert [event.data for event in inputs if isinstance(event, MavlinkIn)] == reads
    assert ended == CLOSED
    shutil.rmtree(directory)


def test_a_stream_cut_within_frames_is_not_stored_twice(tmp_path: Path, config: FleetConfig) -> None:
    # GIVEN a serial line whose reads end within frames
    encoder, decoder = Encoder(1, 1), Decoder(datagrams=False)
    stream = b"".join(heartbeat(encoder) for _ in range(200))
    record = make_record(tmp_path, config)
    for start in range(0, len(stream), 50):
        data = stream[start : start + 50]
        decoder.feed(data)
        record.note(MavlinkIn(HOST_S, data, decoder.frames), UNIX_S)
    record.close()
    # THEN the .mcap holds only what was of a frame still coming
    reader = FlightReader(tmp_path / "agent_001.mcap")
    assert b"".join(e.event.data for e in reader if isinstance(e, RecordedInput)) == stream  # type: ignore[union-attr]
    from mcap.reader import make_reader

    with reader.path.open("rb") as file:
        rest = [len(m.data) for _, _, m in make_reader(file).iter_messages()]
    assert sum(rest) < 120 * len(rest)


# --- files that end early, or are none -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def short_flight(tmp_path_factory: pytest.TempPathFactory, config: FleetConfig) -> tuple[Path, list[Input]]:
    directory = tmp_path_factory.mktemp("short")
    record = make_record(directory, config)
    written = write_flight(record, 60)
    record.close()
    return directory, written


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0, 1), suffix=st.sampled_from([".mcap", ".tlog"]))
def test_a_record_cut_off_at_any_byte_gives_its_beginning(
    short_flight: tuple[Path, list[Input]], tmp_path_factory: pytest.TempPathFactory, share: float, suffix: str
) -> None:
    source, written = short_flight
    directory = tmp_path_factory.mktemp("cut")
    for kind in (".mcap", ".tlog"):
        shutil.copy(source / f"agent_001{kind}", directory)
    path = directory / f"agent_001{suffix}"
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    try:
        inputs, _, ended = read(directory / "agent_001.mcap")
    except LogFileError:  # not even its begin is left
        assert suffix == ".mcap"
        inputs, ended = [], CUT_OFF
    assert inputs == written[: len(inputs)]
    assert ended == CLOSED or ended.startswith(CUT_OFF)
    assert len(inputs) == len(written) if ended == CLOSED else len(inputs) <= len(written)
    shutil.rmtree(directory)


@settings(max_examples=60, deadline=None)
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@example(at=0.6881471318712251, bit=3)  # in a length: more than there is memory
def test_a_flipped_bit_in_the_mcap_is_noticed_or_harmless(
    short_flight: tuple[Path, list[Input]], tmp_path_factory: pytest.TempPathFactory, at: float, bit: int
) -> None:
    source, written = short_flight
    directory = tmp_path_factory.mktemp("flip")
    content = bytearray((source / "agent_001.mcap").read_bytes())
    content[int(at * len(content))] ^= 1 << bit
    (directory / "agent_001.mcap").write_bytes(content)
    shutil.copy(source / "agent_001.tlog", directory)
    try:
        inputs, _, _ = read(directory / "agent_001.mcap")
    except LogFileError:
        inputs = []
    assert inputs == written[: len(inputs)]
    shutil.rmtree(directory)


def test_what_is_no_flight_record_is_refused_in_one_line(tmp_path: Path, config: FleetConfig) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(LogFileError, match=r"a\.mcap: cannot be read"):
        FlightReader(path)
    for content in (b"", b"text\n" * 100):
        path.write_bytes(content)
        with pytest.raises(LogFileError, match=r"a\.mcap: expected a flight log \(MCAP\)"):
            FlightReader(path)
    EstimateMcap(path, config.ids, 0.1, 0.0).close()
    with pytest.raises(LogFileError, match=r"found MCAP without metadata 'fleetloc\.start'"):
        FlightReader(path)
    record = make_record(tmp_path, config)
    record.close()
    (tmp_path / "agent_001.tlog").unlink()
    with pytest.raises(LogFileError, match=r"agent_001\.mcap: cannot be read: .*agent_001\.tlog: No such file"):
        list(FlightReader(tmp_path / "agent_001.mcap"))


def test_a_record_that_cannot_be_made_is_an_error_at_once(tmp_path: Path, config: FleetConfig) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LogFileError, match="cannot be written"):
        make_record(tmp_path / "file", config)


# --- limits --------------------------------------------------------------------------------------------------


def expect_early_end(
    record: FlightLog, caplog: pytest.LogCaptureFixture, reason: str, whole: bool
) -> tuple[list[Input], list[Input]]:
    """Written and read inputs of a record that ends early; nothing raises, and it is said once."""
    with caplog.at_level(logging.WARNING, "fleetloc.agent"):
        written = write_flight(record, 60)
        record.close()
    assert reason in record.ended
    assert len(caplog.messages) == 1
    assert "flying on without" in caplog.messages[0]
    assert record.counters["record ended early"] == 1
    assert record.counters["record dropped"] > 0
    inputs, _, ended = read(Path(str(record._files._mcap._stream.name)))
    assert ended == record.ended if whole else ended.startswith(CUT_OFF)
    return written, inputs


def test_a_record_ends_at_its_size(tmp_path: Path, config: FleetConfig, caplog: pytest.LogCaptureFixture) -> None:
    record = make_record(tmp_path, config, max_bytes=30_000)
    written, inputs = expect_early_end(record, caplog, "0.03 MB of record.flight_max_mb", whole=True)
    assert 0 < len(inputs) < len(written)
    assert inputs == written[: len(inputs)]
    size = sum((tmp_path / f"agent_001{kind}").stat().st_size for kind in (".mcap", ".tlog"))
    assert size < 30_000 + CHUNK_BYTES + 8_000  # a chunk under way, the index


def test_a_disk_nearly_full_ends_the_record(
    tmp_path: Path, config: FleetConfig, caplog: pytest.LogCaptureFixture
) -> None:
    left = iter([ROOM] * 20 + [500] * 100)
    record = make_record(tmp_path, config, free=lambda _: next(left))
    written, inputs = expect_early_end(record, caplog, "MB stay free", whole=True)
    assert inputs == written[: 20 * 7]


def test_a_full_disk_ends_the_record(tmp_path: Path, config: FleetConfig, caplog: pytest.LogCaptureFixture) -> None:
    # GIVEN a .tlog on a device that is full
    (tmp_path / "agent_001.tlog").symlink_to("/dev/full")
    written, inputs = expect_early_end(make_record(tmp_path, config), caplog, "No space left", whole=False)
    assert inputs == written[: len(inputs)]


class _Failing:
    """A stream whose writes fail after a while; the rest is the real one's."""

    def __init__(self, stream: Any, writes: int) -> None:
        self._stream, self._left = stream, writes

    def write(self, data: bytes) -> int:
        self._left -= 1
        if self._left < 0:
            raise OSError(5, "Input/output error")
        return int(self._stream.write(data))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@pytest.mark.parametrize("writes", [0, 3, 5])
def test_a_failing_disk_ends_the_record(
    tmp_path: Path, config: FleetConfig, caplog: pytest.LogCaptureFixture, writes: int
) -> None:
    record = make_record(tmp_path, config)
    writer = record._files._mcap._writer
    writer._Writer__stream = _Failing(writer._Writer__stream, writes)
    written, inputs = expect_early_end(record, caplog, "Input/output error", whole=False)
    assert inputs == written[: len(inputs)]


def test_a_disk_too_slow_ends_the_record_instead_of_filling_the_memory(
    tmp_path: Path, config: FleetConfig, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a disk that does not answer
    monkeypatch.setattr(flight_log, "MAX_WAITING_BATCHES", 10)
    answers = threading.Event()

    def free(_directory: Path) -> int:
        answers.wait()
        return ROOM

    record = make_record(tmp_path, config, threaded=True, free=free)
    # WHEN more comes than may wait
    with caplog.at_level(logging.WARNING, "fleetloc.agent"):
        write_flight(record, 60)
        answers.set()
        record.close()
    # THEN the record ends, cleanly
    assert "too slow" in record.ended
    assert len(caplog.messages) == 1
    assert read(tmp_path / "agent_001.mcap")[2] == record.ended
    assert record.counters["record dropped"] >= 45 * 9


@pytest.fixture
def no_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight_log, "CLOSE_TIMEOUT_S", 0.01)


@pytest.mark.usefixtures("no_patience")
def test_a_stuck_disk_does_not_keep_the_daemon_from_ending(
    tmp_path: Path, config: FleetConfig, caplog: pytest.LogCaptureFixture
) -> None:
    answers = threading.Event()
    release: Callable[[Path], int] = lambda _: ROOM if answers.wait() else 0  # noqa: E731
    record = make_record(tmp_path, config, threaded=True, free=release)
    write_flight(record, 2)
    thread = record._thread
    record.close()
    assert "stuck" in record.ended
    answers.set()
    assert thread is not None
    thread.join()
