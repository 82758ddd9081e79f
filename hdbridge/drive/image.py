"""The process image: what goes over the bus in every cycle, and what its numbers mean for the axis. Pure.

Which PDO carries what is written here once; the boot-up maps the drive accordingly and the cycle packs and
unpacks with it.

    TPDO1 180h+id  statusword, position, torque        8 bytes
    TPDO2 280h+id  load encoder, position demand       8 bytes (4 when the load encoder is a node of its own)
    TPDO1 180h+id2 load encoder of another node        as long as its object
    TPDO3 380h+id  load torque, temperature            as long as its objects; where the axis has them
    TPDO4 480h+id  temperature                         where it comes less often than the load torque
    RPDO1 200h+id  controlword, target position        6 bytes
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from hdbridge.drive import objects
from hdbridge.drive.channels import ChannelFollower
from hdbridge.drive.objects import IntegerType
from hdbridge.drive.pdo import PdoCodec, PdoEntry
from hdbridge.drive.states import Command, PowerWalk
from hdbridge.drive.supervision import Fault
from hdbridge.drive.unwrap import Unwrap, wrap_int32
from hdbridge.errors import InputError
from hdbridge.units import ARCSEC_PER_DEG

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig

HALT_BIT: Final = 0x0100
HEARTBEATS_PER_TIMEOUT: Final = 2
"""The master sends this many heartbeats in the time in which the drive expects one, and grants as many."""


class Layout(NamedTuple):
    """One PDO of the image: whose it is, its number (1..), its identifier and what is mapped."""

    node_id: int
    number: int
    can_id: int
    codec: PdoCodec
    every: int = 1
    """It goes with every so many SYNCs."""


def tpdo_layouts(axis: AxisConfig) -> tuple[Layout, ...]:
    """The PDOs that each cycle needs."""
    drive_id = axis.drive.node_id
    source = axis.load_encoder.source
    load = PdoEntry(source.index, source.subindex, IntegerType.named(source.type))
    demand = PdoEntry.of(objects.POSITION_DEMAND)
    actual = PdoCodec(map(PdoEntry.of, (objects.STATUSWORD, objects.POSITION_ACTUAL, objects.TORQUE_ACTUAL)))
    first = Layout(drive_id, 1, objects.COB_TPDO1 + drive_id, actual)
    second_id = objects.COB_TPDO2 + drive_id
    if source.node is None or source.node == drive_id:
        return first, Layout(drive_id, 2, second_id, PdoCodec((load, demand)))
    return (
        first,
        Layout(drive_id, 2, second_id, PdoCodec((demand,))),
        Layout(source.node, 1, objects.COB_TPDO1 + source.node, PdoCodec((load,))),
    )


def channel_layouts(axis: AxisConfig) -> tuple[Layout, ...]:
    """The PDOs of the optional channels: one for all that come equally often."""
    together: dict[int, list[PdoEntry]] = {}
    for channel in axis.channels.values():
        source = channel.source
        entry = PdoEntry(source.index, source.subindex, IntegerType.named(source.type))
        together.setdefault(channel.every_cycles, []).append(entry)
    drive_id = axis.drive.node_id
    return tuple(
        Layout(drive_id, number, base + drive_id, PdoCodec(entries), every)
        for (every, entries), (number, base) in zip(
            together.items(), ((3, objects.COB_TPDO3), (4, objects.COB_TPDO4)), strict=False
        )
    )


def rpdo_layout(axis: AxisConfig) -> Layout:
    """The PDO that the master sends."""
    codec = PdoCodec(map(PdoEntry.of, (objects.CONTROLWORD, objects.TARGET_POSITION)))
    return Layout(axis.drive.node_id, 1, objects.COB_RPDO1 + axis.drive.node_id, codec)


def position_limits_counts(axis: AxisConfig) -> tuple[int, int]:
    """Least and greatest target of the drive, motor counts, in this order whatever the direction.

    The limits of the axis file hold for the place that is aimed at. The compensation may add its own
    maximum on top of that, so the drive's limits are wider by it. An `AxisConfig` makes sure that both fit
    the 32 bits of a target.
    """
    margin_deg = axis.compensation.maximum_arcsec / ARCSEC_PER_DEG
    ends = [
        axis.motor_encoder.counts(load_deg * axis.gear.ratio)
        for load_deg in (axis.limits.position_min_deg - margin_deg, axis.limits.position_max_deg + margin_deg)
    ]
    return math.ceil(min(ends)), math.floor(max(ends))


class ProcessImage:
    """The newest values from the drive, the next ones to it, and the scaling between counts and degrees.

    `accept` takes the frames of a cycle, `pack_rpdo` gives the frame to send; the power states are walked by
    ``power`` (aim with ``power.go``). Positions are unwrapped multi-turn Python integers.
    """

    def __init__(self, axis: AxisConfig) -> None:
        self.axis = axis
        self.node_id: int = axis.drive.node_id
        self.tpdos = tpdo_layouts(axis)
        self.channel_tpdos = channel_layouts(axis)
        rpdo = rpdo_layout(axis)
        self.rpdo_id, self.rpdo = rpdo.can_id, rpdo.codec
        self.sync_id: int = objects.COB_SYNC
        self.heartbeat_id: int = objects.COB_HEARTBEAT + axis.drive.master_node_id
        """Identifier of the master's own heartbeat; its data is one byte 05h."""
        self.heartbeat_period_s: float = axis.drive.heartbeat_ms / 1000.0 / HEARTBEATS_PER_TIMEOUT
        """How often the master has to send its heartbeat."""
        self.heartbeat_timeout_s: float = axis.drive.heartbeat_ms / 1000.0 * HEARTBEATS_PER_TIMEOUT
        """How old the drive's heartbeat may become."""
        self.limits_counts = position_limits_counts(axis)
        self.power = PowerWalk()
        self.halt = False
        """Sets the halt bit of the controlword."""

        self._motor, self._load = axis.motor_encoder.scale, axis.load_encoder.scale
        source = axis.load_encoder.source
        self._load_key = (source.index, source.subindex)
        self._handlers: dict[int, Callable[[bytes], None]] = {
            layout.can_id: self._handler(place, layout.codec) for place, layout in enumerate(self.tpdos)
        }
        self.tpdo_ids: tuple[int, ...] = tuple(self._handlers)
        """Identifiers of the frames that each cycle needs."""
        self.channels = tuple(
            ChannelFollower(key, channel, axis.drive.cycle_ms) for key, channel in axis.channels.items()
        )
        """What the axis has in addition to its encoders; empty for most."""
        followers = {
            (channel.source.index, channel.source.subindex): follower
            for channel, follower in zip(axis.channels.values(), self.channels, strict=True)
        }
        self._carried = {
            layout.can_id: [followers[entry.index, entry.sub] for entry in layout.codec.entries]
            for layout in self.channel_tpdos
        }
        for layout in self.channel_tpdos:
            self._handlers[layout.can_id] = partial(self._accept_channels, layout)
        self.readings: tuple[float | None, ...] = (None,) * len(self.channels)
        """Of each of ``channels`` the last reading that was believed; None where none is known (any more)."""
        self._unwrap_motor = Unwrap()
        self._unwrap_demand = Unwrap()
        self._unwrap_load = Unwrap(source.wraps_at_counts)
        self.statusword: int | None = None
        """Newest statusword; None before the first."""
        self.motor_counts = 0
        self.load_counts = 0
        self.demand_counts = 0
        self.torque_permille = 0
        self.target_counts = 0
        """Last target that was packed."""

    def _handler(self, place: int, codec: PdoCodec) -> Callable[[bytes], None]:
        """What to do with the data of a TPDO that each cycle needs."""
        if place == 0:
            return partial(self._accept_state, codec.unpack)
        load = codec.positions.get(self._load_key)
        demand = codec.positions.get((objects.POSITION_DEMAND.index, objects.POSITION_DEMAND.sub))
        return partial(self._accept_positions, codec.unpack, load, demand)

    def accept(self, can_id: int, data: bytes) -> bool:
        """Take a TPDO; whether it was one of the image's. `PdoLengthError` when its length is wrong.

        Of several frames of one identifier the newest wins. A frame that is rejected leaves all as it was.
        """
        handler = self._handlers.get(can_id)
        if handler is None:
            return False
        handler(data)
        return True

    def handler(self, can_id: int) -> Callable[[bytes], None]:
        """What takes the data of one of the image's TPDOs: `accept` for one that looks it up only once."""
        return self._handlers[can_id]

    def length_of(self, can_id: int) -> int:
        """Bytes that a TPDO of the image has to have."""
        layouts = (*self.tpdos, *self.channel_tpdos)
        return next(each.codec.length for each in layouts if each.can_id == can_id)

    def _accept_state(self, unpack: Callable[[bytes], tuple[int, ...]], data: bytes) -> None:
        self.statusword, motor, self.torque_permille = unpack(data)
        self.power.observe(self.statusword)
        self.motor_counts = self._unwrap_motor.update(motor)

    def _accept_positions(
        self,
        unpack: Callable[[bytes], tuple[int, ...]],
        load: int | None,
        demand: int | None,
        data: bytes,
    ) -> None:
        values = unpack(data)
        if load is not None:
            self.load_counts = self._unwrap_load.update(values[load])
        if demand is not None:
            self.demand_counts = self._unwrap_demand.update(values[demand])

    def _accept_channels(self, layout: Layout, data: bytes) -> None:
        for follower, counts in zip(self._carried[layout.can_id], layout.codec.unpack(data), strict=True):
            follower.accept(counts)

    def awaited_channels(self) -> list[int]:
        """Identifiers of the optional channels' TPDOs that come with every SYNC, as long as they do."""
        return [
            layout.can_id
            for layout in self.channel_tpdos
            if layout.every == 1 and not all(each.lost for each in self._carried[layout.can_id])
        ]

    def step_channels(self) -> list[tuple[Fault, str]]:
        """One cycle is over for the channels: their values as of now, and what is wrong with them."""
        faults = []
        for follower in self.channels:
            fault = follower.step()
            if fault is not None:
                faults.append(fault)
        self.readings = tuple([follower.value for follower in self.channels])
        return faults

    def forget_channels(self) -> None:
        """Nothing is known of the channels: the cycle begins, or has rested."""
        for follower in self.channels:
            follower.reset()
        self.readings = (None,) * len(self.channels)

    def check_target(self, counts: int) -> None:
        """`InputError` unless ``counts`` is an integer within the position limits."""
        least, greatest = self.limits_counts
        if not isinstance(counts, int) or not least <= counts <= greatest:
            raise InputError(
                f"target of {counts!r} motor counts is not an integer within {least} .. {greatest} "
                f"(limits.position_min_deg {self.axis.limits.position_min_deg}, position_max_deg "
                f"{self.axis.limits.position_max_deg} deg at the load); the target was not sent"
            )

    def pack_rpdo(self, target_counts: int) -> bytes:
        """Data of the RPDO: the controlword of ``power`` and the target, checked against the limits.

        `InputError`, and nothing to send, when the target is outside them. Before power is enabled use
        `pack_rpdo_idle`: the axis may stand anywhere then.
        """
        self.check_target(target_counts)
        return self._pack(target_counts)

    def pack_rpdo_idle(self) -> bytes:
        """Data of the RPDO with the actual position as target: for every cycle before power is enabled."""
        return self._pack(wrap_int32(self.motor_counts))

    def pack_rpdo_stop(self) -> bytes:
        """Data of the RPDO with *quick stop* and the actual position, whatever ``power`` aims at.

        It enables no drive in any state, and replaces an RPDO that a drive has buffered.
        """
        return self.rpdo.pack((Command.QUICK_STOP.word, wrap_int32(self.motor_counts)))

    def statusword_in(self, can_id: int, data: bytes) -> int | None:
        """Statusword that a TPDO carries, or None. Takes nothing over into the image."""
        if can_id != self.tpdo_ids[0] or len(data) != self.tpdos[0].codec.length:
            return None
        return self.tpdos[0].codec.unpack(data)[0]

    def _pack(self, target_counts: int) -> bytes:
        word = self.power.controlword()
        if self.halt:
            word |= HALT_BIT
        data = self.rpdo.pack((word, target_counts))
        self.target_counts = target_counts
        return data

    def seed(self, motor_counts: int, load_counts: int, statusword: int) -> None:
        """Start the multi-turn counts from readings over SDO, so that the cycle goes on from there."""
        self._unwrap_motor.reset(motor_counts)
        self._unwrap_load.reset(load_counts)
        self._unwrap_demand.reset(motor_counts)
        self.motor_counts = self.demand_counts = self.target_counts = motor_counts
        self.load_counts = load_counts
        self.statusword = statusword
        self.power.observe(statusword)

    def motor_deg(self, counts: float) -> float:
        """Motor angle of motor counts, degrees of the motor, with the encoder's direction."""
        return self._motor.degrees(counts)

    def load_deg(self, counts: float) -> float:
        """Load angle of load counts, degrees of the load, with the encoder's direction."""
        return self._load.degrees(counts)

    def target_counts_for(self, motor_deg: float) -> int:
        """Nearest motor counts of a motor angle; `InputError` when it is not finite or outside the limits."""
        if not math.isfinite(motor_deg):
            raise InputError(f"target of {motor_deg!r} deg is not a finite angle; the target was not sent")
        counts = round(self._motor.counts(motor_deg))
        self.check_target(counts)
        return counts
