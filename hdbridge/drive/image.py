"""The process image: what goes over the bus in every cycle, and what its numbers mean for the axis. Pure.

Which PDO carries what is written here once; the boot-up maps the drive accordingly and the cycle packs and
unpacks with it.

    TPDO1 180h+id  statusword, position, torque        8 bytes
    TPDO2 280h+id  load encoder, position demand       8 bytes (4 when the load encoder is a node of its own)
    TPDO1 180h+id2 load encoder of another node        as long as its object
    RPDO1 200h+id  controlword, target position        6 bytes
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from hdbridge.drive import objects
from hdbridge.drive.objects import IntegerType
from hdbridge.drive.pdo import PdoCodec, PdoEntry
from hdbridge.drive.states import PowerWalk
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


def tpdo_layouts(axis: AxisConfig) -> tuple[Layout, ...]:
    """The PDOs that the master receives."""
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

        self._slots: dict[int, tuple[int, PdoCodec]] = {
            layout.can_id: (place, layout.codec) for place, layout in enumerate(self.tpdos)
        }
        self.tpdo_ids: tuple[int, ...] = tuple(self._slots)
        """Identifiers of the frames that belong to one cycle."""
        source = axis.load_encoder.source
        self._load = self._place((source.index, source.subindex))
        self._demand = self._place((0x6062, 0))
        self._values: list[tuple[int, ...]] = [(0,) * len(slot[1].entries) for slot in self._slots.values()]
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

    def _place(self, key: tuple[int, int]) -> tuple[int, int]:
        for place, (_, codec) in enumerate(self._slots.values()):
            if key in codec.positions:
                return place, codec.positions[key]
        raise InputError(f"object {key[0]:04X}h:{key[1]:02X} is in no PDO")

    def accept(self, can_id: int, data: bytes) -> bool:
        """Take a TPDO; whether it was one of the image's. `PdoLengthError` when its length is wrong.

        Of several frames of one identifier the newest wins. A frame that is rejected leaves all as it was.
        """
        slot = self._slots.get(can_id)
        if slot is None:
            return False
        place, codec = slot
        values = codec.unpack(data)
        self._values[place] = values
        if place == 0:
            statusword, motor, torque = values
            self.statusword = statusword
            self.power.observe(statusword)
            self.motor_counts = self._unwrap_motor.update(motor)
            self.torque_permille = torque
        if place == self._load[0]:
            self.load_counts = self._unwrap_load.update(values[self._load[1]])
        if place == self._demand[0]:
            self.demand_counts = self._unwrap_demand.update(values[self._demand[1]])
        return True

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
        return self.axis.motor_encoder.degrees(counts)

    def load_deg(self, counts: float) -> float:
        """Load angle of load counts, degrees of the load, with the encoder's direction."""
        return self.axis.load_encoder.degrees(counts)

    def target_counts_for(self, motor_deg: float) -> int:
        """Nearest motor counts of a motor angle; `InputError` when it is not finite or outside the limits."""
        if not math.isfinite(motor_deg):
            raise InputError(f"target of {motor_deg!r} deg is not a finite angle; the target was not sent")
        counts = round(self.axis.motor_encoder.counts(motor_deg))
        self.check_target(counts)
        return counts
