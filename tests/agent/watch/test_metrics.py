"""Metrics for Prometheus: names, labels and values, and the endpoint itself, read with Prometheus' own parser."""

from __future__ import annotations

import asyncio
import socket
import urllib.error
import urllib.request

import msgspec
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from agent.config.observer_tables import MetricsTable
from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.errors import LinkError
from agent.outputs import EstimateReady
from agent.watch.health import Health, State
from agent.watch.metrics import Metrics, families
from agent.watch.observers import DaemonState
from estimators.estimator import Estimate, Status
from tests.support.ports import bound

COUNTERS = {
    "ticks": 40,
    "packets received": 12,
    "rejected bad_signature": 2,
    "rejected replay": 1,
    "rejected uwb malformed": 5,
    "mavlink bad": 3,
    "mavlink bad bad CRC": 3,
    "mavlink ignored other source": 7,
    "skipped gps no fix": 4,
}
GAUGES = {"rss_mb": 220.5, "tick_time_p99_s": 0.012, "gps_age_s": 0.1, "rate_105_hz": 99.5, "gps_fix_type": 3.0}
NEIGHBOURS = {"1": {"received": 9.0, "lost": 1.0, "age_s": 0.2}, "3": {"received": 8.0, "clock_offset_s": -1e-3}}


def fleet(base_port: int) -> FleetConfig:
    document = {
        "fleet": {"name": "metered", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 500.0}},
        "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{24550 + i}"} for i in (1, 2)],
        "metrics": {"base_port": base_port},
    }
    return config_from(document, "test")


def state(health: Health = Health(State.DEGRADED, ("no GPS",), alarm=True)) -> DaemonState:
    return DaemonState(2, 12.5, health, COUNTERS, GAUGES, NEIGHBOURS)


def estimate() -> EstimateReady:
    covariance = np.diag(np.arange(1.0, 13.0) ** 2)
    return EstimateReady(Estimate(5, np.zeros(12), covariance, Status.OK, np.zeros(2, int)), 0.5, 0.61, on_time=True)


def samples(exposition: str) -> dict[str, float]:
    """Values by name and labels, as a server reads them; the labels that all have are checked and left out."""
    found = {}
    for family in text_string_to_metric_families(exposition):
        for sample in family.samples:
            labels = dict(sample.labels)
            assert (labels.pop("fleet"), labels.pop("agent")) == ("metered", "2")
            words = [sample.name, *(f"{key}={value}" for key, value in sorted(labels.items()))]
            found[" ".join(words)] = sample.value
    return found


async def scraped(metrics: Metrics, port: int) -> dict[str, float]:
    def read() -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10.0) as answer:
            return str(answer.read().decode())

    return samples(await asyncio.to_thread(read))


@pytest.fixture
def port() -> int:
    with bound(socket.SOCK_STREAM) as free:
        return free


async def test_the_endpoint_gives_what_the_daemon_counts_in_prometheus_terms(port: int) -> None:
    # GIVEN the daemon of the second agent, which answers at the second port
    metrics = Metrics(fleet(port - 1), 2)
    await metrics.open()
    try:
        metrics.on_estimate(estimate(), 0.615, 0.012)
        metrics.on_second(state())
        found = await scraped(metrics, port)
    finally:
        await metrics.close(state())
    # THEN counters end on _total, reasons are labels, units are base units
    assert found["fleetloc_ticks_total"] == 40
    assert found["fleetloc_packets_received_total"] == 12
    assert found["fleetloc_packets_rejected_total reason=bad_signature"] == 2
    assert found["fleetloc_uwb_frames_rejected_total reason=malformed"] == 5
    assert found["fleetloc_mavlink_bad_total"] == 3
    assert found["fleetloc_mavlink_bad_frames_total reason=bad CRC"] == 3
    assert found["fleetloc_samples_skipped_total reason=gps no fix"] == 4
    assert found["fleetloc_rss_bytes"] == pytest.approx(220.5e6)
    assert found["fleetloc_tick_time_p99_seconds"] == 0.012
    assert found["fleetloc_mavlink_rate_hertz message=105"] == 99.5
    assert found["fleetloc_state state=degraded"] == 1
    assert found["fleetloc_state state=ok"] == 0
    assert found["fleetloc_alarm"] == 1
    assert found["fleetloc_neighbour_lost_total neighbour=1"] == 1
    assert found["fleetloc_neighbour_clock_offset_seconds neighbour=3"] == -1e-3
    assert [found[f"fleetloc_position_sigma_meters axis={axis}"] for axis in ("north", "east", "down")] == [7, 8, 9]
    assert found["fleetloc_tick_compute_seconds_bucket le=0.02"] == 1
    assert found["fleetloc_tick_compute_seconds_bucket le=0.01"] == 0
    assert found["fleetloc_publish_latency_seconds_sum"] == pytest.approx(0.015)
    # AND it is gone with the daemon
    with pytest.raises(urllib.error.URLError):
        await scraped(metrics, port)


async def test_before_the_first_second_the_endpoint_answers_already(port: int) -> None:
    metrics = Metrics(fleet(port - 1), 2)
    await metrics.open()
    try:
        found = await scraped(metrics, port)
        assert found["fleetloc_tick_compute_seconds_count"] == 0
    finally:
        await metrics.close(state())


async def test_a_port_that_is_taken_keeps_the_daemon_from_starting() -> None:
    with bound(socket.SOCK_STREAM) as taken:
        metrics = Metrics(fleet(taken - 1), 2)
        with pytest.raises(LinkError, match=rf"metrics 127\.0\.0\.1:{taken}: cannot be listened on"):
            await metrics.open()
        await metrics.close(state())


async def test_a_port_beyond_the_last_keeps_the_daemon_from_starting() -> None:
    config = msgspec.structs.replace(fleet(24_000), metrics=MetricsTable(base_port=65_535))
    metrics = Metrics(config, 2)
    with pytest.raises(LinkError, match=r"metrics 127\.0\.0\.1:65536: cannot be listened on: .*0-65535"):
        await metrics.open()
    await metrics.close(state())


def test_every_state_of_the_daemon_is_a_family_of_its_own_name() -> None:
    names = [family.name for family in families(state(), "metered")]
    assert len(names) == len(set(names))
    assert all(name.startswith("fleetloc_") for name in names)
