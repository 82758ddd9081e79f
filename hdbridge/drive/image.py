"""Process image: the data exchanged over the bus in every cycle, and its scaling to axis units. Pure.

`hdbridge.drive.layout` defines the contents of each PDO. The boot-up maps the drive accordingly, and the
cycle packs and unpacks with it.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from canopen.objectdictionary import ObjectDictionary

from hdbridge.axis import AxisConfig
from hdbridge.cia301 import INT32_RANGE, wrap_int32
from hdbridge.drive import objects
from hdbridge.drive.channels import ChannelFollower
from hdbridge.drive.dictionary import dictionary_of, find, held
from hdbridge.drive.layout import Layout, Layouts, cyclic_mode, layouts
from hdbridge.drive.objects import Address
from hdbridge.drive.pdo import PdoEntry
from hdbridge.drive.states import Command, PowerWalk, State
from hdbridge.drive.supervision import Fault
from hdbridge.drive.unwrap import Unwrap
from hdbridge.errors import InputError
from hdbridge.units import ARCSEC_PER_DEG

Frames = tuple[tuple[int, bytes], ...]
"""Frames to send: identifier and data of each."""
# The control cycle uses module names because looking up an enum member in its class takes five times as long.
_ENABLED: Final = State.OPERATION_ENABLED
_ENABLE_OPERATION: Final = Command.ENABLE_OPERATION.word
HALT_BIT: Final = 0x0100
HEARTBEATS_PER_TIMEOUT: Final = 2
"""Number of heartbeats that the master sends within the drive's time-out; also the master's time-out for the
drive, in periods of the drive's heartbeat."""


def drive_heartbeat_ms(axis: AxisConfig, od: ObjectDictionary | None = None) -> int:
    """Returns the period of the drive's heartbeat, ms; 0 if its EDS lacks 1017h."""
    od = dictionary_of(axis) if od is None else od
    address = objects.HEARTBEAT_PRODUCER
    return axis.drive.heartbeat_ms if find(od, address.index, address.sub) is not None else 0


def position_limits_counts(axis: AxisConfig) -> tuple[int, int]:
    """Returns the minimum and maximum target in motor counts, in ascending order whatever the direction.

    The limits of the axis file apply to the commanded position. The compensation may add up to its own
    maximum, so the drive's limits are wider by that amount. `AxisConfig` ensures that both fit the 32 bits of
    a target.
    """
    margin_deg = axis.compensation.maximum_arcsec / ARCSEC_PER_DEG
    ends = [
        axis.motor_encoder.counts(load_deg * axis.gear.ratio)
        for load_deg in (axis.limits.position_min_deg - margin_deg, axis.limits.position_max_deg + margin_deg)
    ]
    return math.ceil(min(ends)), math.floor(max(ends))


class ProcessImage:
    """Newest values from the drive, next values to it, and the scaling between counts and degrees.

    `accept` takes the frames of a cycle and `pack_rpdo` returns the frames to send. ``power`` walks the power
    states (aim with ``power.go``). Positions are unwrapped multi-turn Python integers. ``od`` is by default
    the dictionary of the axis's EDS, ``pdos`` the mapping that the boot-up writes.
    """

    def __init__(
        self, axis: AxisConfig, od: ObjectDictionary | None = None, pdos: Layouts | None = None
    ) -> None:
        od = dictionary_of(axis) if od is None else od
        self.axis = axis
        self.node_id: int = axis.drive.node_id
        self.cyclic = cyclic_mode(axis)
        self._enabling = self.cyclic.enabling
        self.tpdos, self.channel_tpdos, self.rpdos, absent = pdos or layouts(axis, od)
        self.heartbeat_id: int = objects.COB_HEARTBEAT + axis.drive.master_node_id
        """Identifier of the master's own heartbeat; its data is one byte 05h."""
        self.heartbeat_period_s: float = axis.drive.heartbeat_ms / 1000.0 / HEARTBEATS_PER_TIMEOUT
        """Period of the master's heartbeat; s."""
        beat_ms = drive_heartbeat_ms(axis, od)
        self.heartbeat_timeout_s: float = beat_ms / 1000.0 * HEARTBEATS_PER_TIMEOUT if beat_ms else math.inf
        """Maximum age of the drive's heartbeat, s; infinite if the drive sends none."""
        self.limits_counts = position_limits_counts(axis)
        self.power = PowerWalk()
        self.halt = False
        """True sets the halt bit of the controlword."""

        self._motor = axis.motor_encoder.scale
        self.motor_deg: Callable[[float], float] = self._motor.degrees
        """Converts motor counts to the motor angle in degrees, with the encoder's direction."""
        self.load_deg: Callable[[float], float] = axis.load_encoder.scale.degrees
        """Converts load counts to the load angle in degrees, with the encoder's direction."""
        self.channels = tuple(
            ChannelFollower(key, channel, axis.drive.cycle_ms) for key, channel in axis.channels.items()
        )
        """Optional channels of the axis, in addition to its encoders; usually empty."""
        self._followers = {
            (channel.source.index, channel.source.subindex): follower
            for channel, follower in zip(axis.channels.values(), self.channels, strict=True)
        }
        self.readings: tuple[float | None, ...] = (None,) * len(self.channels)
        """Last good reading of each of ``channels``; None before the first reading and for a lost channel."""
        position = self._entry_of(objects.POSITION_ACTUAL)
        demand = self._entry_of(objects.POSITION_DEMAND)
        self._unwrap_motor = Unwrap(1 << position.type.bits if position else INT32_RANGE)
        self._unwrap_demand = Unwrap(1 << demand.type.bits if demand else INT32_RANGE)
        self._unwrap_load = Unwrap(axis.load_encoder.source.wraps_at_counts)
        self.has_demand = objects.POSITION_DEMAND not in absent
        """True if the drive sends its position demand."""
        self._handlers = self._handlers_of((*self.tpdos, *self.channel_tpdos))
        self.tpdo_ids: tuple[int, ...] = tuple(layout.can_id for layout in self.tpdos)
        """Identifiers of the frames that each cycle waits for."""
        self._packers = tuple(self._packer(layout, od) for layout in self.rpdos)
        self.statusword: int | None = None
        """Newest statusword; None before the first one."""
        self.motor_counts = 0
        self.load_counts = 0
        self.demand_counts = 0
        """Position demand. For a drive that does not send it, the target before the last, which has been
        reached."""
        self.torque_permille: float = math.nan if objects.TORQUE_ACTUAL in absent else 0
        """Torque in per mille of the rated torque; NaN if the drive does not send it."""
        self.target_counts = 0
        """Last packed target, motor counts."""
        self._under_way = 0

    # -- received frames ----------------------------------------------------------------------------------

    def _entry_of(self, address: Address) -> PdoEntry | None:
        entries = (entry for layout in self.tpdos for entry in layout.codec.entries)
        return next(
            (each for each in entries if (each.index, each.sub) == (address.index, address.sub)), None
        )

    def _handlers_of(self, tpdos: Iterable[Layout]) -> dict[int, Callable[[bytes], None]]:
        """Returns the handler of each TPDO's data. An object in several TPDOs is read from the first."""
        source = self.axis.load_encoder.source
        takers: dict[tuple[int, int, int], Callable[[int], None]] = {
            (self.node_id, address.index, address.sub): take
            for address, take in (
                (objects.STATUSWORD, self._take_statusword),
                (objects.POSITION_ACTUAL, self._take_position),
                (objects.TORQUE_ACTUAL, self._take_torque),
                (objects.POSITION_DEMAND, self._take_demand),
            )
        }
        takers |= {(self.node_id, *key): each.accept for key, each in self._followers.items()}
        takers[source.node or self.node_id, source.index, source.subindex] = (
            self._take_only_encoder if self.axis.load_encoder.is_motor_encoder else self._take_load
        )
        handlers = {}
        for layout in tpdos:
            taken = []
            for place, entry in enumerate(layout.codec.entries):
                take = takers.pop((layout.node_id, entry.index, entry.sub), None)
                if take is not None:
                    taken.append((place, take))
            handlers[layout.can_id] = _handler(layout.codec.unpack, taken)
        return handlers

    def accept(self, can_id: int, data: bytes) -> bool:
        """Takes a frame; returns True if it is one of the image's TPDOs.

        Raises `PdoLengthError` if its length is wrong. If several frames have the same identifier, the newest
        takes effect. A rejected frame changes nothing.
        """
        handler = self._handlers.get(can_id)
        if handler is None:
            return False
        handler(data)
        return True

    def handler(self, can_id: int) -> Callable[[bytes], None]:
        """Returns the handler of one of the image's TPDOs, for repeated use in place of `accept`."""
        return self._handlers[can_id]

    def length_of(self, can_id: int) -> int:
        """Returns the required length of one of the image's TPDOs; bytes."""
        layouts = (*self.tpdos, *self.channel_tpdos)
        return next(each.codec.length for each in layouts if each.can_id == can_id)

    def statusword_in(self, can_id: int, data: bytes) -> int | None:
        """Returns the statusword in a TPDO, or None, without changing the image."""
        for layout in self.tpdos:
            place = layout.codec.positions.get((objects.STATUSWORD.index, objects.STATUSWORD.sub))
            if layout.can_id == can_id and place is not None and len(data) == layout.codec.length:
                return layout.codec.unpack(data)[place]
        return None

    def _take_statusword(self, word: int) -> None:
        self.statusword = word
        self.power.observe(word)

    def _take_position(self, counts: int) -> None:
        motor_counts = self.motor_counts = self._unwrap_motor.update(counts)
        if not self.has_demand and self.power.state is not _ENABLED:
            self.demand_counts = motor_counts

    def _take_torque(self, permille: int) -> None:
        self.torque_permille = permille

    def _take_only_encoder(self, counts: int) -> None:
        self._take_position(counts)
        self._take_load(counts)

    def _take_load(self, counts: int) -> None:
        self.load_counts = self._unwrap_load.update(counts)

    def _take_demand(self, counts: int) -> None:
        self.demand_counts = self._unwrap_demand.update(counts)

    def awaited_channels(self) -> list[int]:
        """Returns the identifiers of the channel TPDOs that come with every SYNC and are not lost."""
        return [
            layout.can_id
            for layout in self.channel_tpdos
            if layout.every == 1
            and any(not each.lost for key, each in self._followers.items() if key in layout.codec.positions)
        ]

    def step_channels(self) -> list[tuple[Fault, str]]:
        """Ends a cycle for the channels: updates ``readings`` and returns the channels' faults."""
        faults = []
        for follower in self.channels:
            fault = follower.step()
            if fault is not None:
                faults.append(fault)
        self.readings = tuple([follower.value for follower in self.channels])
        return faults

    def forget_channels(self) -> None:
        """Discards all readings, at the start of the cycle and after a pause."""
        for follower in self.channels:
            follower.reset()
        self.readings = (None,) * len(self.channels)

    # -- sent frames --------------------------------------------------------------------------------------

    def _packer(self, layout: Layout, od: ObjectDictionary) -> Callable[[int, int], tuple[int, bytes]]:
        """Returns a function that builds an RPDO frame from those of controlword and target that it contains.

        A read-only mapping may contain other objects. The mode of operation then has the value for the cycle;
        all others have their value from the EDS, or 0 if the EDS states none.
        """
        entries, can_id, pack = layout.codec.entries, layout.can_id, layout.codec.pack
        values = [0 if entry.is_gap else _held(od, entry) for entry in entries]
        words, targets, modes = (
            [
                place
                for place, entry in enumerate(entries)
                if (entry.index, entry.sub) == (each.index, each.sub)
            ]
            for each in (objects.CONTROLWORD, self.cyclic.target, objects.MODE)
        )
        for place in modes:
            values[place] = self.cyclic.mode

        def frame(word: int, target_counts: int) -> tuple[int, bytes]:
            for place in words:
                values[place] = word
            for place in targets:
                values[place] = target_counts
            return can_id, pack(values)

        return frame

    def check_target(self, counts: int) -> None:
        """Raises `InputError` unless ``counts`` is an integer within the position limits."""
        least, greatest = self.limits_counts
        if not isinstance(counts, int) or not least <= counts <= greatest:
            raise InputError(
                f"target of {counts!r} motor counts is not an integer within {least} .. {greatest} "
                f"(limits.position_min_deg {self.axis.limits.position_min_deg}, position_max_deg "
                f"{self.axis.limits.position_max_deg} deg at the load); the target was not sent"
            )

    def pack_rpdo(self, target_counts: int) -> Frames:
        """Returns the RPDOs with the controlword of ``power`` and the target.

        Raises `InputError` if the target is outside the limits. Before power is enabled, `pack_rpdo_idle`
        must be used, because the axis may be outside the limits.
        """
        self.check_target(target_counts)
        return self._pack(target_counts)

    def pack_rpdo_idle(self, motor_counts: int) -> Frames:
        """Returns the RPDOs with this position as target, for every cycle before power is enabled."""
        return self._pack(wrap_int32(motor_counts))

    def pack_rpdo_held(self) -> Frames:
        """Returns the RPDOs with the last target repeated."""
        return self._pack(self.target_counts)

    def pack_rpdo_stop(self) -> Frames:
        """Returns the RPDOs with *quick stop* and the actual position, regardless of the aim of ``power``.

        They enable no drive in any state, and they replace any RPDO that a drive has buffered.
        """
        word, target_counts = Command.QUICK_STOP.word, wrap_int32(self.motor_counts)
        return tuple([frame(word, target_counts) for frame in self._packers])

    def _pack(self, target_counts: int) -> Frames:
        power = self.power
        word = power.controlword()
        if self._enabling and word == _ENABLE_OPERATION and power.state is _ENABLED:
            word |= self._enabling
        if self.halt:
            word |= HALT_BIT
        frames = tuple([frame(word, target_counts) for frame in self._packers])
        self.target_counts = target_counts
        self.follow_target(target_counts)
        return frames

    def follow_target(self, target_counts: int) -> None:
        """Records a sent target. Without a demand from the drive, the previous target becomes the demand."""
        if not self.has_demand:
            self.demand_counts = self._under_way
            self._under_way = self.motor_counts + wrap_int32(target_counts - self.motor_counts)

    def seed(self, motor_counts: int, load_counts: int, statusword: int) -> None:
        """Starts the multi-turn counts from SDO readings, so that the cycle continues from there."""
        self._unwrap_motor.reset(motor_counts)
        self._unwrap_load.reset(load_counts)
        self._unwrap_demand.reset(motor_counts)
        self.motor_counts = self.demand_counts = self.target_counts = self._under_way = motor_counts
        self.load_counts = load_counts
        self.statusword = statusword
        self.power.observe(statusword)

    def target_counts_for(self, motor_deg: float) -> int:
        """Returns the nearest motor counts to a motor angle in degrees.

        Raises `InputError` if the angle is not finite or is outside the limits.
        """
        if not math.isfinite(motor_deg):
            raise InputError(f"target of {motor_deg!r} deg is not a finite angle; the target was not sent")
        counts = round(self._motor.counts(motor_deg))
        self.check_target(counts)
        return counts


def _held(od: ObjectDictionary, entry: PdoEntry) -> int:
    variable = find(od, entry.index, entry.sub)
    value = held(variable) if variable is not None else None
    return value if value is not None and entry.type.minimum <= value <= entry.type.maximum else 0


def _handler(
    unpack: Callable[[bytes], tuple[int, ...]], takers: Sequence[tuple[int, Callable[[int], None]]]
) -> Callable[[bytes], None]:
    def handle(data: bytes) -> None:
        values = unpack(data)
        for place, take in takers:
            take(values[place])

    return handle
