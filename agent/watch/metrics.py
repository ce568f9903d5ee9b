"""A daemon's figures for Prometheus, served over HTTP from a thread of its own.

Names follow Prometheus' conventions: base units in the name, ``_total`` for counters, and the reasons of what was
refused as labels. Every figure carries the labels ``fleet`` and ``agent``.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, Histogram, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from agent.config.tables import FleetConfig
from agent.errors import OPENING_FAULTS, LinkError, cause_of
from agent.outputs import EstimateReady
from agent.watch.health import State
from agent.watch.metrics_server import BoundedServer
from agent.watch.observers import DaemonState, Observer

PREFIX = "fleetloc"
REASON_TABLES = (
    ("rejected uwb ", "uwb_frames_rejected"),
    ("rejected ", "packets_rejected"),
    ("skipped uwb ", "uwb_ranges_skipped"),
    ("skipped ", "samples_skipped"),
    ("mavlink bad ", "mavlink_bad_frames"),
    ("mavlink ignored ", "mavlink_ignored"),
    ("refused ", "records_refused"),
)
"""Counters of `agent.watch.diagnostics` by the begin of their name, the longer first; what follows is the reason."""
UNITS = (("_s", "_seconds"), ("_m", "_meters"), ("_mps", "_meters_per_second"), ("_hz", "_hertz"))
NEIGHBOUR_COUNTERS = ("received", "lost", "restarts", "rejected")
TICK_BUCKETS_S = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2, 0.5, 1.0)
AXES = ("north", "east", "down")


def families(state: DaemonState, fleet: str) -> Iterator[Metric]:
    """The figures of a daemon's state, a family each."""
    labels = {"fleet": fleet, "agent": str(state.agent_id)}
    yield from _health(state, labels)
    yield from _counters(state.counters, labels)
    yield from _gauges(state.gauges, labels)
    yield from _neighbours(state.neighbours, labels)


def _health(state: DaemonState, labels: dict[str, str]) -> Iterator[Metric]:
    by_state = {str(one): float(state.health.state is one) for one in State}
    yield _gauge("state", "1 for the state that the daemon is in.", labels, by_state, "state")
    meaning = "1 while the own position may be wrong without its covariance saying so."
    yield _gauge("alarm", meaning, labels, {"": float(state.health.alarm)})


def _counters(counters: Mapping[str, int], labels: dict[str, str]) -> Iterator[Metric]:
    plain: dict[str, int] = {}
    tables: dict[str, dict[str, float]] = {}
    for counter, count in counters.items():
        begin, table = next(((b, t) for b, t in REASON_TABLES if counter.startswith(b)), ("", ""))
        if table:
            tables.setdefault(table, {})[counter.removeprefix(begin)] = count
        else:
            plain[_name(counter)] = plain.get(_name(counter), 0) + count
    for name, count in plain.items():
        yield _counter(name, f"Counted since the start: {name}.", labels, {"": count})
    for table, reasons in tables.items():
        yield _counter(table, "Counted since the start, by reason.", labels, reasons, "reason")


def _gauges(gauges: Mapping[str, float], labels: dict[str, str]) -> Iterator[Metric]:
    rates: dict[str, float] = {}
    for gauge, value in gauges.items():
        stream = re.fullmatch(r"rate_(\d+)_hz", gauge)
        if stream is not None:
            rates[stream[1]] = value
        elif gauge.endswith("_mb"):  # the one gauge that is not in a base unit
            yield _gauge(_name(f"{gauge[:-3]}_bytes"), f"{gauge} of the daemon.", labels, {"": value * 1e6})
        else:
            yield _gauge(_name(_unit(gauge)), f"{gauge} of the daemon.", labels, {"": value})
    if rates:
        yield _gauge("mavlink_rate_hertz", "Rate at which a MAVLink message arrives.", labels, rates, "message")


def _neighbours(neighbours: Mapping[str, Mapping[str, float]], labels: dict[str, str]) -> Iterator[Metric]:
    found: dict[str, dict[str, float]] = {}
    for neighbour, gauges in neighbours.items():
        for gauge, value in gauges.items():
            found.setdefault(gauge, {})[neighbour] = value
    for gauge, by_neighbour in found.items():
        make = _counter if gauge in NEIGHBOUR_COUNTERS else _gauge
        name = _name(f"neighbour {_unit(gauge)}")
        yield make(name, f"{gauge} of a neighbour's link.", labels, by_neighbour, "neighbour")


def _gauge(
    name: str, meaning: str, labels: dict[str, str], samples: Mapping[str, float], by: str | None = None
) -> Metric:
    return _filled(GaugeMetricFamily(f"{PREFIX}_{name}", meaning, labels=_names(labels, by)), labels, samples, by)


def _counter(
    name: str, meaning: str, labels: dict[str, str], samples: Mapping[str, float], by: str | None = None
) -> Metric:
    return _filled(CounterMetricFamily(f"{PREFIX}_{name}", meaning, labels=_names(labels, by)), labels, samples, by)


def _names(labels: dict[str, str], by: str | None) -> list[str]:
    return [*labels, *([by] if by else [])]


def _filled(
    family: GaugeMetricFamily | CounterMetricFamily,
    labels: dict[str, str],
    samples: Mapping[str, float],
    by: str | None,
) -> Metric:
    """A family with its samples, by the value of its label ``by``."""
    for key, value in samples.items():
        family.add_metric([*labels.values(), *([key] if by else [])], value)
    return family


def _unit(name: str) -> str:
    for short, long in UNITS:
        if name.endswith(short):
            return name.removesuffix(short) + long
    return name


def _name(name: str) -> str:
    return re.sub("[^a-zA-Z0-9]+", "_", name).strip("_").lower()


class Metrics(Observer, Collector):
    """Serves the figures of the last second, and how long ticks took, at ``/metrics`` of a port."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        """``config.metrics.base_port`` is given."""
        assert config.metrics.base_port is not None
        slot = config.ids.index(agent_id)
        self._host, self._port = config.metrics.host, config.metrics.base_port + slot
        self._fleet = config.fleet.name
        self._own = slice(6 * slot, 6 * slot + 3)
        self._state: DaemonState | None = None
        self._sigma_m: list[float] = []
        self._server: BoundedServer | None = None
        self.registry = CollectorRegistry()
        labels = {"fleet": self._fleet, "agent": str(agent_id)}
        self._labels = labels
        self._compute = self._histogram("tick_compute_seconds", "Computing time of a tick.")
        self._latency = self._histogram("publish_latency_seconds", "From a tick's end until its estimate was out.")
        self._period_s = config.fleet.period_s
        self.registry.register(self)

    def _histogram(self, name: str, meaning: str) -> Histogram:
        family = Histogram(f"{PREFIX}_{name}", meaning, self._labels, registry=self.registry, buckets=TICK_BUCKETS_S)
        return family.labels(**self._labels)

    async def open(self) -> None:
        """Listen; raises `LinkError` naming the address."""
        try:
            self._server = BoundedServer(self._host, self._port, make_wsgi_app(self.registry))
            self._server.start()
        except OPENING_FAULTS as error:
            where = f"metrics {self._host}:{self._port}"
            raise LinkError(f"{where}: cannot be listened on: {cause_of(error)}") from error

    def on_estimate(self, ready: EstimateReady, published_s: float, tick_time_s: float) -> None:
        self._compute.observe(tick_time_s)
        self._latency.observe(published_s - ready.t_s - self._period_s)
        self._sigma_m = [float(variance**0.5) for variance in ready.estimate.covariance.diagonal()[self._own]]

    def on_second(self, state: DaemonState) -> None:
        self._state = state

    async def close(self, state: DaemonState) -> None:
        if self._server is not None:
            await asyncio.to_thread(self._server.stop)
            self._server = None

    def collect(self) -> Iterator[Metric]:
        """On the server's thread: what it reads is replaced as a whole, never changed."""
        state, sigma_m = self._state, self._sigma_m
        if state is not None:
            yield from families(state, self._fleet)
        if sigma_m:
            by_axis = dict(zip(AXES, sigma_m, strict=True))
            yield _gauge("position_sigma_meters", "1-sigma of the own position.", self._labels, by_axis, "axis")
