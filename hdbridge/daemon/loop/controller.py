"""The control loop of one machine; each call of `Controller.turn` runs one cycle. Clock, bus and memory are
passed in.

    commands - knots - [wait - SYNC - TPDOs - judge - targets - RPDOs - service's frame] - states - sample

The part in brackets is `BusCycle.exchange`. Slow work, such as planning a move or loading another
compensation, runs after the RPDOs of one cycle and before the wait for the next.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.cia301 import NmtCommand
from hdbridge.control.buscycle import BusCycle
from hdbridge.daemon.loop.axisloop import AxisLoop
from hdbridge.daemon.loop.relay import incoming_ids, refusal_reason
from hdbridge.daemon.loop.states import AxisState, label
from hdbridge.daemon.machinefile import LoadLoopSettings
from hdbridge.daemon.memory import Cell, Command, CommandKind, Event, EventKind, Memory, RelayedFrame
from hdbridge.drive.link import Frame, Link
from hdbridge.drive.objects import COB_NMT
from hdbridge.drive.states import State
from hdbridge.errors import BusError, HdbridgeError, InputError

COMMANDS_PER_TURN: Final = 8
REOPEN_EVERY_S: Final = 0.5
"""Interval between attempts to reopen a failed interface."""
REFUSALS_PER_SECOND: Final = 10
"""Maximum rate of reports of refused relay frames."""
ENDING_TIMEOUT_S: Final = 10.0
"""Time after which the process ends even if the drives have not confirmed power-off."""
_ALL: Final = -1
_AT_REST: Final = frozenset({AxisState.UNVERIFIED, AxisState.DISABLED, AxisState.LATCHED})
_OFF: Final = frozenset({State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON, State.UNKNOWN})


class Controller:
    """Control loop of all axes of one bus; takes commands from the shared memory and reports to it."""

    def __init__(
        self,
        cycle: BusCycle,
        axes: Sequence[tuple[AxisConfig, LoadLoopSettings | None]],
        memory: Memory,
        reopen: Callable[[], Link | None] = lambda: None,
    ) -> None:
        """``axes`` are the axis files, each with the settings of its load loop, if any.

        ``reopen`` reopens the interface after a failure; it returns None while the interface is down.

        Raises InputError if the axes cannot share one bus, or if the shared memory is for another number of
        axes.
        """
        if memory.axes != len(axes):
            raise InputError(f"shared memory for {memory.axes} axes, but the machine has {len(axes)}")
        self.cycle = cycle
        self.memory = memory
        self.axes = tuple(
            AxisLoop(index, config, load_loop, memory, partial(self._report, index), lambda: cycle.due_s)
            for index, (config, load_loop) in enumerate(axes)
        )
        for axis in self.axes:
            cycle.join(axis.cycle)
        self.ended = False
        """True once `end` has switched all axes off, or has timed out; no further cycles are due."""

        self._reopen = reopen
        self._axis_of_node = {node: axis for axis in self.axes for node in axis.config.nodes}
        self._incoming_ids = incoming_ids(self._axis_of_node)
        self._down = False
        self._reopen_in = 0
        self._last_refusal_cycle = 0
        self._ending = self._at_once = False
        self._ending_turns_left = 0
        self._released: set[int] = set()
        cycle.on_frame = self._relay_incoming
        cycle.outgoing = self._relay_outgoing
        # Waiting commands, frames and knots were meant for an earlier loop with the axes in other states.
        memory.commands.clear()
        memory.outgoing.clear()
        for knots, followed in zip(memory.knots, memory.followed, strict=True):
            knots.clear()
            followed.clear()
        memory.status[Cell.LOOP_PID] = os.getpid()

    # ---------------------------------------------------------------- one cycle

    def turn(self) -> None:
        """Runs one cycle. Does not raise errors of the bus or the service."""
        cycle, axes = self.cycle, self.axes
        self._take_commands()
        for axis in axes:
            axis.before()
        cycle.exchange()
        if cycle.down is not None or self._down:
            self._bus_down()
        for axis in axes:
            axis.after()
            if axis.left_group:
                self._stop_group(axis)
        if self._ending:
            self._continue_ending()
        self._sample()

    def _sample(self) -> None:
        cycle = self.cycle
        values: list[float] = []
        for axis in self.axes:
            values += axis.sample()
        woke_s = cycle.woke_s
        self.memory.samples.append((
            cycle.count,
            round(1e9 * woke_s),
            1e6 * cycle.late_s,
            1e6 * (cycle.clock.now() - woke_s),
            cycle.bus_load,
            cycle.skipped & 0xFFFF_FFFF,
            *values,
        ))  # fmt: skip
        self.memory.status[Cell.LOOP_COUNT] += 1

    def _report(self, axis: int, kind: EventKind, id_: int = 0, code: int = 0, text: str = "") -> None:
        cycle = self.cycle
        time_ns = round(1e9 * cycle.woke_s)
        self.memory.events.append(Event(0, cycle.count, time_ns, axis, kind, id_, code, text))

    # ---------------------------------------------------------------- commands

    def _take_commands(self) -> None:
        take = self.memory.commands.take
        for _ in range(COMMANDS_PER_TURN):
            if (command := take()) is None:
                break
            self._command(command)

    def _command(self, command: Command) -> None:
        try:
            kind = CommandKind(command.kind)
            if kind is CommandKind.STREAM_BEGIN:
                self._begin_stream(command)
            elif command.axis == _ALL and kind in (CommandKind.QUICK_STOP, CommandKind.STOP):
                for axis in self.axes:
                    axis.command(command._replace(id=0))
                self._report(_ALL, EventKind.DONE, command.id)
            elif self._ending and kind not in (CommandKind.QUICK_STOP, CommandKind.STOP):
                raise InputError(f"{label(kind)}: the daemon is ending")
            else:
                self._axis(command.axis).command(command)
        except (HdbridgeError, ValueError) as error:
            self._report(command.axis, EventKind.REFUSED, command.id, command.kind, str(error))

    def _axis(self, index: int) -> AxisLoop:
        if not 0 <= index < len(self.axes):
            raise InputError(f"there is no axis {index}; expected 0 to {len(self.axes) - 1}")
        return self.axes[index]

    def _begin_stream(self, command: Command) -> None:
        """Begins a stream on all axes of the command's mask, or on none of them."""
        mask = command.i or 1 << self._axis(command.axis).index
        if mask >> len(self.axes):
            raise InputError(f"a stream of axes {mask:b}b; there are only {len(self.axes)}")
        members = [axis for axis in self.axes if mask >> axis.index & 1]
        for axis in members:
            axis.check(CommandKind.STREAM_BEGIN)
            if not axis.set_point.at_rest:
                raise InputError(f"{axis.config.name}: a stream begins at rest: stop the axis first")
        group = frozenset(axis.index for axis in members) if len(members) > 1 else frozenset()
        for axis in members:
            axis.begin_stream(command, group)
        self._report(command.axis, EventKind.DONE, command.id)

    def _stop_group(self, stopped: AxisLoop) -> None:
        """Brakes the other axes of a group when one axis leaves it."""
        for index in stopped.left_group:
            axis = self.axes[index]
            if axis.group == stopped.left_group:
                axis.group = frozenset()
                axis.stop()
        stopped.left_group = frozenset()

    # ---------------------------------------------------------------- the service's frames

    def _relay_incoming(self, frame: Frame) -> None:
        if frame.can_id in self._incoming_ids:
            self.memory.incoming.append(RelayedFrame(round(1e9 * frame.time_s), frame.can_id, frame.data))

    def _relay_outgoing(self) -> tuple[int, bytes] | None:
        frame = self.memory.outgoing.take()
        if frame is None:
            return None
        _, can_id, data = frame
        states = {node: axis.state for node, axis in self._axis_of_node.items()}
        refusal = refusal_reason(can_id, data, states)
        if refusal is None:
            if can_id == COB_NMT and data[0] == NmtCommand.START:
                self._axis_of_node[data[1]].cycle.monitor.started(data[1])
            return can_id, data
        second = round(1.0 / self.cycle.period_s)
        if self.cycle.count - self._last_refusal_cycle > second // REFUSALS_PER_SECOND:
            self._last_refusal_cycle = self.cycle.count
            self._report(_ALL, EventKind.REFUSED, 0, 0, refusal)
        return None

    # ---------------------------------------------------------------- the bus

    def _bus_down(self) -> None:
        """Reports a bus failure or recovery, and tries to reopen the interface while it is down."""
        cycle = self.cycle
        if cycle.down is None:
            self._down = False
            self._report(_ALL, EventKind.BUS_UP)
            return
        if not self._down:
            self._down = True
            self._reopen_in = 0
            self._report(_ALL, EventKind.BUS_DOWN, text=cycle.down)
            self.memory.outgoing.clear()
            for axis in self.axes:
                axis.verification_lost()
        self._reopen_in -= 1
        if self._reopen_in <= 0:
            self._reopen_in = round(REOPEN_EVERY_S / cycle.period_s)
            # No axis communicates while the bus is down, so reopening may take longer than a cycle.
            with suppress(BusError):
                if (link := self._reopen()) is not None:
                    cycle.relink(link)

    # ---------------------------------------------------------------- the end

    def end(self, *, at_once: bool = False) -> None:
        """Stops all axes and switches power off; `ended` then becomes True.

        Axes are braked to rest, or quick-stopped with ``at_once``. Repeated calls do nothing, except that
        ``at_once`` may follow an ordinary call.
        """
        if at_once and not self._at_once:
            self._at_once = True
            for axis in self.axes:
                self._order(axis, CommandKind.QUICK_STOP)
        if self._ending:
            return
        self._ending = True
        self._ending_turns_left = round(ENDING_TIMEOUT_S / self.cycle.period_s)
        self._report(_ALL, EventKind.ENDING)
        for axis in self.axes:
            # The service can no longer stop a lent axis; the loop's quick stop overrides its SDO transfers.
            lent = axis.state is AxisState.LENT
            self._order(axis, CommandKind.QUICK_STOP if lent else CommandKind.DISABLE)

    def _order(self, axis: AxisLoop, kind: CommandKind) -> None:
        if axis.state not in _AT_REST:
            axis.command(Command(0, kind, axis.index))

    def _continue_ending(self) -> None:
        self._ending_turns_left -= 1
        moving = False
        for axis in self.axes:
            if axis.state in _AT_REST:
                continue
            power = axis.image.power
            if axis.state is AxisState.QUICK_STOPPED and axis.stop_reported:
                if power.state in _OFF:
                    continue
                if axis.index not in self._released:
                    # Only RESET leads from the latch to power off, and nobody is left to send it.
                    self._released.add(axis.index)
                    self._order(axis, CommandKind.RESET)
            moving = True
        self.ended = not moving or self._ending_turns_left <= 0
