"""Slaves of a gateway: CiA-402 drives on the outer bus that represent axes of the control loop.

A slave is a device of `hdbridge.device`. Its plant and power stage are an axis of the loop, accessed through
the shared memory. It writes set-points and requests power, which the service grants; it has no other access.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import can

from hdbridge.clock import Clock
from hdbridge.daemon.gateway.objects import BRIDGE, nameplate, write_eds
from hdbridge.daemon.loop.faultlog import fault_of
from hdbridge.daemon.loop.states import STOPPED as STOPPED_STATES
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import Cell, Memory, OuterCell, OuterKnot, OuterView, SampleArray, SampleFlag
from hdbridge.device.behaviour import Behaviour, Controlword
from hdbridge.device.emergency import ErrorCode
from hdbridge.device.modes import InterpolatedPosition
from hdbridge.device.node import FRAMES_PER_POLL, DriveNode
from hdbridge.device.powerstate import PowerStage
from hdbridge.drive.supervision import Fault
from hdbridge.motion import MotionMode
from hdbridge.units import ARCSEC_PER_DEG

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.daemon.machinefile import GatewaySettings

BEHAVIOUR: Final = Behaviour.model_validate(
    {
        "controlword": Controlword.LEVEL,
        "measures_period": True,
        "sync_timeout_periods": 3.0,
        "fixed_node_id": True,
    }
)
"""Behaviour of a slave: reads controlwords as levels, runs with any period of SYNC, and stops if SYNC is
lost.

Its node id is that of the machine file."""
DEAD_S: Final = 0.3
"""Time without a cycle after which the control loop counts as hung or dead."""
POWER_S: Final = 5.0
"""Time-out of the service and the inner drive for switching power on."""
VELOCITY_S: Final = 0.02
"""Averaging time of the actual velocity."""

IN_USE_BY_OTHER: Final = 0xFF01
"""Error code: another client of the daemon uses the axis."""
NOT_POWERED: Final = 0xFF02
"""Error code: the inner drive was not powered, or lost its power; the daemon's log has the reason."""
STOPPED: Final = 0xFF03
"""Error code: a quick stop by command, or a stop without its own code."""
INNER_BUS: Final = 0x7500
"""Error code of CiA 402: communication, additional module."""
ERROR_CODES: Final[Mapping[Fault, int]] = {
    Fault.HANG: 0x6010,
    Fault.OVERRUN: 0x6010,
    Fault.ENCODER_JUMP: 0x7305,
    Fault.FOLLOWING_ERROR: 0x8611,
    Fault.BAD_TARGET: 0x8612,
    Fault.DRIVE_FAULT: 0xFF00,
    Fault.DROPPED_OUT: 0x5440,
    **dict.fromkeys(
        (
            Fault.LOST_TPDO,
            Fault.WRONG_LENGTH,
            Fault.FLOOD,
            Fault.MASTER_LOST,
            Fault.BOOT_UP,
            Fault.NMT_CHANGE,
            Fault.HEARTBEAT_LOST,
            Fault.OWN_ID_ELSEWHERE,
            Fault.FOREIGN_SYNC,
            Fault.BUS_DOWN,
            Fault.TRANSMIT_FULL,
        ),
        INNER_BUS,
    ),
}
"""Error codes of CiA 402, or manufacturer-specific ones, for stops by the supervision of the loop."""


class LoadAxis(PowerStage):
    """Axis of the loop as plant (`hdbridge.device.motion.Machine`) and power stage of a slave."""

    dt_s = 1e-6
    temperature_c = load_torque_nm = 0.0

    def __init__(
        self, axis: AxisConfig, settings: GatewaySettings, memory: Memory, index: int, clock: Clock
    ) -> None:
        self.torque_limit_permille = 0.0
        self.node: DriveNode | None = None
        """Node whose periods time-stamp the set-points."""
        self._clock, self._index = clock, index
        self._status, self._knots, self._cells = memory.status, memory.followed[index], memory.outer[index]
        self._counts_per_deg = settings.counts_per_turn / 360.0
        self._motor_deg, self._ratio = axis.motor_encoder.degrees(1), axis.gear.ratio
        self._rated_nm = axis.drive.rated_torque_nm
        self.motor_counts = self.load_counts = 0
        self.velocity_counts_s = 0.0
        self.torque_permille = 0
        self.sample: SampleArray | None = None
        """Axis in the newest cycle; None before the first."""
        self._measured = (-math.inf, 0.0)
        self._series = max(self._cells[OuterCell.REQUESTED], self._cells[OuterCell.GRANTED]) + 1
        """Number of the next series of set-points; no process uses a number twice, even after a restart."""
        self._requested = 0
        self._requested_s = 0.0
        self._begun = False
        self._resets = self._cells[OuterCell.RESETS_DONE]
        self._cells[OuterCell.REQUESTED] = 0
        self._cells[OuterCell.RESETS] = self._resets

    # ---------------------------------------------------------------- the newest cycle

    def update(self, newest: SampleArray | None, now_s: float, alive: bool) -> None:
        """Takes the newest cycle, shape (1,), and checks for errors; ``newest`` is None without a new one."""
        if newest is not None:
            self._take(newest)
        sample = self.sample
        if sample is None:
            return
        granted = self._requested != 0 and self._cells[OuterCell.GRANTED] == self._requested
        follows = sample["state"] == AxisState.ENABLED and sample["mode"] == MotionMode.FOLLOW
        was_on, self.is_on = self.is_on, granted and bool(follows)
        if self.is_resetting and self._cells[OuterCell.RESETS_DONE] == self._resets:
            self.is_resetting, self.error_code = False, 0
        if self.error_code == 0:
            self.error_code = self._judge(sample, was_on, now_s, alive)
            self.error_details = bytes((int(sample["state"]), int(sample["fault"])))

    def _take(self, newest: SampleArray) -> None:
        self.sample = sample = newest[0]["axes"][self._index]
        motor_deg, time_s = float(sample["motor_position_deg"]), 1e-9 * int(newest[0]["time_ns"])
        self.motor_counts = round(self._load_deg(sample) * self._counts_per_deg)
        self.load_counts = round(motor_deg / self._motor_deg)
        self.torque_permille = round(1000.0 * float(sample["motor_torque_nm"]) / self._rated_nm)
        since_s, before_deg = self._measured
        if time_s - since_s >= VELOCITY_S:
            moved = motor_deg - before_deg
            if abs(moved) <= 1.5 * abs(self._motor_deg) or not math.isfinite(since_s):
                moved = 0.0  # chatter of one count at rest
            self.velocity_counts_s = moved / self._ratio / (time_s - since_s) * self._counts_per_deg
            self._measured = (time_s, motor_deg)

    def _judge(self, sample: SampleArray, was_on: bool, now_s: float, alive: bool) -> int:
        """Returns the error code of a condition that prevents operation, or 0."""
        if not alive:
            return ERROR_CODES[Fault.HANG] if self._requested else 0
        if sample["state"] in STOPPED_STATES:
            fault = fault_of(int(sample["fault"]))
            return STOPPED if fault is None else ERROR_CODES.get(fault, STOPPED)
        if not self._requested:
            return 0
        if self._cells[OuterCell.REFUSED] == self._requested:
            return NOT_POWERED if self._cells[OuterCell.HELD] else IN_USE_BY_OTHER
        if was_on and not self.is_on:
            if sample["state"] == AxisState.ENABLED:
                return IN_USE_BY_OTHER
            # If this process was scheduled with a delay, the set-points end before SYNC is overdue.
            node = self.node
            outer = node is not None and node.firmware.follows_the_bus and node.sync_is_late(now_s)
            return ErrorCode.SYNC_LOST if outer else NOT_POWERED
        if not self.is_on and now_s - self._requested_s > POWER_S:
            return NOT_POWERED
        return 0

    # ---------------------------------------------------------------- the power stage

    def switch(self, on: bool) -> None:
        if not on and self._requested:
            now_s = self._clock.now()
            self._knots.add(OuterKnot(self._requested, now_s, math.nan, now_s))
        self.is_on = self._begun = False
        self._requested = self._series if on else 0
        self._series += on
        self._requested_s = self._clock.now()
        self._cells[OuterCell.REQUESTED] = self._requested

    def reset(self) -> None:
        self._resets += 1
        self.is_resetting = True
        self._cells[OuterCell.RESETS] = self._resets

    def publish(self, node: DriveNode) -> None:
        """Publishes the node as the outer master sees it, and its requests, to the other processes."""
        cells, value, motion = self._cells, node.dictionary.value, node.firmware.motion
        cells[OuterCell.NODE_ID] = node.node_id
        mode = value(0x6061)
        target = value(0x60C1, 1) if mode == InterpolatedPosition.number else value(0x607A)
        target_deg = motion.unlimited(target) / self._counts_per_deg
        words = value(0x6040), node.firmware.statusword(), value(0x603F)
        cells.show(OuterView(target_deg, *words, int(node.nmt), mode))
        cells[OuterCell.PERIOD_NS] = round(1e9 * node.period_s) if node.has_sync else 0
        cells[OuterCell.JITTER_NS] = round(1e9 * node.jitter_s)

    # ---------------------------------------------------------------- the plant

    def follow(self, start_counts: float, end_counts: float, substeps: int) -> None:
        """Writes a set-point: linear motion from start to end over this period."""
        assert self.node is not None
        begins_s = self.node.period_begins_s
        if not self._begun:
            self._begun = True
            self._put(begins_s, start_counts)
        self._put(begins_s + substeps * self.dt_s, end_counts)

    def _put(self, time_s: float, counts: float) -> None:
        assert self.node is not None
        received_s = self.node.now_s
        self._knots.add(OuterKnot(self._requested, time_s, counts / self._counts_per_deg, received_s))

    def coast(self, substeps: int, braked: bool) -> None:
        """Writes nothing, because there are no set-points without power."""

    # ---------------------------------------------------------------- the bridge's own objects

    def values(self) -> tuple[Callable[[], int], ...]:
        """Returns the readers of the sub-indices of `BRIDGE`, from 1."""

        def arcsec(field: str) -> Callable[[], int]:
            return lambda: 0 if self.sample is None else round(100.0 * float(self.sample[field]))

        return (
            self._error,
            arcsec("predicted_arcsec"),
            arcsec("correction_arcsec"),
            arcsec("loop_arcsec"),
            self._compensation,
            lambda: 0 if self.sample is None else int(self.sample["state"]),
        )

    def _load_deg(self, sample: SampleArray) -> float:
        """Returns the load angle, degrees; without a load encoder, that from motor encoder and model."""
        load_deg = float(sample["load_position_deg"])
        if math.isnan(load_deg):
            predicted_deg = float(sample["predicted_arcsec"]) / ARCSEC_PER_DEG
            return float(sample["motor_position_deg"]) / self._ratio + predicted_deg
        return load_deg

    def _error(self) -> int:
        sample = self.sample
        if sample is None:
            return 0
        error_deg = self._load_deg(sample) - float(sample["load_target_deg"])
        return round(100.0 * ARCSEC_PER_DEG * error_deg)

    def _compensation(self) -> int:
        flags = 0 if self.sample is None else int(self.sample["flags"])
        bits = (
            SampleFlag.COMPENSATING,
            SampleFlag.LIMITED,
            SampleFlag.MEMORY_KNOWN,
            SampleFlag.CHANGING,
            SampleFlag.LOOP_DOUBTED,
        )
        return sum(1 << place for place, flag in enumerate(bits) if flags & flag)


class Gateway:
    """All slaves of a machine on one outer bus; served as one node (`hdbridge.device.run.Served`)."""

    def __init__(
        self,
        bus: can.BusABC,
        axes: Sequence[tuple[AxisConfig, TransmissionModel]],
        settings: GatewaySettings,
        memory: Memory,
        clock: Clock,
        folder: Path,
        store_of: Callable[[AxisConfig], Path | None] = lambda _: None,
    ) -> None:
        """``folder`` receives the EDS of each axis, ``store_of`` returns the file of its stored parameters.

        ``clock`` is that of the loop.
        """
        self._bus, self._memory, self._clock = bus, memory, clock
        self._reader = memory.reader()
        self._turns, self._turned_s = -1, clock.now()
        self._updated_s = -math.inf
        self.axes: dict[str, LoadAxis] = {}
        self.nodes: dict[str, DriveNode] = {}
        for index, (axis, model) in enumerate(axes):
            node_id = settings.nodes.get(axis.name)
            if node_id is None:
                continue
            load = LoadAxis(axis, settings, memory, index, clock)
            node = DriveNode(
                bus,
                load,
                write_eds(folder, axis, settings, model),
                node_id,
                clock,
                nameplate(axis, settings),
                BEHAVIOUR,
                load,
                store_of(axis),
                settings.bus.bitrate_bps,
            )
            load.node = node
            for sub, read in enumerate(load.values(), start=1):
                node.dictionary[BRIDGE, sub].bind(read)
            self.axes[axis.name], self.nodes[axis.name] = load, node

    def handle(self, message: can.Message, now_s: float) -> None:
        self._update_axes(now_s)
        for node in self.nodes.values():
            node.handle(message, now_s)

    def poll(self, now_s: float) -> None:
        """Handles the received frames, and runs everything due until ``now_s``."""
        self.run_until(now_s)
        for _ in range(FRAMES_PER_POLL):
            message = self._bus.recv(0)
            if message is None:
                break
            now_s = self._clock.now()
            for node in self.nodes.values():
                node.handle(message, now_s)
        self.run_until(now_s)

    def run_until(self, now_s: float) -> None:
        """Runs everything due until ``now_s`` without reading the bus."""
        self._update_axes(now_s)
        for name, node in self.nodes.items():
            node.run_until(now_s)
            self.axes[name].publish(node)

    def next_event_s(self) -> float:
        """Returns the latest time of the next poll."""
        return min(node.next_event_s() for node in self.nodes.values())

    def bus_failed(self) -> None:
        """Handles a failure of the outer interface: each axis stops as selected by its 6007h."""
        for node in self.nodes.values():
            node.bus_failed()

    def _update_axes(self, now_s: float) -> None:
        """Updates the axes, at most twice per period of the loop."""
        if now_s - self._updated_s < 0.5 * self._memory.period_s:
            return
        self._updated_s = now_s
        status = self._memory.status
        turns = status[Cell.LOOP_COUNT]
        if turns != self._turns:
            self._turns, self._turned_s = turns, now_s
        samples, _ = self._reader.read()
        newest = samples[-1:] if len(samples) else None
        alive = status[Cell.LOOP_PID] != 0 and now_s - self._turned_s < DEAD_S
        for load in self.axes.values():
            load.update(newest, now_s, alive)
