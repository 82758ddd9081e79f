"""`/metrics`: figures of the loop, the axes and the API in Prometheus' format."""

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from support.fake_bridge import FakeBridge

from hdbridge.client.messages import ControlState, OuterState
from hdbridge.daemon.api.metrics import BOUNDS_S, Metrics
from hdbridge.daemon.memory import Event, EventKind
from hdbridge.drive.supervision import Fault


def scraped(metrics) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Each figure by its name and labels."""
    text = metrics.exposition().decode()
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def figure(found, name, **labels) -> float:
    return found[f"hdbridge_{name}", frozenset(labels.items())]


def test_lateness_buckets_are_cumulative():
    bridge = FakeBridge()
    metrics = Metrics(bridge)
    samples = bridge.samples(range(1, 5))
    samples["late_us"] = [5.0, 15.0, 2e6, np.nan]
    metrics.take(samples, (), 3)
    bridge.core.lost = 3
    metrics.take(samples[:0], (), 0)
    found = scraped(metrics)
    assert figure(found, "cycle_late_seconds_bucket", le="1e-05") == 1
    assert figure(found, "cycle_late_seconds_bucket", le="2e-05") == 2
    assert figure(found, "cycle_late_seconds_bucket", le="0.1") == 2
    assert figure(found, "cycle_late_seconds_bucket", le="+Inf") == 3
    assert figure(found, "cycle_late_seconds_count") == 3
    assert figure(found, "cycle_late_seconds_sum") == pytest.approx(2.00002)
    assert figure(found, "samples_lost_total") == 3
    rising = [figure(found, "cycle_busy_seconds_bucket", le=f"{each:g}") for each in BOUNDS_S]
    assert rising == sorted(rising)


def test_faults_are_counted_by_axis_and_name():
    bridge = FakeBridge()
    metrics = Metrics(bridge)
    code = list(Fault).index(Fault.OVERRUN)
    events = [
        Event(1, 10, 0, 1, EventKind.FAULT, 0, code, ""),
        Event(2, 11, 0, 1, EventKind.FAULT, 0, code, ""),
        Event(3, 11, 0, -1, EventKind.FAULT, 0, 0, ""),
        Event(4, 11, 0, -1, EventKind.FAULT, 0, 999, ""),
        Event(5, 12, 0, 0, EventKind.STATE, 0, 3, ""),
    ]
    metrics.take(bridge.samples([1]), events, 0)
    found = scraped(metrics)
    assert figure(found, "faults_total", axis="joint-2", fault="OVERRUN") == 2
    assert figure(found, "faults_total", axis="", fault="LOST_TPDO") == 1
    assert sum(value for (name, _), value in found.items() if name == "hdbridge_faults_total") == 3


def test_each_axis_has_one_state_and_its_figures():
    bridge = FakeBridge()
    bridge.axes["joint-1"].at = ControlState.ENABLED
    bridge.axes["joint-1"].target_deg = 30.0
    times = {"period_s": 0.004, "jitter_s": 2e-5, "latency_s": 0.006, "latency_99_s": 0.008}
    bridge.axes["joint-1"].outer = OuterState(node_id=5, alive=True, nmt=5, statusword=0x1237, **times)
    found = scraped(Metrics(bridge))
    for name, state in (("joint-1", "enabled"), ("joint-2", "disabled")):
        states = {each: figure(found, "axis_state", axis=name, state=each.value) for each in ControlState}
        assert [each.value for each, value in states.items() if value] == [state]
    assert figure(found, "load_target_degrees", axis="joint-1") == 30.0
    assert figure(found, "load_error_arcsec", axis="joint-1") == 1.0
    assert figure(found, "bus_load_ratio") == 0.31
    for name, value in zip(
        ("sync_period", "sync_jitter", "latency_median", "latency_99"), times.values(), strict=True
    ):
        assert figure(found, f"outer_{name}_seconds", axis="joint-1") == value
    assert figure(found, "lease_held") == 0
    assert ("hdbridge_model_age_seconds", frozenset({("axis", "joint-1")})) not in found


def test_clients_cannot_grow_the_page(api):
    """Counts requests with methods, paths or names that the client made up."""
    with api.over_socket() as client:
        url = "http://hdbridge/metrics"
        for number in range(20):
            client.request(f"M{number}", f"/axes/a{number}")
        first = client.get(url).text
        for number in range(20, 60):
            client.request(f"M{number}", f"/axes/a{number}")
        again = client.get(url)
    assert len(again.text.splitlines()) <= len(first.splitlines()) + 2
    assert again.headers["content-type"].startswith("text/plain")
    assert 'method="OTHER"' in again.text
