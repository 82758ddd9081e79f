"""Procedures on an axis under control of the daemon: a bench that runs through the control process.

The path of each leg is sampled once per cycle, sent as knots and followed from rest to rest; the samples are
read from the ring. A leg without motion (a rest, a hold) sends nothing. The result equals that of `Bench.run`
apart from a few cycles of standstill between legs: the time to detect a leg's end and to begin the next one.

Blocking: use it in a worker thread. Power is on only while a procedure runs.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, TypeVar

from hdbridge.axis import AxisConfig
from hdbridge.control.bench import Run, axis_view, record_of, walk
from hdbridge.control.compensation import Compensation
from hdbridge.control.survived import PERIODS_SKIPPED, Survived
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, Event, EventKind, Knot, SampleArray, SampleFlag, SampleReader
from hdbridge.daemon.service.reports import fault_of
from hdbridge.errors import DaemonError, RefusedError, SafetyStop
from hdbridge.motion.procedures.moves import AxisView, MotionLimits, Move, Path, Procedure, Sample
from hdbridge.motion.procedures.rehearsal import rehearse
from hdbridge.motion.stream import BEGIN_DEG, Cubic
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment, versions_here

if TYPE_CHECKING:
    from hdbridge.daemon.service.rigs import DaemonRig

Outcome = TypeVar("Outcome")
POLL_S: Final = 0.01
"""Interval between checks for new samples."""
STREAM_TIMEOUT_S: Final = 10.0
_HALVINGS: Final = 5
"""Maximum number of times that a period between two knots is halved."""
_VELOCITY_SHARE: Final = 1.0 + 3e-7
_ACCELERATION_SHARE: Final = 1.045
"""Shares of the velocity and acceleration limits above which knots are added; a stream may exceed its limits
slightly.
"""
_JERK_SHARE: Final = 0.3
"""Largest change of acceleration per period, as a share of its limit. Above it, the cubic between two knots
would exceed the acceleration limit however close they are.
"""
_SLOPE_S: Final = 1e-5
"""Half the interval of the difference quotient for a path's velocity."""
_ROUNDING_S: Final = 1e-9
_COLUMNS: Final = Sample._fields[1:-1]
"""Fields of a procedure's sample that have the same name in the ring."""
_NOT_SURVIVED: Final = frozenset({AxisState.QUICK_STOPPED, AxisState.LATCHED, AxisState.UNVERIFIED})


def knots_of(path: Path, stream: int, period_s: float, limits: MotionLimits) -> Iterator[Knot]:
    """Yields a path as knots, at rest at both ends; at whole periods they equal a bench's targets.

    Adds knots where the cubic between two of them would exceed a limit that the path itself keeps, for
    example at a change of jerk.
    """
    cycles = max(math.ceil(path.duration_s / period_s - _ROUNDING_S), 1)
    before = Knot(stream, 0.0, path.at(0.0), 0.0)
    yield before
    for number in range(1, cycles + 1):
        end = _knot(path, stream, number * period_s)
        if number == cycles:
            end = end._replace(velocity_deg_s=0.0)
        yield from _refined(path, before, end, limits, _HALVINGS)
        before = end


def streamed_view(axis: AxisConfig) -> AxisView:
    """Returns the view of an axis that follows streams: its jerk limit is reduced to what they can follow."""
    view = axis_view(axis)
    limits = view.limits
    jerk = min(limits.jerk_deg_s3, _JERK_SHARE * limits.acceleration_deg_s2 / axis.drive.cycle_s)
    return replace(view, limits=replace(limits, jerk_deg_s3=jerk))


def _knot(path: Path, stream: int, time_s: float) -> Knot:
    if time_s >= path.duration_s:
        return Knot(stream, time_s, path.at(path.duration_s), 0.0)
    step_s = min(_SLOPE_S, path.duration_s - time_s)
    slope = (path.at(time_s + step_s) - path.at(time_s - step_s)) / (2.0 * step_s)
    return Knot(stream, time_s, path.at(time_s), slope)


def _refined(path: Path, begin: Knot, end: Knot, limits: MotionLimits, halvings: int) -> Iterator[Knot]:
    """Yields ``end``, preceded by the knots that must be added before it."""
    cubic = Cubic.between(*begin[1:], *end[1:])
    kept = (
        cubic.fastest_deg_s() <= _VELOCITY_SHARE * limits.velocity_deg_s
        and cubic.hardest_deg_s2() <= _ACCELERATION_SHARE * limits.acceleration_deg_s2
    )
    if not kept and halvings:
        middle = _knot(path, begin.stream, 0.5 * (begin.time_s + end.time_s))
        yield from _refined(path, begin, middle, limits, halvings - 1)
        yield from _refined(path, middle, end, limits, halvings - 1)
    else:
        yield end


@dataclass(slots=True)
class _Measured:
    """Measurements of a run so far."""

    samples: list[Sample] = field(default_factory=list)
    legs: list[Segment] = field(default_factory=list)
    faults: Counter[str] = field(default_factory=Counter)
    first: dict[str, str] = field(default_factory=dict)
    skipped: int = 0

    def take_fault(self, event: Event) -> None:
        """Counts a fault, tolerated or not."""
        fault = fault_of(event.code)
        if fault is not None:
            self.faults[fault.value] += 1
            self.first.setdefault(fault.value, event.text)


class DaemonBench:
    """A `Bench` on an axis under control of the daemon."""

    def __init__(
        self, rig: DaemonRig, compensation: Compensation | None, interrupted: Callable[[], bool]
    ) -> None:
        self._rig = rig
        self._axis = rig.axis
        self._compensation = compensation or rig.uncompensated()
        self._interrupted = interrupted
        self._view = streamed_view(rig.axis)
        self._period_s = rig.period_s
        self._measured = _Measured()
        self._reader: SampleReader = rig.core.memory.reader()
        self._pending: list[tuple[int, Sample]] = []
        """Samples, with their cycles, that are not yet part of a leg."""
        self._place = 0.0
        self._since = 0
        self._skipped: int | None = None

    # ---------------------------------------------------------------- interface of Bench

    @property
    def legs(self) -> tuple[Segment, ...]:
        """Moves of the present procedure so far."""
        return tuple(self._measured.legs)

    @property
    def survived(self) -> tuple[Survived, ...]:
        """Faults that the present procedure tolerated so far, and the one that stopped it."""
        measured = self._measured
        found = [
            Survived(what=what, cycles=cycles, first=measured.first.get(what, ""))
            for what, cycles in measured.faults.items()
        ]
        if measured.skipped:
            found.append(Survived(what=PERIODS_SKIPPED, cycles=measured.skipped))
        return tuple(found)

    def record(self) -> Record:
        """Returns the record of the present procedure so far, without a channel that was lost."""
        return record_of(self._measured.samples, self._axis)

    def run(
        self,
        procedure: Procedure[Outcome],
        progress: Callable[[float], None] = lambda _: None,
        /,
    ) -> Run[Outcome]:
        """Runs one procedure to its end. Refuses and raises as `Bench.run` does.

        Raises RefusedError if another client stopped the axis.
        """
        rig = self._rig
        self._compensation.model.check_bound_to(self._axis, rig.identity)
        self._measured = _Measured()
        standing_deg = rig.value("motor_position_deg") / self._view.ratio
        rehearsal = rehearse(procedure, self._view, standing_deg)
        rig.enable(self._compensation)
        try:
            self._begin()
            outcome = walk(procedure, self._view, rehearsal, progress, lambda: self._place, self._leg)
        except SafetyStop:
            raise  # it is at rest or stopping; the latch remains
        except BaseException:
            rig.stop()
            raise
        rig.disable()
        return Run(
            self.record(),
            self.legs,
            axis=self._axis.name,
            ratio=self._view.ratio,
            drive=rig.identity,
            versions=versions_here(),
            notes={"procedure": type(procedure).__name__},
            outcome=outcome,
            survived=self.survived,
        )

    # ---------------------------------------------------------------- legs

    def _begin(self) -> None:
        """Starts measuring, after the axis was enabled."""
        self._reader = self._rig.core.memory.reader()
        self._pending.clear()
        self._skipped = None
        self._since = self._rig.core.log.newest
        while not self._pending:
            self._take()
        self._place = self._pending[-1][1].load_target_deg

    def _leg(self, move: Move, path: Path) -> Sequence[Sample]:
        """Runs one move from the present load target."""
        if path.lowest_deg == path.highest_deg:
            begin = None
            feed: Iterator[Knot] = iter(())
        else:
            stream = self._rig.core.next_stream()
            feed = self._hand_over(knots_of(path, stream, self._period_s, self._view.limits))
            answer = self._rig.command(CommandKind.STREAM_BEGIN, a=STREAM_TIMEOUT_S, j=stream)
            begin = answer.cycle + 1
        samples: list[Sample] = []
        try:
            while True:
                for place, (cycle, sample) in enumerate(self._pending, 1):
                    if begin is not None and cycle < begin:
                        continue
                    samples.append(sample)
                    # Counts executed cycles, as a stream does, because cycles may be skipped.
                    elapsed_s = (len(samples) - 1) * self._period_s
                    if elapsed_s < path.duration_s - _ROUNDING_S:
                        continue
                    if begin is not None and not self._arrived(sample, path, elapsed_s):
                        continue
                    if move.ended(samples):
                        self._keep(place)
                        self._place = path.at(path.duration_s)
                        if begin is not None:
                            self._rig.command(CommandKind.STREAM_END)
                        return samples
                self._keep(len(self._pending))
                feed = self._hand_over(feed)
                self._take()
        finally:
            if samples:
                self._measured.legs.append(
                    Segment(kind=move.kind, start_s=samples[0].time_s, end_s=samples[-1].time_s)
                )

    def _arrived(self, sample: Sample, path: Path, elapsed_s: float) -> bool:
        """Returns True if the set-point has reached the end of a leg, which late knots may delay."""
        end_deg = path.at(path.duration_s)
        if abs(sample.load_target_deg - end_deg) <= BEGIN_DEG:
            return True
        if elapsed_s > path.duration_s + STREAM_TIMEOUT_S:
            raise DaemonError(
                f"{self._axis.name}: {STREAM_TIMEOUT_S:g} s after a leg was to end at {end_deg:.6g} deg the "
                f"axis was sent to {sample.load_target_deg:.6g} deg: its set-points did not get through"
            )
        return False

    def _hand_over(self, knots: Iterator[Knot]) -> Iterator[Knot]:
        """Sends as many knots as the queue accepts; returns the rest."""
        queue = self._rig.knots
        while queue.free:
            knot = next(knots, None)
            if knot is None:
                break
            queue.add(knot)
        return knots

    def _keep(self, count: int) -> None:
        """Moves the first ``count`` pending samples to the record."""
        self._measured.samples += [sample for _, sample in self._pending[:count]]
        del self._pending[:count]

    # ---------------------------------------------------------------- samples

    def _take(self) -> None:
        """Waits for samples; raises if the axis was stopped or the run is to end."""
        rig = self._rig
        rig.wait(POLL_S)
        rows, lost = self._reader.read()
        if lost:
            raise DaemonError(
                f"{self._axis.name}: {lost} cycles were lost before they were read, so this run is worth "
                "nothing: the machine is too busy; end what else runs on it"
            )
        self._add(rows)
        self._look()
        # Called once per cycle, as by a bench.
        if sum(self._interrupted() for _ in range(max(len(rows), 1))):
            raise KeyboardInterrupt
        rig.check_alive()

    def _add(self, rows: SampleArray) -> None:
        """Converts rows of the ring to samples and appends them to the pending ones."""
        if not len(rows):
            return
        axis = rows["axes"][:, self._rig.index]
        cycles = rows["cycle"].tolist()
        times = [cycle * self._period_s for cycle in cycles]
        if self._axis.load_encoder.is_motor_encoder:  # read twice, as by a bench
            axis["load_position_deg"] = axis["motor_position_deg"] / self._axis.gear.ratio
        columns = [times, *(axis[name].tolist() for name in _COLUMNS)]
        readings: list[list[float | None]] = []
        for place in range(len(self._axis.channels)):
            known = axis["flags"] & (SampleFlag.CHANNEL0_KNOWN << place)
            values = zip(axis[f"reading{place}"].tolist(), known.tolist(), strict=True)
            readings.append([value if there else None for value, there in values])
        channels = zip(*readings, strict=True) if readings else [()] * len(cycles)
        told = zip(*columns, channels, strict=True)
        self._pending += zip(cycles, map(Sample._make, told), strict=True)
        skipped = int(rows[-1]["skipped"])
        self._measured.skipped += 0 if self._skipped is None else max(skipped - self._skipped, 0)
        self._skipped = skipped

    def _look(self) -> None:
        """Evaluates new events of the axis; raises if one ended the run."""
        rig = self._rig
        log = rig.core.log
        newest = log.newest
        for event in log.of_axis(rig.index, self._since):
            if event.kind is EventKind.FAULT:
                self._measured.take_fault(event)
            elif event.kind is EventKind.STREAM_REFUSED:
                raise DaemonError(f"{self._axis.name}: {event.text}; the axis was braked")
            elif event.kind is EventKind.UNDERRUN:
                raise DaemonError(
                    f"{self._axis.name}: the set-points of a leg came too late, and the axis was braked: the "
                    "machine is too busy; end what else runs on it"
                )
            elif event.kind is EventKind.STATE and event.code != AxisState.ENABLED:
                if AxisState(event.code) in _NOT_SURVIVED:
                    raise rig.stopped()
                raise RefusedError(f"{self._axis.name}: {rig.why_over() or 'the axis was disabled'}")
        self._since = newest
        if why := rig.why_over():
            raise RefusedError(f"{self._axis.name}: {why}")
