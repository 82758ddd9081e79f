"""Faults of a simulated drive by name, as a table with one row per fault.

Actions of the drive, its encoders, other nodes and the interface cause the faults listed in
docs/reliability.md. Faults of the program itself (a target that is not a number, a full disk) must be caused
by the program.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType
from typing import Any, Final

import can

from hdbridge.errors import BusError, InputError
from hdbridge.files.expectation import nearest
from hdbridge.testing.arguments import check_number, check_type
from hdbridge.testing.port import Condition, Port
from hdbridge.testing.watched import End, WatchedDrive, shown

Value = int | float
_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "count": (0, 100_000),
    "samples": (0, 100_000),
    "number": (1, 512),
    "node_id": (1, 127),
    "command": (0, 0xFF),
    "code": (0, 0xFFFF),
    "index": (0, 0xFFFF),
    "subindex": (0, 0xFF),
    "counts": (-(1 << 31), (1 << 31) - 1),
    "value": (-(1 << 63), (1 << 64) - 1),
    "product_code": (0, 0xFFFF_FFFF),
    "percent": (0, 1000),
    "counts_per_s": (-1e12, 1e12),
    "counts_per_s2": (1e-3, 1e12),
    "duration_s": (0, 3600),
}
"""Smallest and largest value of the arguments."""
_BUS_OFF: Final = 0x40
"""CAN_ERR_BUSOFF of linux/can/error.h, in the identifier of an error frame."""


@dataclass(frozen=True)
class Reach:
    """Objects on which a fault can act."""

    drive: WatchedDrive
    another: Callable[[], AbstractContextManager[can.BusABC]]
    """Opens the bus for another node."""
    port: Port | None
    """CAN interface of the program under test; None if the program is in another process."""
    bus: str
    """Name of the bus, for messages."""

    def send(self, can_id: int, data: bytes = b"", times: int = 1, **kind: bool) -> End:
        """Sends frames as another node."""
        kind = {"is_extended_id": False, **kind}
        with self.another() as bus:
            for _ in range(times):
                bus.send(can.Message(arbitration_id=can_id, data=data, **kind))
        return _nothing

    def set_faults(self, **values: object) -> End:
        """Sets attributes of the drive's fault settings; ending the fault restores the previous values."""
        settings = self.drive.faults
        before = {name: getattr(settings, name) for name in values}

        def assign(given: Mapping[str, object]) -> None:
            for name, value in given.items():
                setattr(settings, name, value)

        assign(values)
        return lambda: assign(before)

    def mute(self, can_id: int) -> End:
        """Suppresses all frames of the drive with this identifier."""
        settings = self.drive.faults
        settings.muted_ids |= {can_id}

        def speaks() -> None:
            settings.muted_ids -= {can_id}

        return speaks

    @property
    def interface(self) -> Port:
        """CAN interface of the program under test, for faults that require one in this process."""
        assert self.port is not None
        return self.port


def _nothing() -> None:
    """Does nothing; the end of an instantaneous fault."""


Make = Callable[..., End]


class Needs(Enum):
    """Requirement of a fault that not every bus meets."""

    NOTHING = "nothing"
    INTERFACE = "the program's interface, in this process"
    CLOCK = "a clock that the simulated drive controls"


@dataclass(frozen=True)
class Row:
    """One fault that a test can cause by name."""

    name: str
    what: str
    """Description in one sentence, which names the arguments."""
    make: Make
    arguments: Mapping[str, Value] = field(default_factory=dict)
    reported_as: str = ""
    """Text of the corresponding fault in the fault table."""
    needs: Needs = Needs.NOTHING
    required_object: Callable[[Mapping[str, Any]], tuple[int, int]] | None = None
    """Returns the object that the drive must have, given the arguments."""

    def check(self, reach: Reach, arguments: Mapping[str, Any]) -> None:
        """Raises `InputError` if the fault cannot be caused on this bus or drive."""
        __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
        if self.needs is Needs.INTERFACE and reach.port is None:
            raise InputError(
                f"fault '{self.name}': the simulated drive cannot take down the interface of {reach.bus}; "
                "choose the bus 'virtual' or 'lockstep', or do it in the test (ip link set vcan0 down)"
            )
        if self.needs is Needs.CLOCK and (reach.port is None or reach.port.clock is None):
            raise InputError(
                f"fault '{self.name}' needs the bus 'lockstep', whose clock the simulated drive controls; "
                "in real time let the program itself sleep, or stop its process (SIGSTOP)"
            )
        place = self.required_object(arguments) if self.required_object else None
        if place is not None and place not in reach.drive.dictionary:
            raise InputError(f"fault '{self.name}': the drive has no object {place[0]:04X}h:{place[1]:02X}")

    def begin(self, reach: Reach, arguments: Mapping[str, Value]) -> End:
        """Starts the fault; raises `BusError` if the bus refuses its frames."""
        try:
            return self.make(reach, **arguments)
        except can.CanError as error:
            raise BusError(f"fault '{self.name}' cannot be injected on {reach.bus}: {error}") from error

    def checked(self, given: Mapping[str, Any]) -> dict[str, Value]:
        """Returns the arguments completed with defaults; raises `InputError` with the valid arguments."""
        __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
        signature = ", ".join(f"{name}={value!r}" for name, value in self.arguments.items()) or "none"
        for name, value in given.items():
            if name not in self.arguments:
                close = nearest(name, list(self.arguments))
                hint = f"; did you mean '{close}'?" if close else ""
                raise InputError(f"fault '{self.name}' has no argument '{name}'; expected: {signature}{hint}")
            whole = isinstance(self.arguments[name], int)
            check_number(f"fault '{self.name}': {name}", value, *_RANGES.get(name, ()), whole=whole)
        return {**self.arguments, **given}


def _sets(**values: object) -> Make:
    return lambda reach: reach.set_faults(**values)


def _sets_argument(name: str) -> Make:
    """Returns a function that sets an attribute of the fault settings to the fault's only argument."""
    return lambda reach, **argument: reach.set_faults(**{name: next(iter(argument.values()))})


def _once(act: Callable[..., object]) -> Make:
    """Returns a function that calls ``act`` with the drive and the fault's arguments."""

    def make(reach: Reach, **arguments: Value) -> End:
        act(reach.drive, **arguments)
        return _nothing

    return make


def _frame(can_id: int, data: bytes = b"", *, own: bool = False, **kind: bool) -> Make:
    """Returns a function that sends a frame; with ``own``, the drive's node id is added to its identifier."""
    return lambda reach: reach.send(can_id + own * reach.drive.node_id, data, **kind)


def _stale(reach: Reach) -> End:
    for can_id, data in list(reach.drive.last_tpdos.items()):
        reach.send(can_id, data)
    return _nothing


def _tpdo(arguments: Mapping[str, Any]) -> tuple[int, int]:
    return 0x1800 + arguments["number"] - 1, 1


def _named_object(arguments: Mapping[str, Any]) -> tuple[int, int]:
    return arguments["index"], arguments["subindex"]


def _glitch(reach: Reach, counts: int, samples: int) -> End:
    left = [counts] * samples
    return reach.set_faults(load_reading=lambda right: right + (left.pop() if left else 0))


def _frozen(reach: Reach) -> End:
    counts = reach.drive.firmware.motion.load_counts
    return reach.set_faults(load_reading=lambda _: counts)


def _drift(reach: Reach, counts_per_s: float) -> End:
    drive = reach.drive
    begin_s = drive.time_s
    return reach.set_faults(load_reading=lambda right: right + round(counts_per_s * (drive.time_s - begin_s)))


def _weak(reach: Reach, percent: float) -> End:
    machine, value = reach.drive.machine, reach.drive.dictionary.value

    def strong_again() -> None:
        machine.torque_limit_permille = value(0x6072)

    machine.torque_limit_permille = 10.0 * percent
    return strong_again


def _gone(condition: Condition) -> Make:
    return lambda reach: reach.interface.fail(condition)


def _full(reach: Reach, count: int) -> End:
    port = reach.interface
    port.refused_sends += count

    def room_again() -> None:
        port.refused_sends = 0

    return room_again


def _stall(reach: Reach, duration_s: float) -> End:
    clock = reach.interface.clock
    assert clock is not None
    clock.stall_s += duration_s
    return _nothing


_MISSING = "a TPDO is missing"
_DUPLICATED = "a TPDO came twice or out of its cycle"
_WRONG_KIND = "a frame of the wrong kind was discarded"
_JUMP = "an encoder moved faster than the axis can"
_OWN_ID = "another node sends with an identifier of this master"
_CHANNEL = "a load torque or temperature did not arrive, or is implausible"
_AWAY = "the CAN interface went away"
_DROPPED_OUT = "the drive changed its power state on its own"

_ROWS: Final = (
    Row("lost_tpdo", "The next `count` TPDOs are not sent.",
        _sets_argument("drop_tpdos"), {"count": 1}, _MISSING),
    Row("late_tpdo", "The next `count` TPDOs come one SYNC later, after the fresh ones.",
        _sets_argument("hold_tpdos"), {"count": 1}, _DUPLICATED),
    Row("duplicated_tpdo", "The next `count` TPDOs come twice.",
        _sets_argument("duplicate_tpdos"), {"count": 1}, _DUPLICATED),
    Row("stale_tpdo", "The TPDOs of the last SYNC are repeated now.", _stale, reported_as=_DUPLICATED),
    Row("reordered_tpdos", "After the next `count` SYNCs the TPDOs come in reverse order.",
        _sets_argument("reverse_tpdos"), {"count": 1}),
    Row("short_tpdo", "The next `count` TPDOs come without their last byte.",
        _sets_argument("shorten_tpdos"), {"count": 1}, "a TPDO has the wrong length"),
    Row("tpdo_stopped", "TPDO `number` is not sent any more.",
        lambda reach, number: reach.mute(reach.drive.dictionary.value(*_tpdo({"number": number})) & 0x7FF),
        {"number": 1}, _CHANNEL, required_object=_tpdo),
    Row("cable_pulled", "The drive neither receives nor sends.",
        _sets(silent=True), reported_as=_MISSING),
    Row("drive_deaf", "The drive receives nothing but continues to send.",
        _sets(deaf=True), reported_as="the control process stalled for longer than the drive waits"),
    Row("program_stalls", "The program's next wait takes `duration_s` longer (only in lockstep).",
        _stall, {"duration_s": 0.1}, "the cycle started too late", Needs.CLOCK),
    Row("remote_frame", "A remote frame (RTR) with the identifier of TPDO 1.",
        _frame(0x180, own=True, is_remote_frame=True), reported_as=_WRONG_KIND),
    Row("extended_frame", "A frame with a 29-bit identifier, of the number of TPDO 1.",
        _frame(0x180, bytes(8), own=True, is_extended_id=True), reported_as=_WRONG_KIND),
    Row("error_frame", "An error frame.",
        _frame(0x004, bytes(8), is_error_frame=True), reported_as=_WRONG_KIND),
    Row("bus_off", "The error frame of a CAN controller that went bus-off.",
        _frame(_BUS_OFF, bytes(8), is_error_frame=True), reported_as=_AWAY),
    Row("babbling_node", "`count` frames of an unknown node, at once.",
        lambda reach, count: reach.send(0x7E5, bytes(8), times=count), {"count": 300},
        "more frames waited than one cycle reads"),
    Row("emergency_burst", "`count` EMCY messages with `code`; the drive continues.",
        lambda reach, count, code: reach.send(
            0x080 + reach.drive.node_id, struct.pack("<HB5x", code, 1), times=count),
        {"count": 32, "code": 0x3110}, "the drive sent an emergency message"),
    Row("drive_fault", "The drive detects an error, sends EMCY `code`, brakes and goes into FAULT.",
        _once(lambda drive, code: drive.faults.raise_error(code)), {"code": 0x3210},
        "the drive reports a fault"),
    Row("enable_lost", "The power stage switches off without a message, as by a hardware enable input.",
        _once(lambda drive: drive.faults.open_enable_input()), reported_as=_DROPPED_OUT),
    Row("master_missed", "The drive misses its master, sends EMCY `code` and stops according to 6007h.",
        _once(lambda drive, code: drive.faults.miss_master(code)), {"code": 0x8130},
        "the drive reports that it missed its master"),
    Row("restart", "The drive restarts, as after a brown-out.",
        _once(lambda drive: drive.faults.boot_up()), reported_as="a node restarted"),
    Row("leaves_operational", "The drive goes into NMT PRE-OPERATIONAL.",
        _once(lambda drive: drive.faults.leave_operational()), reported_as="a node is not operational"),
    Row("heartbeat_lost", "The drive's heartbeat stops.",
        _sets(mute_heartbeat=True), reported_as="the drive's heartbeat is missing"),
    Row("second_master_sync", "SYNC of another master.",
        _frame(0x080), reported_as="another node sends SYNC"),
    Row("second_master_set_point", "An RPDO of another master: no power, target 0.",
        _frame(0x200, bytes(6), own=True), reported_as=_OWN_ID),
    Row("second_master_heartbeat", "A heartbeat of another master, node `node_id`.",
        lambda reach, node_id: reach.send(0x700 + node_id, b"\x05"), {"node_id": 127}, _OWN_ID),
    Row("second_master_nmt", "An NMT `command` of another master to all nodes (128: pre-operational).",
        lambda reach, command: reach.send(0x000, bytes([command, 0])), {"command": 128}, _OWN_ID),
    Row("second_master_sdo", "An SDO request of another client: it reads 1000h.",
        _frame(0x600, bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0]), own=True), reported_as=_OWN_ID),
    Row("encoder_jump", "The load encoder reads `counts` more from now on.",
        lambda reach, counts: reach.set_faults(
            load_jump_counts=reach.drive.faults.load_jump_counts + counts),
        {"counts": 100_000}, _JUMP),
    Row("encoder_glitch", "The load encoder reads `counts` more for the next `samples` samples.",
        _glitch, {"counts": 100_000, "samples": 1}, _JUMP),
    Row("encoder_frozen", "The load encoder keeps reporting the same counts.", _frozen),
    Row("encoder_drift", "The load encoder drifts by `counts_per_s`.", _drift, {"counts_per_s": 1000.0}),
    Row("motor_encoder_jump", "The motor encoder reads `counts` more; the servo loops act on it.",
        lambda reach, counts: reach.set_faults(
            motor_jump_counts=reach.drive.faults.motor_jump_counts + counts),
        {"counts": 1000}, _JUMP),
    Row("motor_weak", "The motor gives at most `percent` of its rated torque, and falls behind.",
        _weak, {"percent": 0.0}, "the drive does not follow its demand"),
    Row("bus_down", "The program's interface goes down (ENETDOWN); its end brings it up again.",
        _gone(Condition.DOWN), reported_as=_AWAY, needs=Needs.INTERFACE),
    Row("bus_deleted", "The program's interface is deleted (ENXIO); after its end it can be opened again.",
        _gone(Condition.DELETED), reported_as=_AWAY, needs=Needs.INTERFACE),
    Row("transmit_queue_full", "The program's next `count` frames find the transmit queue full (ENOBUFS).",
        _full, {"count": 1}, "the transmit queue is full", Needs.INTERFACE),
    Row("sdo_silent", "SDO requests are not answered.",
        lambda reach: reach.mute(0x580 + reach.drive.node_id)),
    Row("wrong_value", "The drive reports `value` for an object, by SDO and in its TPDOs.",
        lambda reach, **arguments: reach.drive.report_false_value(**arguments),
        {"index": 0x2100, "subindex": 0, "value": 32767}, _CHANNEL, required_object=_named_object),
    Row("wrong_identity", "Object 1018h:02 holds another `product_code`.",
        lambda reach, product_code: reach.drive.report_false_value(0x1018, 2, product_code),
        {"product_code": 1}),
    Row("missing_object", "The drive has no object `index`:`subindex` (for good).",
        _once(lambda drive, index, subindex: drive.dictionary.remove(index, subindex)),
        {"index": 0x60E4, "subindex": 1}, required_object=_named_object),
    Row("no_watchdogs", "The drive does not notice missing heartbeats or set-points of its master.",
        _sets(ignore_lost_heartbeat=True, ignore_missing_set_points=True)),
    Row("slow_brakes", "The drive brakes with `counts_per_s2`, regardless of its objects.",
        _sets_argument("deceleration_counts_s2"), {"counts_per_s2": 2000.0}),
)  # fmt: skip

FAULTS: Final[Mapping[str, Row]] = MappingProxyType({row.name: row for row in _ROWS})

OF_THE_PROGRAM: Final = (
    "the target is not a number within the limits",
    "a load torque or temperature is missing",
)
"""Entries of the fault table in docs/reliability.md that this module cannot cause: faults of the program, and
consequences of other faults."""


def find(name: str) -> Row:
    """Returns the fault with this name; raises `InputError` with the most similar name."""
    __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
    check_type("the name of the fault", name, str, "text")
    row = FAULTS.get(name)
    if row is None:
        close = nearest(name, list(FAULTS))
        hint = f"did you mean '{close}'?" if close else f"expected one of: {', '.join(FAULTS)}"
        raise InputError(f"no fault is called '{name}'; {hint} (drive.faults has all)")
    return row


def sentences() -> Iterator[tuple[str, str, str]]:
    """Yields name, arguments with their defaults, and description of each fault, for documentation."""
    for row in _ROWS:
        arguments = ", ".join(f"{name}={shown(name, value)}" for name, value in row.arguments.items())
        yield row.name, arguments, row.what
