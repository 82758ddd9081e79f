"""Simulated drive as a CANopen node: NMT, heartbeats, SYNC, PDOs, SDO and EMCY around the firmware.

Upon SYNC, the node first sends its synchronous TPDOs with the current values, then applies the synchronous
RPDOs received since the last SYNC, then runs its axis for exactly one period of object 60C2h. (Some drives
apply RPDOs first; `Behaviour` has this and other choices.) Before the first SYNC, and when SYNC is missing
for one and a half periods, the axis runs on the node's clock instead, so a drive without a master can still
stop. Single-threaded: everything happens inside ``poll``.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import can

from hdbridge.canframe import DataFrame
from hdbridge.cia301 import NmtCommand, NmtState
from hdbridge.clock import Clock
from hdbridge.device.behaviour import Behaviour, HeartbeatConsumer
from hdbridge.device.dictionary import Dictionary, only, refusing
from hdbridge.device.emergency import Emergency, ErrorCode
from hdbridge.device.faults import Faults, Outgoing
from hdbridge.device.firmware import Firmware
from hdbridge.device.lss import ANSWER, REQUEST, UNCONFIGURED, LssSlave
from hdbridge.device.motion import Machine
from hdbridge.device.nameplate import MOTOR_POSITION, Nameplate
from hdbridge.device.parameters import StoredParameters
from hdbridge.device.pdo import ReceivePdo, TransmitPdo
from hdbridge.device.powerstate import POWERED, PowerStage
from hdbridge.device.sdo_server import SdoServer
from hdbridge.device.syncclock import SyncClock

PDO_COUNT: Final = 512
LONGEST_CATCH_UP_S: Final = 1.0
"""Maximum delay of a poll that the node catches up with; s."""

FRAMES_PER_POLL: Final = 64

_NEVER: Final = float("inf")
_HEARTBEAT: Final = 0x700


_INITIALISING = NmtState.INITIALISING
# The cyclic path uses this name because looking up an enum member in its class takes five times as long.

_AFTER_ERROR: Final = {0: NmtState.PRE_OPERATIONAL, 2: NmtState.STOPPED}
"""NMT state after a communication error, by the value of 1029h:01; 1 changes nothing."""


class DriveNode:
    """A CiA-402 drive on ``bus``, which moves ``machine``.

    ``bus`` is any python-can bus, and only this node may read it; ``eds_path`` declares the objects;
    ``clock`` is the node's clock; ``nameplate`` distinguishes drives, ``behaviour`` their firmware. ``stage``
    is a power stage with delays or failures, ``store`` the file of the stored parameters, and
    ``bit_rate_bps`` the bit rate of the interface, the only one that LSS can configure. ``poll`` must be
    called when frames may have arrived and at ``next_event_s``.
    """

    def __init__(
        self,
        bus: can.BusABC,
        machine: Machine,
        eds_path: Path,
        node_id: int,
        clock: Clock,
        nameplate: Nameplate | None = None,
        behaviour: Behaviour | None = None,
        stage: PowerStage | None = None,
        store: Path | None = None,
        bit_rate_bps: int | None = None,
    ) -> None:
        self.bus = bus
        self.behaviour = behaviour or Behaviour()
        self._lss = LssSlave(
            lambda sub: self.dictionary.value(0x1018, sub),
            node_id,
            stores=not self.behaviour.fixed_node_id,
            bit_rate_bps=bit_rate_bps,
        )
        self.faults = Faults()
        self.lost_frames = 0
        self.period_begins_s = clock.now()
        """Start of the current period of the axis, on the node's clock."""
        self.dictionary = Dictionary(Path(eds_path), node_id)
        self._clock = clock
        self.now_s = clock.now()
        """Time of reception of the frame, or of the event, that is being processed; on the node's clock."""
        self._assemble(machine, nameplate or Nameplate(), stage, store)
        self._begin()

    def _assemble(
        self, machine: Machine, nameplate: Nameplate, stage: PowerStage | None, store: Path | None
    ) -> None:
        nameplate.engrave(self.dictionary)
        self._parameters = StoredParameters(
            self.dictionary, lambda: self.firmware.state not in POWERED, store
        )
        self._parameters.restore()
        self.emergency = Emergency(self.dictionary, self._send_unless_stopped)
        self.firmware = Firmware(self.dictionary, machine, self.emergency, self.faults, self.behaviour, stage)
        if nameplate.load_object in self.dictionary and nameplate.load_object != MOTOR_POSITION:
            self.dictionary[nameplate.load_object].bind(self.firmware.motion.load_position)
        self._sdo = SdoServer(self.dictionary)
        self._tpdos = [TransmitPdo(self.dictionary, number, self._route) for number in self._pdos(0x1800)]
        holds, receiving = self.behaviour.holds_rpdo, self._pdos(0x1400)
        self._rpdos = [ReceivePdo(self.dictionary, number, self._route, holds=holds) for number in receiving]
        entry = self.dictionary
        # Bit 30 would make the node a SYNC producer.
        entry[0x1005, 0].guard = refusing(lambda value: value & ~0x7FF or not value & 0x7FF)
        entry[0x1005, 0].follower = lambda _: self._route()
        entry[0x1019, 0].guard = only(0, *range(2, 241))
        entry[0x1016, 1].guard = refusing(lambda value: value >> 23)
        entry[0x1016, 1].follower = lambda _: self._change_watch()
        entry[0x1017, 0].follower = lambda _: self._start_heartbeat()
        for index in (0x100C, 0x100D):
            entry[index, 0].follower = lambda _: self._stop_guarding()
        for sub in (1, 2):
            entry[0x60C2, sub].follower = lambda _: self._take_period()

    def _pdos(self, first: int) -> list[int]:
        """Returns the numbers of the PDOs in the dictionary; ``first`` is the index of PDO 1."""
        own = self.dictionary
        numbers = range(1, PDO_COUNT + 1)
        return [n for n in numbers if (first + n - 1, 1) in own and (first + 0x200 + n - 1, 0) in own]

    def _begin(self) -> None:
        """Initialises the communication from the dictionary, before the boot-up message."""
        self.nmt = NmtState.INITIALISING
        self._sdo.reset()
        self._sdo_from_s = self.now_s + self.behaviour.sdo_delay_s
        self._take_period()
        self._run_due_s = self.now_s + self.period_s
        for pdo in (*self._tpdos, *self._rpdos):
            pdo.compile()
        self._watch_heartbeat()
        self._guard_toggle = 0
        self._stop_guarding()
        self._route()
        self._start_heartbeat()
        self._due_s = self.now_s

    @property
    def node_id(self) -> int:
        """Node id in use; 255 if LSS removed it."""
        return self._lss.node_id

    def _boot(self) -> None:
        if self.node_id == UNCONFIGURED:
            return
        self._send(_HEARTBEAT + self.node_id, bytes([NmtState.INITIALISING]))
        self._enter(NmtState.PRE_OPERATIONAL)

    def _take_period(self) -> None:
        self.period_s = self._own_period_s()
        """Period of 60C2h, or of SYNC if the drive measures it."""
        self._measures_period = (
            self.dictionary.value(0x60C2, 1) == 0
            or (0x60C2, 1) not in self.dictionary
            or self.behaviour.measures_period
        )
        self._sync = SyncClock(self.period_s)
        self._sync_due_s = _NEVER

    def _own_period_s(self) -> float:
        """Returns the period in 60C2h; s."""
        value = self.dictionary.value
        return (value(0x60C2, 1) or 1) / 10.0 ** -value(0x60C2, 2)

    @property
    def has_sync(self) -> bool:
        """True while the node supervises SYNC and SYNC is not lost."""
        return self._sync_due_s < _NEVER

    def sync_is_late(self, now_s: float) -> bool:
        """Returns True if SYNC is overdue by so much that the node runs on its own clock."""
        left = self.behaviour.sync_timeout_periods - 0.5
        return self._sync_due_s - left * self.period_s <= now_s

    @property
    def jitter_s(self) -> float:
        """Mean absolute deviation of SYNC from its filtered time, s; 0 if the drive uses 60C2h."""
        return self._sync.jitter_s

    def _watch_heartbeat(self) -> None:
        """Evaluates object 1016h:01; supervision begins with the first heartbeat (CiA 301)."""
        word = self.dictionary.value(0x1016, 1)
        self._watched_s = (word & 0xFFFF) * 1e-3
        self._watched_id = _HEARTBEAT + (word >> 16 & 0x7F) if self._watched_s and word >> 16 & 0x7F else None
        self._watch_due_s = _NEVER
        self._watch_ended = False

    def _stop_guarding(self) -> None:
        """Stops life guarding (100Ch, 100Dh) until the master's next request (CiA 301)."""
        self._life_s = self.dictionary.value(0x100C) * self.dictionary.value(0x100D) * 1e-3
        self._life_due_s = _NEVER

    def _on_guarding(self, now_s: float) -> None:
        """Answers the remote frame of node guarding with the NMT state."""
        if self.faults.silent or self.faults.deaf:
            return
        self._send(_HEARTBEAT + self.node_id, bytes([self.nmt | self._guard_toggle]))
        self._guard_toggle ^= 0x80
        if self._life_s:
            self._life_due_s = now_s + self._life_s
            self.emergency.clear(ErrorCode.HEARTBEAT)
            self._due_s = self._next_due_s()

    def _change_watch(self) -> None:
        self._watch_heartbeat()
        self._listen()

    def _start_heartbeat(self) -> None:
        self._heartbeat_s = self.dictionary.value(0x1017) * 1e-3
        self._heartbeat_due_s = self.now_s + self._heartbeat_s if self._heartbeat_s else _NEVER
        self._due_s = self.now_s

    def _route(self) -> None:
        """Assigns frames and SYNC to the active PDOs."""
        running = self.nmt is NmtState.OPERATIONAL
        tpdos = [pdo for pdo in self._tpdos if running and pdo.valid]
        rpdos = [pdo for pdo in self._rpdos if running and pdo.valid]
        self._sync_tpdos = [pdo for pdo in tpdos if pdo.is_synchronous]
        self._event_tpdos = [pdo for pdo in tpdos if not pdo.is_synchronous]
        self._sync_rpdos = [pdo for pdo in rpdos if pdo.is_synchronous]
        self._rpdo_by_id = {pdo.can_id: pdo for pdo in rpdos}
        self._rpdo_due_s = _NEVER
        self._due_s = self.now_s
        self._listen()

    def _listen(self) -> None:
        """Assigns a handler to each CAN identifier that the node receives in its current state."""
        takers: dict[int | None, Callable[[bytearray, float], None]] = {REQUEST: self._on_lss}
        self._takers = takers
        if self.node_id == UNCONFIGURED:
            return
        takers |= {self._watched_id: self._on_watched_heartbeat, 0x000: self._on_nmt}
        for can_id, pdo in self._rpdo_by_id.items():
            takers[can_id] = partial(self._on_rpdo, pdo)
        if self.nmt is not NmtState.STOPPED:
            takers[0x600 + self.node_id] = self._on_sdo_request
            takers[self.dictionary.value(0x1005) & 0x7FF] = self._on_sync

    # ---------------------------------------------------------------- public interface

    def poll(self, now_s: float) -> None:
        """Receives and answers the waiting frames, and runs all events due until ``now_s``."""
        self.now_s = now_s
        if self.nmt is _INITIALISING:
            self._boot()
        receive, now = self.bus.recv, self._clock.now
        # The loop is bounded and reads the time for each frame: a master that answers immediately (as in an
        # SDO transfer) can keep it busy for long, and the watchdogs must not fall behind.
        left = FRAMES_PER_POLL
        while left and (message := receive(0)) is not None:
            left -= 1
            now_s = now()
            self.handle(message, now_s)
        self.run_until(now_s)

    def run_until(self, now_s: float) -> None:
        """Runs all events due until ``now_s`` without reading the bus, as the last step of ``poll``."""
        self.now_s = now_s
        if self.nmt is _INITIALISING:
            self._boot()
        if self.faults.pending:
            pending, self.faults.pending = self.faults.pending, []
            for happen in pending:
                happen(self)
        if now_s >= self._due_s:
            self._do_what_is_due(now_s)
        if self._event_tpdos:
            self._send_events(now_s)

    def next_event_s(self) -> float:
        """Returns the time by which ``poll`` must be called, on the clock's scale."""
        return self.now_s if self.faults.pending else self._due_s

    def handle(self, message: can.Message, now_s: float) -> None:
        """Processes a frame received at ``now_s``; ignores all but data frames with 11-bit identifiers."""
        self.now_s = now_s
        take = self._takers.get(message.arbitration_id)
        if take is None and message.is_remote_frame and message.arbitration_id == _HEARTBEAT + self.node_id:
            self._on_guarding(now_s)
        if take is None or self.faults.silent or self.faults.deaf:
            return
        if type(message) is DataFrame or not (
            message.is_extended_id or message.is_remote_frame or message.is_error_frame
        ):
            take(message.data, now_s)

    # ---------------------------------------------------------------- frames

    def _send(self, can_id: int, data: bytes) -> None:
        if self.faults.silent or can_id in self.faults.muted_ids:
            return
        try:
            self.bus.send(DataFrame(can_id, data))
        except can.CanOperationError:
            self.lost_frames += 1  # as on a bus that is down: a drive drops the frame and continues

    def _send_unless_stopped(self, can_id: int, data: bytes) -> None:
        if self.nmt in (NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL):
            self._send(can_id, data)

    def _on_sync(self, data: bytearray, now_s: float) -> None:
        begins_s = now_s
        if self._measures_period:
            # A drive without object 60C2h, or with 0 in it, takes its period from SYNC.
            self._sync.take(now_s)
            begins_s, self.period_s = self._sync.time_s, self._sync.period_s
        if self.behaviour.rpdo_before_tpdo:
            self._apply_rpdos()
        tpdos: list[Outgoing] = []
        for tpdo in self._sync_tpdos:
            if tpdo.sync_start and not tpdo.has_started(data):
                continue
            values = tpdo.on_sync()
            if values is not None:
                tpdos.append((tpdo.can_id, values))
        if self.faults.concerns_tpdos:
            tpdos = self.faults.spoil(tpdos)
        for can_id, mapped in tpdos:
            self._send(can_id, mapped)
        self._apply_rpdos()
        self.period_begins_s = begins_s
        self._advance()
        self._run_due_s = now_s + 1.5 * self.period_s
        if self.behaviour.sync_timeout_periods:
            self._sync_due_s = now_s + (1.0 + self.behaviour.sync_timeout_periods) * self.period_s
            self.emergency.clear(ErrorCode.SYNC_LOST)
        self._due_s = self._next_due_s()

    def _apply_rpdos(self) -> None:
        for rpdo in self._sync_rpdos:
            if rpdo.pending is not None:
                pending, rpdo.pending = rpdo.pending, None
                rpdo.apply(pending)

    def _on_rpdo(self, pdo: ReceivePdo, data: bytearray, now_s: float) -> None:
        if len(data) < pdo.length:
            self.emergency.occur(ErrorCode.PDO_TOO_SHORT)
            return
        if pdo.event_timer_s:
            pdo.deadline_s = now_s + pdo.event_timer_s
            before_s = self._rpdo_due_s
            due_s = pdo.deadline_s
            if len(self._rpdo_by_id) > 1:
                due_s = min([each.deadline_s for each in self._rpdo_by_id.values()])
            self._rpdo_due_s = due_s
            if before_s <= self._due_s or due_s < self._due_s:  # an earlier event remains
                self._due_s = self._next_due_s()
        if len(data) > pdo.length:
            self.emergency.occur(ErrorCode.PDO_TOO_LONG)
        elif self.emergency.active:
            for code in (ErrorCode.PDO_TOO_SHORT, ErrorCode.PDO_TOO_LONG):
                self.emergency.clear(code)
        if pdo.is_synchronous:
            pdo.pending = data
        else:
            pdo.apply(data)

    def _on_sdo_request(self, data: bytearray, now_s: float) -> None:
        if now_s < self._sdo_from_s:
            return
        for answer in self._sdo.respond(bytes(data)):
            self._send(0x580 + self.node_id, answer)

    def _on_nmt(self, data: bytearray, _: float) -> None:
        if len(data) < 2 or data[1] not in (0, self.node_id):
            return
        command = data[0]
        if command == NmtCommand.START:
            self._enter(NmtState.OPERATIONAL)
        elif command == NmtCommand.STOP:
            self._leave_operational(NmtState.STOPPED)
        elif command == NmtCommand.PRE_OPERATIONAL:
            self._leave_operational(NmtState.PRE_OPERATIONAL)
        elif command == NmtCommand.RESET_NODE:
            self.reset()
        elif command == NmtCommand.RESET_COMMUNICATION:
            self._reset_communication()

    def _enter(self, state: NmtState) -> None:
        if self.nmt is state:
            return
        self.nmt = state
        for pdo in (*self._tpdos, *self._rpdos):
            pdo.restart()
        self._route()

    def _leave_operational(self, state: NmtState) -> None:
        """Stops the PDOs. An axis that depends on them has lost its master (6007h)."""
        lost = state is NmtState.STOPPED or (
            self.nmt is NmtState.OPERATIONAL and self.firmware.follows_the_bus
        )
        if lost:
            self.firmware.connection_lost(ErrorCode.COMMUNICATION)
        self._enter(state)

    def drop_out(self) -> None:
        """Enters PRE-OPERATIONAL without a command, and reports it."""
        self._leave_operational(NmtState.PRE_OPERATIONAL)
        self._send_heartbeat()

    def _on_lss(self, data: bytearray, _: float) -> None:
        answer = self._lss.respond(bytes(data))
        if answer is not None:
            self._send(ANSWER, answer)
        if self.node_id == UNCONFIGURED != self._lss.pending and not self._lss.configuring:
            self._reset_communication()  # CiA 305: a node without an id starts once it has one

    def _take_node_id(self) -> None:
        before, after = self.node_id, self._lss.pending
        if after != before:
            self.dictionary.renumber(before, after)
            self._lss.node_id = after

    def _reset_communication(self) -> None:
        self.firmware.connection_lost(ErrorCode.COMMUNICATION)
        self._take_node_id()
        self._parameters.restore(0x1000, 0x1FFF)
        self._begin()
        self._boot()

    def reset(self) -> None:
        """Restarts as after power-on, with a boot-up message (NMT reset node)."""
        self._lss.pending = self._lss.stored
        self._lss.configuring = False
        self._take_node_id()
        self._parameters.restore()
        self.emergency.reset()
        self.firmware.reset()
        self._begin()
        self._boot()

    def _on_watched_heartbeat(self, _: bytearray, now_s: float) -> None:
        if self._watch_ended:
            return
        self._watch_due_s = now_s + self._watched_s
        self.emergency.clear(ErrorCode.HEARTBEAT)
        self._due_s = self._next_due_s()

    # ---------------------------------------------------------------- time

    def _advance(self) -> None:
        motion, faults = self.firmware.motion, self.faults
        motion.load_jump_counts, motion.load_reading = faults.load_jump_counts, faults.load_reading
        motion.motor_jump_counts = faults.motor_jump_counts
        self.firmware.advance(self.period_s)

    def _next_due_s(self) -> float:
        due_s = min(
            self._run_due_s, self._heartbeat_due_s, self._watch_due_s, self._life_due_s,
            self._rpdo_due_s, self._sync_due_s,
        )  # fmt: skip
        for tpdo in self._event_tpdos:
            due_s = min(due_s, tpdo.due_s(self.now_s))
        return due_s

    def _do_what_is_due(self, now_s: float) -> None:
        self._run_due_s = max(self._run_due_s, now_s - LONGEST_CATCH_UP_S)
        while self._run_due_s <= now_s:
            self.period_begins_s = self._run_due_s
            self._run_due_s += self.period_s
            self._advance()
        if self._sync_due_s <= now_s:
            self._lose_sync()
        if min(self._watch_due_s, self._life_due_s) <= now_s:
            self._lose_heartbeat()
        if self._rpdo_due_s <= now_s:
            self._miss_rpdo(now_s)
        if self._heartbeat_due_s <= now_s:
            self._send_heartbeat()
            late = now_s - self._heartbeat_due_s
            skipped = int(late / self._heartbeat_s)
            self._heartbeat_due_s += (1 + skipped) * self._heartbeat_s
        self._due_s = self._next_due_s()

    def _send_heartbeat(self) -> None:
        if not self.faults.mute_heartbeat:
            self._send(_HEARTBEAT + self.node_id, bytes([self.nmt]))

    def _send_events(self, now_s: float) -> None:
        for tpdo in self._event_tpdos:
            data = tpdo.on_event(now_s)
            if data is not None:
                self._send(tpdo.can_id, data)
        self._due_s = self._next_due_s()

    def _lose_heartbeat(self) -> None:
        self._watch_due_s = self._life_due_s = _NEVER
        self._watch_ended = self.behaviour.heartbeat_consumer is HeartbeatConsumer.STOPS
        if self.faults.ignore_lost_heartbeat:
            return
        self.emergency.occur(ErrorCode.HEARTBEAT)
        if self.faults.only_report_lost_heartbeat:
            return
        self.firmware.connection_lost(ErrorCode.HEARTBEAT)
        state = _AFTER_ERROR.get(self.dictionary.value(0x1029, 1))
        if state is not None and self.nmt is NmtState.OPERATIONAL and not self.faults.stay_operational:
            self._enter(state)

    def _lose_sync(self) -> None:
        """Discards pending set-points when SYNC is overdue, and stops an axis that follows the bus.

        The period returns to 60C2h, because the measured period of sparse SYNCs is too long for an axis on
        its own clock.
        """
        self._sync_due_s = _NEVER
        self.period_s = self._own_period_s()
        for rpdo in self._sync_rpdos:
            rpdo.pending = None
        if self.firmware.follows_the_bus:
            self.emergency.occur(ErrorCode.SYNC_LOST)
            self.firmware.connection_lost(ErrorCode.SYNC_LOST)

    def bus_failed(self) -> None:
        """Treats an interface that is down or bus-off as a lost master (6007h), in any mode."""
        for rpdo in self._rpdos:
            rpdo.pending = None
        self.firmware.connection_lost(ErrorCode.COMMUNICATION)

    def _miss_rpdo(self, now_s: float) -> None:
        """Stops an axis that follows the bus if an RPDO is overdue. The next RPDO re-arms the timer."""
        for pdo in self._rpdo_by_id.values():
            if pdo.deadline_s <= now_s:
                pdo.deadline_s = _NEVER
        self._rpdo_due_s = min((pdo.deadline_s for pdo in self._rpdo_by_id.values()), default=_NEVER)
        watches = self.behaviour.rpdo_timer and not self.faults.ignore_missing_set_points
        if self.firmware.follows_the_bus and watches:
            self.emergency.occur(ErrorCode.RPDO_TIMEOUT)
            self.firmware.connection_lost(ErrorCode.RPDO_TIMEOUT)
