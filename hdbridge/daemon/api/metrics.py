"""`/metrics` for Prometheus: loop timing, faults, axes and API requests.

`Metrics` is a sink of `Core`, and counts the requests. Everything else is read on each scrape.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from prometheus_client import CollectorRegistry, Counter, Histogram, disable_created_metrics, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from hdbridge.client.messages import ControlState
from hdbridge.daemon.loop.faultlog import fault_of
from hdbridge.daemon.memory import EventKind
from hdbridge.daemon.service.bridge import ServiceBridge

BOUNDS_S: Final = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 5e-2, 1e-1)
"""Upper bounds of the histogram buckets; the last bucket is unbounded."""
_PREFIX: Final = "hdbridge_"
disable_created_metrics()  # type: ignore[no-untyped-call]  # omits the start time of each metric


_AXIS: Final = (
    ("load_target_degrees", "Load target.", "load_target_deg"),
    ("load_position_degrees", "Load encoder.", "load_position_deg"),
    ("motor_position_degrees", "Motor encoder.", "motor_position_deg"),
    ("load_error_arcsec", "Load encoder minus load target.", "error_arcsec"),
    ("correction_arcsec", "Correction by the compensation.", "correction_arcsec"),
    ("predicted_error_arcsec", "Transmission error predicted by the model.", "predicted_arcsec"),
    ("motor_torque_newton_metres", "Torque of the motor.", "motor_torque_nm"),
    ("queued_points", "Waiting way points.", "queued"),
    ("model_age_seconds", "Age of the model in use.", "model.age_s"),
    ("outer_statusword", "6041h as the other master sees it.", "outer.statusword"),
    ("outer_nmt_state", "NMT state on the other master's bus.", "outer.nmt"),
    ("outer_sync_period_seconds", "Period of the other master's SYNC.", "outer.period_s"),
    (
        "outer_sync_jitter_seconds",
        "Mean deviation of the other master's SYNC from its regular time.",
        "outer.jitter_s",
    ),
    (
        "outer_latency_median_seconds",
        "Time from the other master's SYNC to the drive's first frame with its target, median.",
        "outer.latency_s",
    ),
    ("outer_latency_99_seconds", "The same, 99th percentile of that time.", "outer.latency_99_s"),
)
"""Name, description and field of each axis metric."""


class Metrics(Collector):
    """Metrics of one machine: counts accumulated for the scrapes, and its state at each scrape."""

    def __init__(self, bridge: ServiceBridge) -> None:
        self._bridge, self._names = bridge, [*bridge.axes]
        self._registry = registry = CollectorRegistry()
        self._late = Histogram(
            f"{_PREFIX}cycle_late_seconds",
            "Delay of the start of cycles.",
            registry=registry,
            buckets=BOUNDS_S,
        )
        self._busy = Histogram(
            f"{_PREFIX}cycle_busy_seconds", "Duration of cycles.", registry=registry, buckets=BOUNDS_S
        )
        self._faults = Counter(
            f"{_PREFIX}faults",
            "Faults by axis; without an axis those of the machine.",
            ("axis", "fault"),
            registry=registry,
        )
        self._answered = Counter(
            f"{_PREFIX}api_requests", "Requests answered.", ("method", "status"), registry=registry
        )
        self.open = {"http": 0, "websocket": 0}
        """Number of requests in progress and of WebSockets."""
        registry.register(self)

    def take(self, samples: NDArray[np.void], events: Iterable[Any], lost: int) -> None:
        """Takes samples and events of the loop from the service's core; ignores times that are not finite."""
        for histogram, field in ((self._late, "late_us"), (self._busy, "busy_us")):
            for value_us in samples[field].tolist():
                if math.isfinite(value_us):
                    histogram.observe(value_us / 1e6)
        for each in events:
            if each.kind == EventKind.FAULT and (fault := fault_of(each.code)) is not None:
                axis = self._names[each.axis] if 0 <= each.axis < len(self._names) else ""
                self._faults.labels(axis, fault.name).inc()

    @contextmanager
    def in_progress(self, kind: str) -> Iterator[None]:
        """Counts a request or WebSocket as open within the block."""
        self.open[kind] += 1
        try:
            yield
        finally:
            self.open[kind] -= 1

    def count(self, method: str, status: int) -> None:
        """Counts an answer. Unknown methods count as OTHER, which bounds the number of counters."""
        known = method in {"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"}
        self._answered.labels(method if known else "OTHER", str(status)).inc()

    def exposition(self) -> bytes:
        """Returns all metrics in Prometheus' text format."""
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """Yields the metrics of the machine's present state."""
        state = self._bridge.state()
        yield _gauge("info", "1.", [((state.name, state.version), 1)], ("machine", "version"))
        yield _gauge("loop_alive", "1 if the control loop is running.", [((), state.cycle.alive)])
        yield _gauge("cycle_period_seconds", "Period of the cycle.", [((), state.cycle.period_s)])
        skipped = [((), state.cycle.skipped)]
        yield _counter("cycles_skipped", "Periods skipped because the loop was late.", skipped)
        yield _gauge("bus_up", "1 if the CAN interface is up.", [((), state.bus.up)])
        if state.bus.load is not None:
            yield _gauge("bus_load_ratio", "Bus load.", [((), state.bus.load)])
        dropped = [((), state.recorder.dropped)]
        yield _counter("recorder_dropped", "Samples that the recorder dropped.", dropped)
        yield _gauge("lease_held", "1 if a client holds the lease.", [((), state.lease.held)])
        lost = [((), self._bridge.core.lost)]
        yield _counter("samples_lost", "Cycles lost because the service was too slow.", lost)
        for name, about, field in _AXIS:
            values = [((each.name,), _field(each, field)) for each in state.axes]
            yield _gauge(name, about, [row for row in values if row[1] is not None], ("axis",))
        states = [((each.name, one.value), each.state is one) for each in state.axes for one in ControlState]
        yield _gauge("axis_state", "1 for the present state of an axis.", states, ("axis", "state"))
        latched = [((each.name,), each.fault is not None) for each in state.axes]
        yield _gauge("axis_fault_latched", "1 if a stop is latched.", latched, ("axis",))
        open_now = [((kind,), number) for kind, number in self.open.items()]
        yield _gauge("api_clients", "Requests and WebSockets in progress.", open_now, ("kind",))


def _field(state: Any, path: str) -> Any:
    """Returns a field of a state, such as ``model.age_s``, or None."""
    for name in path.split("."):
        state = getattr(state, name, None)
    return state


_Rows = Iterable[tuple[tuple[str, ...], float]]


def _gauge(name: str, about: str, rows: _Rows, labels: Sequence[str] = ()) -> Metric:
    return _filled(GaugeMetricFamily(_PREFIX + name, about, labels=labels), rows)


def _counter(name: str, about: str, rows: _Rows, labels: Sequence[str] = ()) -> Metric:
    return _filled(CounterMetricFamily(_PREFIX + name, about, labels=labels), rows)


def _filled(family: GaugeMetricFamily | CounterMetricFamily, rows: _Rows) -> Metric:
    for values, value in rows:
        family.add_metric(values, float(value))
    return family
