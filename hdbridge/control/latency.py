"""Wake-up lateness of a loop: a histogram of bounded memory, and the cycle time that a computer sustains.

Measure on the computer that will run the loop, with its usual load, for minutes rather than seconds, before
choosing ``cycle_ms``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from hdbridge.clock import Clock

_EXACT_BITS: Final = 6
_EXACT: Final = 1 << _EXACT_BITS
_STEPS: Final = _EXACT // 2
_TOP_BITS: Final = 26
_BINS: Final = _EXACT + (_TOP_BITS - _EXACT_BITS) * _STEPS


def _bin_of(us: int) -> int:
    """Returns the bin of a lateness: exact below 64 us, then 32 bins per octave."""
    if us < _EXACT:
        return us
    shift = us.bit_length() - _EXACT_BITS
    return _EXACT + (shift - 1) * _STEPS + (us >> shift) - _STEPS


def _bin_top_us(index: int) -> int:
    """Returns the greatest lateness in a bin, whole us."""
    if index < _EXACT:
        return index
    octave, step = divmod(index - _EXACT, _STEPS)
    return ((_STEPS + step + 1) << (octave + 1)) - 1


class Histogram:
    """Histogram of lateness in whole microseconds: exact below 64 us, within 3 % above, up to a minute.

    Its size is fixed at 704 integers.
    """

    def __init__(self) -> None:
        self._counts = [0] * _BINS
        self.total = 0
        """Number of recorded values."""
        self.maximum_us = 0
        """Exact maximum of the lateness, us."""

    def record(self, late_s: float) -> None:
        """Counts one lateness in seconds; an early wake-up counts as zero."""
        us = int(late_s * 1e6)
        if us >= _EXACT:
            self._counts[min(_bin_of(us), _BINS - 1)] += 1
        else:
            self._counts[us if us > 0 else 0] += 1
        if us > self.maximum_us:  # noqa: PLR1730 - max() costs three times as much, in every cycle
            self.maximum_us = us
        self.total += 1

    def percentile_us(self, percent: float) -> int:
        """Returns the lateness that ``percent`` of all values do not exceed, us; 0 without values.

        It is the upper end of a bin, so it is never too small and at most 3 % too large.
        """
        if not 0.0 <= percent <= 100.0:
            raise ValueError(f"percentile is {percent}; expected 0 to 100")
        wanted = math.ceil(self.total * percent / 100.0)
        seen = 0
        for index, count in enumerate(self._counts):
            seen += count
            if count and seen >= wanted:
                return min(_bin_top_us(index), self.maximum_us)
        return self.maximum_us

    def later_than_us(self, us: int) -> int:
        """Returns the number of values above ``us``, to within a bin."""
        return sum(count for index, count in enumerate(self._counts) if _bin_top_us(index) > us)

    def merge(self, other: Histogram) -> None:
        """Adds another histogram's counts."""
        self._counts = [a + b for a, b in zip(self._counts, other._counts, strict=True)]
        self.total += other.total
        self.maximum_us = max(self.maximum_us, other.maximum_us)

    def octaves(self) -> list[tuple[int, int]]:
        """Returns (upper end in us, count) for each power of two from the first to the last non-empty one."""
        sums: dict[int, int] = {}
        for index, count in enumerate(self._counts):
            if count:
                power = max(_bin_top_us(index), 1).bit_length()
                sums[power] = sums.get(power, 0) + count
        if not sums:
            return []
        return [(1 << power, sums.get(power, 0)) for power in range(min(sums), max(sums) + 1)]

    def as_dict(self) -> dict[str, int]:
        """Returns count, median, percentiles and maximum in us."""
        return {
            "count": self.total,
            "p50_us": self.percentile_us(50.0),
            "p99_us": self.percentile_us(99.0),
            "p99_9_us": self.percentile_us(99.9),
            "p99_99_us": self.percentile_us(99.99),
            "max_us": self.maximum_us,
        }


CANDIDATES_S: Final = (0.001, 0.002, 0.004, 0.008, 0.010)
"""Cycle times measured by default."""
RULE_PERCENT: Final = 99.99
RULE_SHARE: Final = 0.2
RULE_MAXIMUM_SHARE: Final = 0.5
RULE: Final = (
    f"a computer sustains a cycle if {RULE_PERCENT:g} % of the wake-ups are late by less than "
    f"{100 * RULE_SHARE:g} % of it and none by more than {100 * RULE_MAXIMUM_SHARE:g} %"
)
ENOUGH: Final = 10_000
"""Minimum number of wake-ups needed to determine the 99.99th percentile."""


def sustains(histogram: Histogram, period_s: float) -> bool:
    """Returns True if the rule (`RULE`) holds for a cycle of ``period_s``; False for an empty histogram.

    With a lateness of half a cycle, the control cycle skips a period and counts an overrun.
    """
    return (
        histogram.total > 0
        and histogram.percentile_us(RULE_PERCENT) < RULE_SHARE * period_s * 1e6
        and histogram.maximum_us <= RULE_MAXIMUM_SHARE * period_s * 1e6
    )


@dataclass(frozen=True, slots=True)
class Measurement:
    """Lateness of the wake-ups at one period."""

    period_s: float
    histogram: Histogram = field(repr=False)
    skipped: int
    """Number of whole periods missed."""

    @property
    def sustained(self) -> bool:
        """True if the computer sustains this period."""
        return self.skipped == 0 and sustains(self.histogram, self.period_s)


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """Latency measurements, one `Measurement` per period, shortest first."""

    measurements: tuple[Measurement, ...]
    conditions: str
    """Measurement conditions in words: with or without a bus, real-time scheduling or not."""

    @property
    def sustained_s(self) -> float | None:
        """Shortest measured period that the computer sustains together with all longer ones, or None."""
        best = None
        for each in reversed(self.measurements):
            if not each.sustained:
                break
            best = each.period_s
        return best

    @property
    def verdict(self) -> str:
        """Shortest cycle that the computer sustains, as a sentence with the rule."""
        if self.sustained_s is None:
            return (
                f"this computer sustains none of these cycle times ({RULE}); "
                "close other programs, allow real-time priority, or use a kernel with PREEMPT_RT"
            )
        few = min(each.histogram.total for each in self.measurements)
        more = f"; only {few} wake-ups were measured, take {ENOUGH} or more" if few < ENOUGH else ""
        return f"this computer sustains a cycle of {1e3 * self.sustained_s:g} ms ({RULE}){more}"

    def table(self) -> str:
        """Returns the measurements and their combined histogram as plain text."""
        lines = [f"wake-up lateness, {self.conditions}", ""]
        lines.append(
            f"{'cycle':>8} {'wake-ups':>9} {'p50':>8} {'p99':>8} {'p99.9':>8} {'p99.99':>8} {'max':>8} "
            f"{'skipped':>8}  sustained"
        )
        for each in self.measurements:
            h = each.histogram.as_dict()
            lines.append(
                f"{1e3 * each.period_s:>5g} ms {h['count']:>9} {h['p50_us']:>5} us {h['p99_us']:>5} us "
                f"{h['p99_9_us']:>5} us {h['p99_99_us']:>5} us {h['max_us']:>5} us {each.skipped:>8}  "
                f"{'yes' if each.sustained else 'no'}"
            )
        together = Histogram()
        for each in self.measurements:
            together.merge(each.histogram)
        lines.append("")
        for top_us, count in together.octaves():
            share = count / together.total
            bar = "#" * max(round(50 * share), 1 if count else 0)
            lines.append(f"  below {top_us:>8} us {count:>9} {100 * share:>7.3f} %  {bar}")
        return "\n".join([*lines, "", self.verdict])

    def as_dict(self) -> dict[str, Any]:
        """Returns the document of ``--json``, schema ``hdbridge.latency/1``."""
        return {
            "schema": "hdbridge.latency/1",
            "conditions": self.conditions,
            "rule": RULE,
            "measurements": [
                {
                    "cycle_ms": 1e3 * each.period_s,
                    "skipped": each.skipped,
                    "carried": each.sustained,
                    **each.histogram.as_dict(),
                }
                for each in self.measurements
            ],
            "carried_cycle_ms": None if self.sustained_s is None else 1e3 * self.sustained_s,
        }


def wake_ups(
    period_s: float, duration_s: float, clock: Clock, work: Callable[[], object] | None = None
) -> Measurement:
    """Wakes up every ``period_s`` for ``duration_s`` on absolute deadlines and records the lateness of each.

    ``work`` is called at each wake-up (for example an exchange on a bus); if it takes longer than a period,
    whole periods are skipped and counted.
    """
    histogram, skipped = Histogram(), 0
    deadline = clock.now() + period_s
    end = deadline + duration_s
    while deadline < end:
        clock.sleep_until(deadline)
        late = clock.now() - deadline
        histogram.record(late)
        if work is not None:
            work()
        behind = math.floor((clock.now() - deadline) / period_s)
        skipped += behind
        deadline += period_s * (1 + behind)
    return Measurement(period_s, histogram, skipped)


def measure(
    clock: Clock,
    duration_s: float = 10.0,
    periods_s: Sequence[float] = CANDIDATES_S,
    work: Callable[[], object] | None = None,
    conditions: str = "without a bus",
    progress: Callable[[Measurement], object] | None = None,
) -> LatencyReport:
    """Measures each period for ``duration_s`` seconds.

    ``progress`` is called after each period. ``conditions`` is copied to the report.
    """
    measurements = []
    for period_s in sorted(periods_s):
        measurements.append(wake_ups(period_s, duration_s, clock, work))
        if progress is not None:
            progress(measurements[-1])
    return LatencyReport(tuple(measurements), conditions)
