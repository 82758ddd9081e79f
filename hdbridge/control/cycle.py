"""The control cycle: one thread, absolute deadlines, the same order in every period.

    wait - drain - SYNC - receive - check - RPDO - heartbeat

* *drain*: what waited since the last cycle is not of this one. Heartbeats and emergencies are noted, TPDOs
  are stale and thrown away.
* *receive*: until every TPDO is there, or the window closes. The newest of each identifier wins. Those of the
  optional channels are waited for when they come with every SYNC and are not lost, else taken when they come.
* *check*: by the fault table of `hdbridge.drive.supervision`.
* *RPDO*: with this cycle's feedback already in it.
* *heartbeat*: the master's own comes from this loop and nowhere else, so that a loop that hangs is noticed
  by the drive.

A period that begins more than half a period late is given up, with those behind it: the next SYNC comes on
the next whole period. SYNCs are never sent closer than half a period.

This is the one place where speed comes before looks: no logging, no SDO, no allocation that can be avoided.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from hdbridge.clock import Clock
from hdbridge.control.latency import Histogram
from hdbridge.drive.fastlink import fast_link
from hdbridge.drive.feedback import Feedback
from hdbridge.drive.image import HALT_BIT, ProcessImage
from hdbridge.drive.link import Frame, Link, TransmitBufferFull, new_tuple
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.objects import NmtState
from hdbridge.drive.pdo import PdoLengthError
from hdbridge.drive.plausibility import Plausibility
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Reaction, Supervision
from hdbridge.drive.traffic import Traffic
from hdbridge.drive.writes import drives_patience_s
from hdbridge.errors import BusError, InputError, SafetyStop

__all__ = ["Command", "Cycle", "Feedback", "Target"]

WINDOW: Final = 0.8
"""Share of the period after SYNC in which the TPDOs must arrive; the rest is for the RPDO to get through."""
LATE: Final = 0.5
"""Share of the period by which a cycle may begin late before it is given up."""
DRAIN_MAXIMUM: Final = 256
"""Frames read before SYNC; at 1 Mbit/s a full bus brings at most 220 in 10 ms."""
FLUSH_MAXIMUM: Final = 10_000
"""Frames thrown away when the cycle begins."""
STILL_CYCLES: Final = 3
"""After a quick stop the motor has to keep its place for this many cycles to count as standing."""
_HEARTBEAT_DATA: Final = bytes([NmtState.OPERATIONAL])
_STILL_DRIVEN: Final = (State.OPERATION_ENABLED, State.FAULT_REACTION_ACTIVE, State.UNKNOWN)


Target = int | None
"""Motor counts for 607Ah; None for the last one once more."""
Command = Target | Callable[[Feedback], Target]


class Cycle:
    """Runs the process image over a link, one `tick` per period.

    ``image`` gives the controlword (``image.power.go``) and the scaling; ``supervision`` holds the latch and
    the list of faults; ``monitor`` may be shared with the boot-up. ``plausibility`` is by default what the
    axis file allows.
    """

    __slots__ = (
        "_all", "_bits", "_channel_ids", "_channels", "_commanded", "_count", "_deadline", "_discarded",
        "_faults", "_given_up", "_good_cycle", "_heartbeat_s", "_image", "_last", "_late_s",
        "_link", "_patience_s", "_plausibility", "_rested", "_stop_cycles", "_traffic", "_window_s", "clock",
        "histogram", "monitor", "overruns", "period_s", "skipped", "stopping", "supervision",
    )  # fmt: skip

    def __init__(
        self,
        link: Link,
        clock: Clock,
        image: ProcessImage,
        supervision: Supervision,
        period_s: float,
        *,
        monitor: NetworkMonitor | None = None,
        plausibility: Plausibility | None = None,
        stop_timeout_s: float = 1.0,
    ) -> None:
        self.clock = clock
        self.period_s = period_s
        self.supervision = supervision
        self.monitor = monitor if monitor is not None else NetworkMonitor()
        self.histogram = Histogram()
        """How late each period began."""
        self.overruns = 0
        """Cycles that were given up for lateness."""
        self.skipped = 0
        """Whole periods without a SYNC."""
        self.stopping: list[Feedback] = []
        """Feedback of the cycles of the last quick stop, which `tick` drove by itself."""
        self._link = fast_link(link)
        self._image = image
        self._plausibility = plausibility if plausibility is not None else Plausibility.of(image.axis)
        self._traffic = Traffic(image, self.monitor, clock.now())
        self._channels = bool(image.channels)
        self._channel_ids = frozenset(layout.can_id for layout in image.channel_tpdos)
        self._window_s = WINDOW * period_s
        self._late_s = LATE * period_s
        self._patience_s = drives_patience_s(image.axis)
        self._stop_cycles = max(int(stop_timeout_s / period_s), STILL_CYCLES + 1)
        self._faults: list[tuple[Fault, str]] = []
        self._count = -1
        self._discarded = 0
        self._heartbeat_s = clock.now()
        self.restart()

    def restart(self) -> None:
        """Begin anew at the next `tick`, at once; the numbers of the cycles go on.

        For when the cycle has rested: what arrived meanwhile, and how far the encoders moved, is not judged.
        The latch and the histogram stay.
        """
        self._deadline: float | None = None
        self._rested = True
        self._last: Feedback | None = None
        self._good_cycle = self._count
        self._commanded = False
        self._image.forget_channels()
        self._await(self._image.awaited_channels())

    def _await(self, channel_ids: Sequence[int]) -> None:
        """Wait in each cycle for the TPDOs that it needs and for these of the optional channels."""
        awaited = (*self._image.tpdo_ids, *channel_ids)
        self._given_up = len(channel_ids) < len(self._channel_ids)
        self._bits = {can_id: 1 << place for place, can_id in enumerate(awaited)}
        self._all = (1 << len(awaited)) - 1

    def tick(self, command: Command = None) -> Feedback:
        """Run one period and give what it measured.

        ``command`` is the target in motor counts, or None to hold the last one, or a function of this cycle's
        feedback that gives either. It is used while the drive is enabled; before that the target is the
        actual position, so that enabling moves nothing.

        Raises `SafetyStop` when the fault table says so, and again at each call until
        ``supervision.reset()``. By then the drive has reported the quick stop and the motor stands, or the
        time for that is over, or no RPDO is sent any more (`Reaction.LATCH`). Errors of ``command`` other
        than `InputError` pass through: the caller then has to stop the axis.
        """
        supervision = self.supervision
        if supervision.stop is not None:
            raise supervision.error()
        feedback = self._exchange(command)
        if supervision.stop is None:
            return feedback
        confirmed = self._ride_out(feedback)
        stop = supervision.error()
        if not confirmed and supervision.reaction is Reaction.QUICK_STOP:
            stop = SafetyStop(f"{stop}; the drive did not confirm it: its own watchdogs have to stop it")
        raise stop

    def _exchange(self, command: Command) -> Feedback:
        """One period on the bus, judged."""
        image, faults, clock = self._image, self._faults, self.clock
        faults.clear()
        now = self._wait()
        count = self._count
        last = self._last
        feedback: Feedback | None = None
        try:
            complete = self._drain(now)
            try:
                self._link.send(image.sync_id, b"")
            except TransmitBufferFull as error:
                faults.append((Fault.TRANSMIT_FULL, f"SYNC: {error}"))
            else:
                complete = self._receive(clock.now() + self._window_s) and complete

            if self._channels:
                self._step_channels()
            enabled = image.power.state is State.OPERATION_ENABLED
            if complete and enabled and last is not None:
                complete = self._believable(last)
            if complete:
                feedback = self._last = new_tuple(Feedback, (
                    count, count * self.period_s, image.statusword or 0, image.motor_counts,
                    image.load_counts, image.demand_counts, image.torque_permille, True,
                    image.readings,
                ))  # fmt: skip
                self._good_cycle = count
            else:
                feedback = self._stale()
            if self._commanded and not enabled:
                self._fell_out()
            silent_s = now - self._traffic.heard_s
            if silent_s > image.heartbeat_timeout_s:
                faults.append((Fault.HEARTBEAT_LOST, f"for {1e3 * silent_s:.0f} ms"))

            self._answer(command, feedback, enabled)
            if now >= self._heartbeat_s:
                self._heartbeat(now)
        except BusError as error:
            if faults:
                self.supervision.judge(count, faults)
            self.supervision.also(count, Fault.BUS_DOWN, str(error))
        return feedback if feedback is not None else self._stale()

    def _wait(self) -> float:
        """Sleep to the next deadline, skipping whole periods when it is long past; the time then."""
        clock, deadline, period_s = self.clock, self._deadline, self.period_s
        self._count += 1
        if deadline is None:
            now = clock.now()
            self._deadline = now + period_s
            return now
        clock.sleep_until(deadline)
        now = clock.now()
        late_s = now - deadline
        self.histogram.record(late_s)
        if late_s > self._late_s:
            missed = int(late_s / period_s) + 1
            self._faults.append((Fault.OVERRUN, f"by {1e3 * late_s:.1f} ms, periods skipped: {missed}"))
            if late_s + period_s > self._patience_s:
                patience = f"{1e3 * self._patience_s:.0f} ms"
                self._faults.append((Fault.HANG, f"{1e3 * late_s:.0f} ms; the drive waits {patience}"))
            self.overruns += 1
            self.skipped += missed
            self._count += missed
            deadline += missed * period_s
            clock.sleep_until(deadline)
            now = clock.now()
        self._deadline = deadline + period_s
        return now

    def _drain(self, now: float) -> bool:
        """Read what waited; whether that was all of it."""
        recv = self._link.recv
        if self._rested:
            # Whatever waited is old news.
            self._rested = False
            self._heartbeat_s = now
            self._traffic.heard_s = now
            for _ in range(FLUSH_MAXIMUM):
                frame = recv(now)
                if frame is None:
                    break
                self.monitor.dispatch(frame)
            self._discarded = self._link.dropped.total
            return True
        for _ in range(DRAIN_MAXIMUM):
            frame = recv(now)
            if frame is None:
                return True
            if frame.can_id in self._bits:
                self._faults.append((Fault.DUPLICATE_TPDO, f"{frame.can_id:03X}h before SYNC"))
            else:
                self._other(frame)
        self._faults.append((Fault.FLOOD, f"more than {DRAIN_MAXIMUM} before SYNC"))
        return False

    def _receive(self, window_end_s: float) -> bool:
        """Take this cycle's TPDOs until all are there or the window closes; whether all are."""
        recv, bits, everything, accept = self._link.recv, self._bits, self._all, self._image.accept
        faults = self._faults
        got = 0
        spoilt: dict[int, int] | None = None
        while got != everything:
            frame = recv(window_end_s)
            if frame is None:
                break
            can_id, data, time_s = frame
            bit = bits.get(can_id)
            if bit is None:
                self._other(frame)
                if time_s > window_end_s:
                    break
                continue
            if got & bit:
                faults.append((Fault.DUPLICATE_TPDO, f"{can_id:03X}h twice"))
            try:
                accept(can_id, data)
            except PdoLengthError:
                spoilt = spoilt or {}
                spoilt[can_id] = len(data)
                continue
            got |= bit
        dropped = self._link.dropped
        discarded = dropped.remote + dropped.extended + dropped.error + dropped.fd
        if discarded != self._discarded:
            self._discarded = discarded
            faults.append((Fault.DISCARDED_FRAME, "remote, extended, FD or error frame"))
        if spoilt is not None:
            self._note_lengths(spoilt, got)
        if got == everything:
            return True
        missing = [
            can_id for can_id, bit in bits.items() if not got & bit and can_id not in self._channel_ids
        ]
        lost = [can_id for can_id in missing if spoilt is None or can_id not in spoilt]
        if lost:
            faults.append((Fault.LOST_TPDO, ", ".join(f"{can_id:03X}h" for can_id in lost)))
        return not missing

    def _note_lengths(self, spoilt: dict[int, int], got: int) -> None:
        """Frames of the wrong length: a fault where no good one of that identifier came and it is needed."""
        for can_id, length in spoilt.items():
            needed = can_id not in self._channel_ids and not got & self._bits[can_id]
            fault = Fault.WRONG_LENGTH if needed else Fault.DISCARDED_FRAME
            expected = self._image.length_of(can_id)
            self._faults.append((fault, f"{can_id:03X}h with {length} bytes, expected {expected}"))

    def _step_channels(self) -> None:
        """Hold what did not come, give up what stays away, and wait again for what is back."""
        image = self._image
        faults = image.step_channels()
        if faults or self._given_up:
            self._faults += faults
            self._await(image.awaited_channels())

    def _other(self, frame: Frame) -> None:
        """A frame that is not waited for: what it means."""
        can_id, data, _ = frame
        if can_id not in self._channel_ids:
            self._faults += self._traffic.faults(frame)
            return
        try:
            self._image.accept(can_id, data)
        except PdoLengthError:
            self._faults.append((Fault.DISCARDED_FRAME, f"{can_id:03X}h with {len(data)} bytes"))

    def _believable(self, last: Feedback) -> bool:
        """Whether the positions can follow from the last good ones; notes a following error as well."""
        image, plausibility = self._image, self._plausibility
        motor = image.motor_counts
        cycles = self._count - self._good_cycle
        jump = plausibility.jump(motor - last.motor_counts, image.load_counts - last.load_counts, cycles)
        if jump is not None:
            self._faults.append((Fault.ENCODER_JUMP, jump))
            return False
        lag = plausibility.lag(image.demand_counts - motor)
        if lag is not None:
            self._faults.append((Fault.FOLLOWING_ERROR, lag))
        return True

    def _stale(self) -> Feedback:
        """Feedback of a cycle that has none of its own: the last good values."""
        count, image = self._count, self._image
        if self._last is not None:
            return self._last._replace(cycle=count, time_s=count * self.period_s, fresh=False)
        return Feedback(
            count, count * self.period_s, image.statusword or 0, image.motor_counts, image.load_counts,
            image.demand_counts, image.torque_permille, False, image.readings,
        )  # fmt: skip

    def _fell_out(self) -> None:
        state = self._image.power.state
        fault = state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
        detail = f"it is in '{state.value}', statusword {self._image.statusword or 0:04X}h"
        self._faults.append((Fault.DRIVE_FAULT if fault else Fault.DROPPED_OUT, detail))

    def _answer(self, command: Command, feedback: Feedback, enabled: bool) -> None:
        """Judge the cycle and send the RPDO that follows from it."""
        image, faults, supervision = self._image, self._faults, self.supervision
        data = None
        if enabled:
            try:
                target = command(feedback) if callable(command) else command
                data = self._hold() if target is None else image.pack_rpdo(target)
            except InputError as error:
                faults.append((Fault.BAD_TARGET, str(error)))
        if faults or not supervision.quiet:
            reaction = supervision.judge(self._count, faults)
            faults.clear()
            if reaction is Reaction.LATCH:
                return
            if reaction is Reaction.QUICK_STOP:
                image.power.quick_stop()
                data = None
        if data is None:
            data = self._idle()
        self._commanded = enabled and image.power.aim is State.OPERATION_ENABLED
        try:
            self._link.send(image.rpdo_id, data)
        except TransmitBufferFull as error:
            # Stale set-points are worse than none: it is not sent again, and the axis stops.
            supervision.also(self._count, Fault.TRANSMIT_FULL, f"RPDO: {error}")

    def _hold(self) -> bytes:
        """The RPDO with the last target once more."""
        image = self._image
        word = image.power.controlword() | (HALT_BIT if image.halt else 0)
        return image.rpdo.pack((word, image.target_counts))

    def _idle(self) -> bytes:
        """The RPDO with the actual position as target."""
        try:
            return self._image.pack_rpdo_idle()
        except InputError:
            # It does not fit 607Ah. The drive is not enabled or is told to stop: it ignores the target.
            return self._hold()

    def _heartbeat(self, now: float) -> None:
        """The master's heartbeat, when it is due; one that was missed is not made up for."""
        image = self._image
        self._heartbeat_s += image.heartbeat_period_s
        if self._heartbeat_s <= now:
            self._heartbeat_s = now + image.heartbeat_period_s
        try:
            self._link.send(image.heartbeat_id, _HEARTBEAT_DATA)
        except TransmitBufferFull as error:
            self.supervision.also(self._count, Fault.TRANSMIT_FULL, f"heartbeat: {error}")

    def _ride_out(self, feedback: Feedback) -> bool:
        """Command the quick stop, cycle by cycle, until the motor stands; whether the drive confirmed it."""
        supervision, power = self.supervision, self._image.power
        power.quick_stop()
        self.stopping = [feedback]
        still = 0
        for _ in range(self._stop_cycles):
            if supervision.reaction is Reaction.LATCH:
                return False
            before = feedback.motor_counts
            feedback = self._exchange(None)
            self.stopping.append(feedback)
            stopped = feedback.fresh and power.state not in _STILL_DRIVEN
            still = still + 1 if stopped and abs(feedback.motor_counts - before) <= 1 else 0
            if still >= STILL_CYCLES:
                return True
        return False
