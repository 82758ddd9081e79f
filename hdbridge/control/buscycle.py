"""Control cycle of one bus: one thread, absolute deadlines, the same order in every period.

    wait - drain - stop before SYNC - SYNC - receive - check - RPDOs - heartbeat

* *drain*: frames queued since the last cycle do not belong to this cycle. Heartbeats and emergencies are
  noted; TPDOs are stale and are discarded after a check of their statusword.
* *stop*: a drive applies its last RPDO at SYNC, whatever has happened since it was sent. That RPDO is
  therefore replaced by a quick stop before the first SYNC, after a stall of this process beyond the drive's
  time-out, and after a fault that stops an axis. Drives of silent axes are put into PRE-OPERATIONAL instead.
* *receive*: until every TPDO of every axis has arrived, or the window closes. The newest frame of each
  identifier counts. TPDOs of the optional channels are awaited if they come with every SYNC and are not lost;
  otherwise they are accepted whenever they arrive.
* *check*: axis by axis, by the fault table of `hdbridge.drive.supervision`.
* *RPDOs*: built from this cycle's feedback; each is sent before the next axis is checked.
* *heartbeat*: the master's heartbeat is sent only by this loop, so the drives notice a stalled loop.

A fault of one axis stops only that axis (`hdbridge.control.axiscycle`); a bus fault affects all axes. If a
period begins more than half a period late, it and all other missed periods are skipped, and the next SYNC
comes at the next whole period. SYNCs are never closer together than half a period.

In this module, speed takes precedence over style: no logging, no SDO, no avoidable allocation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from hdbridge.cia301 import NmtCommand, NmtState
from hdbridge.clock import Clock
from hdbridge.control.axiscycle import AxisCycle
from hdbridge.control.busroutes import Slot, conflict, routes
from hdbridge.control.latency import Histogram
from hdbridge.drive.busload import FRAME_BITS
from hdbridge.drive.fastlink import fast_link
from hdbridge.drive.link import Frame, Link, TransmitBufferFull
from hdbridge.drive.objects import COB_NMT, COB_SYNC
from hdbridge.drive.pdo import PdoLengthError
from hdbridge.drive.supervision import Fault
from hdbridge.drive.traffic import bus_faults
from hdbridge.errors import BusError, InputError

WINDOW: Final = 0.8
"""Fraction of the period after SYNC within which the TPDOs must arrive; the rest is for sending the RPDOs."""
LATE: Final = 0.5
"""Maximum lateness of a cycle that is not skipped, as a fraction of the period."""
SPARE: Final = 0.1
"""Fraction of the period before the next SYNC in which no frames of ``outgoing`` are sent."""
DRAIN_MAXIMUM: Final = 256
"""Maximum number of frames read before SYNC; a full bus at 1 Mbit/s delivers at most 220 in 10 ms."""
FLUSH_MAXIMUM: Final = 10_000
"""Maximum number of queued frames that are discarded at the start of the cycle."""
_CLOCK_STEP_S: Final = 1e-6
"""Tolerance for rounding of times that are sums of periods."""
_HEARTBEAT_DATA: Final = bytes([NmtState.OPERATIONAL])


class BusCycle:
    """Runs the axes of one bus over a link, one `exchange` per period.

    ``on_frame`` receives every frame that is not a PDO of the cycle: SDO answers, heartbeats, emergencies.
    ``outgoing`` is called once per cycle, after all frames of the cycle are sent, and returns an additional
    frame to send, or None. Both may be set at any time. They run within the cycle, so they must be fast and
    must not raise.
    """

    def __init__(
        self,
        link: Link,
        clock: Clock,
        period_s: float,
        *,
        bitrate_bps: int | None = None,
    ) -> None:
        self.clock = clock
        self.period_s = period_s
        self.on_frame: Callable[[Frame], None] | None = None
        self.outgoing: Callable[[], tuple[int, bytes] | None] | None = None
        self.axes: tuple[AxisCycle, ...] = ()
        """Axes, in the order in which they are judged and their RPDOs are sent."""
        self.histogram = Histogram()
        """Histogram of the lateness with which the periods started."""
        self.overruns = 0
        """Number of cycles skipped because they began too late."""
        self.skipped = 0
        """Number of whole periods without a SYNC."""
        self.refused = 0
        """Number of frames of ``outgoing`` dropped because the transmit buffer was full."""

        self.count = -1
        """Number of the last period, including skipped periods."""
        self.woke_s = clock.now()
        """Clock time at which the last cycle began."""
        self.due_s = self.woke_s
        """Clock time at which the last cycle was due."""
        self.late_s = 0.0
        """Lateness of the start of the last cycle."""
        self.busy_s = 0.0
        """Duration of the last cycle, without the wait for its start."""
        self.faults: list[tuple[Fault, str]] = []
        """Faults of the bus itself in the last cycle, which each speaking axis has judged as well."""
        self.down: str | None = None
        """Failure of the interface in the last cycle, in words; None without a failure."""

        self._window_s = WINDOW * period_s
        self._late_s = LATE * period_s
        self._per_bit = 1.0 / (bitrate_bps * period_s) if bitrate_bps is not None else math.nan
        self._slots: dict[int, Slot] = {}
        self._listeners: dict[int, AxisCycle] = {}
        self._speaking: tuple[AxisCycle, ...] = ()
        self._listening: tuple[AxisCycle, ...] = ()
        self._beginning: list[AxisCycle] = []
        self._awaited = self._early = 0
        self._bits = self._period_bits = FRAME_BITS[0]
        self._heartbeat_id = 0
        self._heartbeat_period_s = math.inf
        self._heartbeat_s = self.woke_s
        self._bus_faults = bus_faults(self._heartbeat_id)
        self._discarded = 0
        self._changed = True
        self.relink(link)

    @property
    def bus_load(self) -> float:
        """Worst-case fraction of the period occupied by frames in the last cycle.

        NaN if the bit rate is unknown. An awaited frame counts even if it did not arrive.
        """
        return self._period_bits * self._per_bit

    def join(self, axis: AxisCycle) -> None:
        """Adds an axis, which stays silent until its ``begin``. Must not be called within a cycle.

        Raises InputError if another axis uses one of its identifiers, or if it requires a different cycle
        time or master.
        """
        config = axis.image.axis
        if config.drive.cycle_s != self.period_s:
            raise InputError(
                f"{config.where('drive.cycle_ms')}: {config.drive.cycle_ms:g} ms, but the bus runs at "
                f"{1e3 * self.period_s:g} ms; all axes on one bus have one cycle"
            )
        if (found := conflict([each.image.axis for each in (*self.axes, axis)])) is not None:
            raise InputError(found[1])
        self.axes = (*self.axes, axis)
        axis.changed = self._change
        self._heartbeat_id = axis.image.heartbeat_id
        self._heartbeat_period_s = min(self._heartbeat_period_s, axis.image.heartbeat_period_s)
        self._bus_faults = bus_faults(self._heartbeat_id)
        self._changed = True

    def restart(self) -> None:
        """Restarts at once with the next `exchange`, after a pause; the cycle numbers continue.

        Frames and encoder motion during the pause are not judged. Latches, the histogram and the silent axes
        stay.
        """
        self._deadline: float | None = None
        self._flushing = self._interrupted = True
        for axis in self.axes:
            if not axis.silent:
                axis.begin()

    def relink(self, link: Link) -> None:
        """Continues on a new link, after the bus failed and was reopened.

        The axes stay latched: each must be verified, released (`Supervision.reset`) and begun.
        """
        fast = fast_link(link)
        self._send, self._recv, self._dropped = fast.send, fast.recv, fast.dropped
        self.restart()

    def exchange(self) -> None:
        """Runs one period for all axes; the results are in each axis and in this object.

        Errors of the bus or the axes are not raised but latched in the affected axes.
        """
        now = self._wait()
        count = self.count
        time_s = count * self.period_s
        self.down = None
        if self._changed:
            self._rebuild(now)
        self._period_bits = self._bits
        try:
            read = self._drain(now)
            try:
                self._stop_before_sync()
                self._send(COB_SYNC, b"")
            except TransmitBufferFull as error:
                self._fault_on_all(Fault.TRANSMIT_FULL, f"SYNC: {error}")
                got = 0
            else:
                got = self._receive(self.clock.now() + self._window_s)
                if not read:
                    got = 0

            for axis in self._speaking:
                frames = axis.run_period(now, count, time_s, got & axis.needed == axis.needed)
                for frame in frames or ():
                    try:
                        self._send(*frame)
                    except TransmitBufferFull as error:
                        # A stale set-point is worse than none, so the frame is not resent, and the axes stop.
                        self._no_room(f"RPDO: {error}")
            for axis in self._listening:
                axis.listen(count, time_s, got & axis.needed == axis.needed)
            if now >= self._heartbeat_s:
                self._heartbeat(now)
            if self.outgoing is not None:
                self._send_for_others(self.outgoing)
        except BusError as error:
            self._failed(str(error))
        self.busy_s = self.clock.now() - now

    # ---------------------------------------------------------------- parts of a cycle

    def _wait(self) -> float:
        """Sleeps until the next deadline, skipping missed periods; returns the clock time."""
        clock, deadline, period_s = self.clock, self._deadline, self.period_s
        self.count += 1
        if self.faults:
            self.faults.clear()
        if deadline is None:
            self.woke_s = self.due_s = now = clock.now()
            self.late_s = 0.0
            self._deadline = now + period_s
            return now
        clock.sleep_until(deadline)
        now = clock.now()
        self.late_s = late_s = now - deadline
        self.histogram.record(late_s)
        if late_s > self._late_s:
            missed = int(late_s / period_s) + 1
            self._overrun(late_s, missed)
            deadline += missed * period_s
            clock.sleep_until(deadline)
            now = clock.now()
        self._deadline = deadline + period_s
        self.due_s, self.woke_s = deadline, now
        return now

    def _overrun(self, late_s: float, missed: int) -> None:
        self.overruns += 1
        self.skipped += missed
        self.count += missed
        self._fault_on_all(Fault.OVERRUN, f"by {1e3 * late_s:.1f} ms, periods skipped: {missed}")

    def _stop_before_sync(self) -> None:
        """Replaces set-points that must not take effect with the next SYNC."""
        send, now = self._send, self.clock.now()
        for axis in self._speaking:
            if now - axis.last_sent_s >= axis.master_timeout_s - _CLOCK_STEP_S and axis.powered:
                self._note_hang(axis, now - axis.last_sent_s)
        if self._interrupted:
            for axis in self.axes:
                if axis.silent:
                    send(COB_NMT, bytes((NmtCommand.PRE_OPERATIONAL, axis.image.node_id)))
                else:
                    for frame in axis.image.pack_rpdo_stop():
                        send(*frame)
            self._interrupted = False
        else:
            for axis in self._speaking:
                if axis.pending:
                    for frame in axis.stop_before_sync() or ():
                        send(*frame)

    def _note_hang(self, axis: AxisCycle, silence_s: float) -> None:
        """Records that this process was silent beyond the time-out of a powered drive."""
        hang = (Fault.HANG, f"{1e3 * silence_s:.0f} ms; the drive waits {1e3 * axis.master_timeout_s:.0f} ms")
        axis.pending.insert(0, hang)
        if all(fault is not Fault.HANG for fault, _ in self.faults):
            self.faults.append(hang)

    def _drain(self, now: float) -> bool:
        """Reads the queued frames; returns False if there are too many."""
        recv, slots = self._recv, self._slots
        self._early = 0
        most = DRAIN_MAXIMUM
        if self._flushing:
            # After a pause all queued frames are stale.
            most = FLUSH_MAXIMUM
            self._heartbeat_s = now
        for _ in range(most):
            frame = recv(now)
            if frame is None:
                break
            slot = slots.get(frame.can_id)
            if slot is None:
                self._other(frame)
            else:
                self._before_sync(frame, slot)
        else:
            if not self._flushing:
                self._fault_on_all(Fault.FLOOD, f"more than {DRAIN_MAXIMUM} before SYNC")
                return False
        if self._flushing:
            self._flushing = False
            self._discarded = self._dropped.total
        if self._beginning:
            for axis in self._beginning:
                axis.flushing = False
            self._beginning.clear()
        return True

    def _before_sync(self, frame: Frame, slot: Slot) -> None:
        """Handles a TPDO before SYNC: stale if awaited, else accepted."""
        bit, accept, axis = slot
        if axis.awaited:
            if not axis.flushing:
                axis.check_statusword(frame)
                axis.pending.append((Fault.DUPLICATE_TPDO, f"{frame.can_id:03X}h before SYNC"))
            return
        self._period_bits += FRAME_BITS[len(frame.data)]
        try:
            accept(frame.data)
        except PdoLengthError:
            return
        self._early |= bit

    def _receive(self, window_end_s: float) -> int:
        """Reads this cycle's TPDOs until all have arrived or the window closes; returns their bits."""
        recv, slots, awaited = self._recv, self._slots, self._awaited
        got = self._early
        spoilt: dict[int, int] | None = None
        while got & awaited != awaited:
            frame = recv(window_end_s)
            if frame is None:
                break
            can_id, data, time_s = frame
            slot = slots.get(can_id)
            if slot is None:
                self._other(frame)
                if time_s > window_end_s:
                    break
                continue
            bit, accept, axis = slot
            if got & bit and axis.awaited:
                axis.pending.append((Fault.DUPLICATE_TPDO, f"{can_id:03X}h twice"))
            try:
                accept(data)
            except PdoLengthError:
                spoilt = spoilt or {}
                spoilt[can_id] = len(data)
                continue
            got |= bit
        dropped = self._dropped
        discarded = dropped.remote + dropped.extended + dropped.error + dropped.fd
        if discarded != self._discarded:
            self._discarded = discarded
            self._fault_on_all(Fault.DISCARDED_FRAME, "remote, extended, FD or error frame")
        if spoilt is not None or got & awaited != awaited:
            self._note_missing(got, spoilt or {})
        return got

    def _note_missing(self, got: int, spoilt: dict[int, int]) -> None:
        """Records missing TPDOs and TPDOs of wrong length as faults of their axis."""
        for can_id, length in spoilt.items():
            bit, _, axis = self._slots[can_id]
            if axis.awaited:
                # The axis has a fault only if it needs that TPDO and no valid one arrived.
                fault = Fault.WRONG_LENGTH if bit & axis.needed & ~got else Fault.DISCARDED_FRAME
                expected = axis.image.length_of(can_id)
                axis.pending.append((fault, f"{can_id:03X}h with {length} bytes, expected {expected}"))
        for axis in self._speaking:
            missing = axis.needed & ~got
            if missing and axis.awaited:
                lost = [
                    f"{can_id:03X}h"
                    for can_id in axis.image.tpdo_ids
                    if self._slots[can_id][0] & missing and can_id not in spoilt
                ]
                if lost:
                    axis.pending.append((Fault.LOST_TPDO, ", ".join(lost)))

    def _other(self, frame: Frame) -> None:
        """Forwards any other frame to its axis and to ``on_frame``; records bus faults."""
        self._period_bits += FRAME_BITS[len(frame.data)]
        axis = self._listeners.get(frame.can_id)
        if axis is not None:
            axis.hear(frame)
        elif not self._flushing:
            fault = self._bus_faults.get(frame.can_id)
            if fault is not None:
                self._fault_on_all(*fault)
        if self.on_frame is not None:
            self.on_frame(frame)

    def _heartbeat(self, now: float) -> None:
        """Sends the master's heartbeat when due; a missed heartbeat is not sent later."""
        self._heartbeat_s += self._heartbeat_period_s
        if self._heartbeat_s <= now:
            self._heartbeat_s = now + self._heartbeat_period_s
        self._period_bits += FRAME_BITS[1]
        try:
            self._send(self._heartbeat_id, _HEARTBEAT_DATA)
        except TransmitBufferFull as error:
            self._no_room(f"heartbeat: {error}")

    def _send_for_others(self, outgoing: Callable[[], tuple[int, bytes] | None]) -> None:
        """Sends one frame of ``outgoing`` if there is time before the next SYNC."""
        if self.clock.now() > self.woke_s + (1.0 - SPARE) * self.period_s:
            return
        frame = outgoing()
        if frame is None:
            return
        self._period_bits += FRAME_BITS[len(frame[1])]
        try:
            self._send(*frame)
        except TransmitBufferFull:
            self.refused += 1

    # ---------------------------------------------------------------- faults of the bus

    def _fault_on_all(self, fault: Fault, detail: str) -> None:
        """Records a bus fault for every axis, before the axes react."""
        self.faults.append((fault, detail))
        for axis in self._speaking:
            if not axis.flushing:
                axis.pending.append((fault, detail))

    def _no_room(self, detail: str) -> None:
        """Records an unsent frame of the cycle; axes already served in this cycle stop in the next."""
        self.faults.append((Fault.TRANSMIT_FULL, detail))
        for axis in self._speaking:
            if axis.feedback.cycle == self.count:
                axis.add_fault(self.count, Fault.TRANSMIT_FULL, detail)
            else:
                axis.pending.append((Fault.TRANSMIT_FULL, detail))

    def _failed(self, detail: str) -> None:
        self.down = detail
        self.faults.append((Fault.BUS_DOWN, detail))
        time_s = self.count * self.period_s
        for axis in self._speaking:
            axis.bus_down(self.count, time_s, detail)
        for axis in self._listening:
            axis.stale(self.count, time_s)

    # ---------------------------------------------------------------- axes on the bus

    def _change(self) -> None:
        """Requests `_rebuild` in the next cycle."""
        self._changed = True

    def _rebuild(self, now: float) -> None:
        """Recomputes the routes, and starts the axes that begin."""
        self._changed = False
        self._speaking, self._listening, self._slots, self._listeners, self._awaited, self._bits = routes(
            self.axes
        )
        for axis in self._speaking:
            if axis.flushing:
                axis.start(now, self.count)
                self._beginning.append(axis)
