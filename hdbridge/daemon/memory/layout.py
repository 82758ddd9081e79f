"""What lies in the shared memory: the enumerations, the slots of each ring, and their places. Data only.

    header      magic, version, axes, period, sizes, and the status cells
    samples     one slot per cycle, newest `SAMPLES_KEPT`           control process -> service
    events      newest `EVENTS_KEPT`                                control process -> service
    incoming    CAN frames that are not of the cycle, newest        control process -> service
    outgoing    CAN frames that the service wants sent, bounded     service -> control process
    commands    bounded                                             service -> control process
    knots       one bounded queue per axis                          service -> control process
    settings    one slot per axis: what compensates it              service -> control process

All numbers are in the machine's own byte order: both ends run on it. A slot begins and ends with its sequence
number, counted from 1. A change of anything here is a new `VERSION`.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag
from typing import Any, Final, NamedTuple

import numpy as np

MAGIC: Final = b"hdbridge"
VERSION: Final = 3
PAGE: Final = 4096
LINE: Final = 64
"""A cache line: what two processes write lies in different ones."""
AXES_AT_MOST: Final = 64

SAMPLES_KEPT: Final = 16_384
EVENTS_KEPT: Final = 2048
INCOMING_KEPT: Final = 4096
OUTGOING_SLOTS: Final = 256
COMMAND_SLOTS: Final = 256
KNOT_SLOTS: Final = 8192
SETTING_BYTES: Final = 1 << 18
TEXT_BYTES: Final = 400
"""Longest text of an event, bytes of UTF-8; more is cut."""
NO_FAULT: Final = 255
"""``fault`` of a sample where none is latched."""


class SampleFlag(IntFlag):
    """``flags`` of an axis in a sample."""

    FRESH = 1
    """This cycle's feedback came and is believed; else the values are the last good ones."""
    COMPENSATING = 2
    """The correction is engaged."""
    LIMITED = 4
    """A cap or the slew limit of the compensation was at work in this cycle."""
    MEMORY_KNOWN = 8
    """The state of the hysteresis is known."""
    CHANGING = 16
    """The correction is on the way from one model to another."""
    AT_REST = 32
    """The set-point stands."""
    UNDERRUN = 64
    """A stream ran out of knots in motion."""
    LOOP_DOUBTED = 128
    """The load loop does not act; the last `EventKind.LOAD_LOOP` of the axis says why."""
    CHANNEL0_KNOWN = 256
    CHANNEL1_KNOWN = 512


class CommandKind(IntEnum):
    """What the service asks of the loop; what the fields of a command mean stands behind each."""

    VERIFIED = 1
    """i motor counts, j load counts, k statusword: the drive is booted; its RPDO may be sent."""
    RELEASE = 2
    """Back to unverified: no RPDO."""
    LEND = 3
    """No RPDO until UNLEND: the service moves the drive by SDO."""
    UNLEND = 4
    """i, j, k as VERIFIED."""
    ENABLE = 5
    """i, j, k as VERIFIED."""
    DISABLE = 6
    """Stop in order, then power off."""
    QUICK_STOP = 7
    """Axis -1: all."""
    RESET = 8
    """Release the latch, and switch power off. i is 1 when the drive was booted and verified again."""
    MOVE = 9
    """a target deg, b velocity deg/s or NaN, c acceleration deg/s2 or NaN."""
    JOG = 10
    """a velocity deg/s, b time-out s."""
    STOP = 11
    """Brake to rest within the limits; power stays on."""
    STREAM_BEGIN = 12
    """a time-out s, i mask of the axes that begin in the same cycle, j number of the stream."""
    STREAM_END = 13
    """No more knots come: the axis goes to the last one and rests, or brakes."""
    CHANGE = 14
    """Compensate by another setting; i is its number."""
    DRIVE_FAULT_RESET = 15
    """Reset the drive's own fault, by its controlword."""


class EventKind(IntEnum):
    """What the loop tells the service."""

    DONE = 1
    """The command ``id`` was carried out (or has begun: its end is another event)."""
    REFUSED = 2
    """The command ``id`` was refused and changed nothing; ``text`` says why. id 0: a frame of the relay."""
    STATE = 3
    """``code`` is the new `AxisState`."""
    FAULT = 4
    """``code`` is the index in ``list(Fault)``, ``text`` the detail."""
    STOPPED = 5
    """The supervision has latched; ``text`` explains it, ``code`` is the index of its cause (`NO_FAULT`: a
    command), ``id`` is 1 if an emergency message of the drive explains it.
    """
    MOTION_ENDED = 6
    """The set-point has come to rest; ``code`` is the `MotionMode` that has ended, ``id`` its command."""
    UNDERRUN = 7
    BUS_DOWN = 8
    BUS_UP = 9
    CHANGED = 10
    """The switch to another compensation is complete."""
    STREAM_REFUSED = 11
    """A knot of the stream was refused and the axis brakes; ``text`` says why."""
    ENDING = 12
    LOAD_LOOP = 13
    """The load loop no longer acts (``code`` 1) and ``text`` says why, or acts again (``code`` 0)."""


class Event(NamedTuple):
    """Something that happened in the loop."""

    sequence: int
    cycle: int
    time_ns: int
    axis: int
    """Index of the axis; -1: the machine."""
    kind: EventKind
    id: int
    """Of the command that it answers; 0: none."""
    code: int
    text: str


class Command(NamedTuple):
    """What the service asks of one axis (-1: of all); see `CommandKind` for the fields."""

    id: int
    kind: int
    axis: int
    a: float
    b: float
    c: float
    d: float
    i: int
    j: int
    k: int


class Knot(NamedTuple):
    """A point that a streamed set-point goes through."""

    stream: int
    """Number of the stream that it belongs to; those of an earlier one are thrown away."""
    time_s: float
    """Since the stream has begun."""
    position_deg: float
    velocity_deg_s: float


class Axis(NamedTuple):
    """One axis in a sample, in the order of `AXIS_SAMPLE`."""

    state: int
    mode: int
    power: int
    fault: int
    statusword: int
    flags: int
    load_target_deg: float
    motor_target_deg: float
    """The drive's demand, 6062h, as in a record."""
    motor_position_deg: float
    load_position_deg: float
    motor_torque_nm: float
    velocity_deg_s: float
    """Of the load target."""
    correction_arcsec: float
    predicted_arcsec: float
    loop_arcsec: float
    """Of the slow integral at the load."""
    weight: float
    reading0: float
    reading1: float
    issued_deg: float
    """The target that was sent in this cycle, 607Ah, degrees of the motor; NaN where none was."""


_AXIS_FORMATS: Final = ("u1", "u1", "u1", "u1", "u2", "u2", *("f8",) * 13)
AXIS_SAMPLE: Final = np.dtype(list(zip(Axis._fields, _AXIS_FORMATS, strict=True)))
"""One axis of a sample."""
_AXIS_CODE: Final = "BBBBHH13d"
_HEAD: Final[tuple[tuple[str, str], ...]] = (
    ("sequence", "u8"),
    ("cycle", "i8"),
    ("time_ns", "i8"),
    ("late_us", "f4"),
    ("busy_us", "f4"),
    ("bus_load", "f4"),
    ("skipped", "u4"),
)
_HEAD_CODE: Final = "QqqfffI"
_TAIL: Final[tuple[tuple[str, str], ...]] = (("check", "u4"), ("unused", "u4"), ("last", "u8"))
TAIL_CODE: Final = "I4xQ"
TAIL_BYTES: Final = 16


def sample_struct(axes: int) -> struct.Struct:
    """How the writer packs a sample of so many axes."""
    return struct.Struct(f"@{_HEAD_CODE}{_AXIS_CODE * axes}{TAIL_CODE}")


def slot_dtype(axes: int) -> np.dtype[Any]:
    """A sample as it lies in the memory."""
    return np.dtype([*_HEAD, ("axes", AXIS_SAMPLE, (axes,)), *_TAIL])


def sample_dtype(axes: int) -> np.dtype[Any]:
    """A sample as readers see it: ``sequence, cycle, time_ns, late_us, busy_us, bus_load, skipped, axes``.

    ``time_ns`` is the monotonic clock at SYNC (virtual time on a virtual clock), ``bus_load`` a share,
    ``axes`` an array of `AXIS_SAMPLE`, shape (axes,).
    """
    slot = slot_dtype(axes)
    names = [*(name for name, _ in _HEAD), "axes"]
    assert slot.fields is not None
    return np.dtype({
        "names": names,
        "formats": [slot.fields[name][0] for name in names],
        "offsets": [slot.fields[name][1] for name in names],
        "itemsize": slot.itemsize,
    })  # fmt: skip


EVENT: Final = struct.Struct(f"@QqqiiqiI{TEXT_BYTES}s{TAIL_CODE}")
"""sequence, cycle, time, axis, kind, id, code, length of the text, text."""
FRAME: Final = struct.Struct(f"@QqIB3x8s{TAIL_CODE}")
"""sequence, time, identifier, length, data."""
COMMAND: Final = struct.Struct(f"@Qii4d3q{TAIL_CODE}")
"""sequence (which is the id), kind, axis, a-d, i-k."""
KNOT: Final = struct.Struct(f"@Qq3d{TAIL_CODE}")
"""sequence, stream, time, position, velocity."""
HEADER: Final = struct.Struct("@8sIIQQQI4x")
"""magic, version, axes, period in ns, bytes in all, crc of the layout's sizes, whether slots are checked."""
STATUS_OFFSET: Final = 1024
"""Where the status cells begin within the header's page."""


class Place(NamedTuple):
    """A section of the memory: where its slots begin, how many, of which size."""

    offset: int
    slots: int
    slot_bytes: int


class Layout(NamedTuple):
    """Where everything lies for a number of axes."""

    axes: int
    samples: Place
    events: Place
    incoming: Place
    outgoing: Place
    commands: Place
    knots: tuple[Place, ...]
    settings: tuple[Place, ...]
    total: int

    @classmethod
    def of(cls, axes: int) -> Layout:
        """The layout for ``axes`` axes; each section begins with two cache lines for its counters."""
        end = PAGE

        def place(slots: int, slot_bytes: int) -> Place:
            nonlocal end
            offset = end + 2 * LINE
            end = -(-(offset + slots * slot_bytes) // LINE) * LINE
            return Place(offset, slots, slot_bytes)

        samples = place(SAMPLES_KEPT, sample_struct(axes).size)
        events = place(EVENTS_KEPT, EVENT.size)
        incoming = place(INCOMING_KEPT, FRAME.size)
        outgoing = place(OUTGOING_SLOTS, FRAME.size)
        commands = place(COMMAND_SLOTS, COMMAND.size)
        knots = tuple(place(KNOT_SLOTS, KNOT.size) for _ in range(axes))
        settings = tuple(place(1, SETTING_BYTES) for _ in range(axes))
        total = -(-end // PAGE) * PAGE
        return cls(axes, samples, events, incoming, outgoing, commands, knots, settings, total)
