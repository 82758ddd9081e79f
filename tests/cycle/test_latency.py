"""The lateness histogram, the rule for the cycle time, and the measurement on a simulated clock."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.control.latency import Histogram, LatencyReport, Measurement, measure, sustains, wake_ups

lateness_us = st.lists(st.integers(0, 50_000_000), min_size=1, max_size=200)


def histogram_of(values_us: list[int]) -> Histogram:
    histogram = Histogram()
    for us in values_us:
        histogram.record((us + 0.5) * 1e-6)
    return histogram


class LateClock:
    """Wakes up late by the given times in turn; work takes no time."""

    def __init__(self, late_s: list[float]) -> None:
        self.late_s = late_s
        self.time_s = 100.0
        self.calls = 0

    def now(self) -> float:
        return self.time_s

    def sleep_until(self, deadline_s: float) -> None:
        self.time_s = max(self.time_s, deadline_s) + self.late_s[self.calls % len(self.late_s)]
        self.calls += 1


@given(lateness_us, st.floats(0.0, 100.0))
def test_a_percentile_is_never_too_small_and_at_most_a_thirty_second_too_large(values_us, percent):
    histogram = histogram_of(values_us)
    rank = max(math.ceil(len(values_us) * percent / 100.0), 1)
    exact = sorted(values_us)[rank - 1]
    assert exact <= histogram.percentile_us(percent) <= exact * (1 + 1 / 32) + 1


@given(lateness_us)
def test_count_and_maximum_are_exact_and_the_octaves_add_up(values_us: list[int]) -> None:
    histogram = histogram_of(values_us)
    assert histogram.total == len(values_us)
    assert histogram.maximum_us == max(values_us)
    assert histogram.percentile_us(100.0) == max(values_us)
    assert sum(count for _, count in histogram.octaves()) == len(values_us)


@given(lateness_us, lateness_us)
def test_merging_is_recording_both(first: list[int], second: list[int]) -> None:
    merged = histogram_of(first)
    merged.merge(histogram_of(second))
    assert merged.as_dict() == histogram_of(first + second).as_dict()


def test_early_and_extremely_late_wake_ups_are_recorded() -> None:
    histogram = Histogram()
    histogram.record(-0.001)
    histogram.record(1e6)
    assert histogram.total == 2
    assert histogram.percentile_us(50.0) == 0
    assert histogram.maximum_us == 10**12


def test_an_empty_histogram_sustains_no_cycle() -> None:
    assert not sustains(Histogram(), 0.01)
    assert Histogram().octaves() == []


def test_the_rule_uses_the_share_and_the_maximum() -> None:
    punctual = histogram_of([100] * 20_000)
    assert sustains(punctual, 0.001)
    assert not sustains(punctual, 0.0004)
    one_in_ten_thousand = histogram_of([100] * 9_999 + [450])
    assert sustains(one_in_ten_thousand, 0.001)
    assert not sustains(histogram_of([100] * 9_998 + [450] * 2), 0.001)
    assert not sustains(histogram_of([100] * 99_999 + [501]), 0.001)


def test_lateness_does_not_add_up() -> None:
    measurement = wake_ups(0.004, 1.0, LateClock([0.001, 0.0]))
    assert measurement.skipped == 0
    assert measurement.histogram.total == 250
    assert measurement.histogram.maximum_us in (999, 1000)


def test_missed_periods_are_skipped_and_counted() -> None:
    measurement = wake_ups(0.004, 0.4, LateClock([0.0] * 9 + [0.0105]))
    assert measurement.skipped == 2 * 8
    assert measurement.histogram.total == 100 - measurement.skipped
    assert not measurement.sustained


def test_report_names_the_shortest_sustained_cycle() -> None:
    report = measure(LateClock([0.0003]), 0.2, (0.004, 0.001, 0.002))
    assert [each.period_s for each in report.measurements] == [0.001, 0.002, 0.004]
    assert [each.sustained for each in report.measurements] == [False, True, True]
    assert report.sustained_s == 0.002
    assert "sustains a cycle of 2 ms" in report.table()
    assert report.as_dict()["carried_cycle_ms"] == 2.0


def test_a_short_measurement_is_flagged() -> None:
    assert "only 50 wake-ups" in measure(LateClock([0.0]), 0.2, (0.004,)).verdict


def test_a_cycle_below_one_that_failed_is_not_recommended() -> None:
    good, bad = histogram_of([10] * 100), histogram_of([9000] * 100)
    report = LatencyReport(
        (Measurement(0.001, good, 0), Measurement(0.002, bad, 0), Measurement(0.004, good, 0)), "test"
    )
    assert report.sustained_s == 0.004


def test_a_computer_sustaining_no_cycle_is_reported() -> None:
    report = measure(LateClock([0.009]), 0.2, (0.001, 0.01))
    assert report.sustained_s is None
    assert "none of these" in report.table()


def test_a_percentile_outside_its_range_is_refused() -> None:
    with pytest.raises(ValueError, match="expected 0 to 100"):
        Histogram().percentile_us(101.0)
