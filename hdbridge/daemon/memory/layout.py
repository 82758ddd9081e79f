"""Layout of the shared memory: enumerations, slots of each ring, and their offsets. Data only.

    header      mark of the layout, axes, period, and the status cells
    samples     one slot per cycle, newest `SAMPLES_KEPT`           control process -> service
    events      newest `EVENTS_KEPT`                                control process -> service
    incoming    newest CAN frames outside the cycle                 control process -> service
    outgoing    CAN frames that the service sends, bounded          service -> control process
    commands    bounded                                             service -> control process
    knots       one bounded queue per axis                          service -> control process
    settings    one compensation setting per axis                   service -> control process
    followed    one bounded queue per axis: set-points              gateway -> control process
    outer       cells, one set per axis: power, resets, view        gateway <-> service

All numbers are in native byte order, because both ends run on one computer. A slot begins and ends with its
sequence number, counted from 1. Any change here requires a new `VERSION`.
"""

import logging
import math
import struct
import zlib
from enum import IntEnum, IntFlag
from typing import Any, Final, NamedTuple, Self

import numpy as np

VERSION: Final = 6
PAGE: Final = 4096
LINE: Final = 64
"""Size of a cache line, bytes; data of different writers is in different lines."""
AXES_AT_MOST: Final = 64

SAMPLES_KEPT: Final = 16_384
EVENTS_KEPT: Final = 2048
INCOMING_KEPT: Final = 4096
OUTGOING_SLOTS: Final = 256
COMMAND_SLOTS: Final = 256
KNOT_SLOTS: Final = 8192
FOLLOWED_SLOTS: Final = 1024
SETTING_BYTES: Final = 1 << 18
TEXT_BYTES: Final = 400
"""Maximum length of an event's text, bytes of UTF-8; longer texts are truncated."""
NO_FAULT: Final = 255
"""Value of ``fault`` in a sample without a latched fault."""


class SampleFlag(IntFlag):
    """Bits of ``flags`` of an axis in a sample."""

    FRESH = 1
    """Feedback of this cycle arrived and is plausible; otherwise, the values are the last good values."""
    COMPENSATING = 2
    """The correction is engaged."""
    LIMITED = 4
    """The amplitude or slew limit of the compensation acted in this cycle."""
    MEMORY_KNOWN = 8
    """The state of the hysteresis is known."""
    CHANGING = 16
    """The correction is fading from one model to another."""
    AT_REST = 32
    """The set-point is at rest."""
    UNDERRUN = 64
    """A stream ran out of knots in motion."""
    LOOP_DOUBTED = 128
    """The load loop does not act; the axis's last `EventKind.LOAD_LOOP` gives the reason."""
    CHANNEL0_KNOWN = 256
    CHANNEL1_KNOWN = 512


class CommandKind(IntEnum):
    """Command from the service to the loop; the docstrings describe the fields."""

    VERIFIED = 1
    """i motor counts, j load counts, k statusword. The drive is verified; its RPDO may be sent."""
    RELEASE = 2
    """Returns the axis to the unverified state; the loop sends it no RPDO."""
    HOME = 3
    """Stops the RPDO until HOMED, while the service homes the drive by SDO."""
    HOMED = 4
    """Ends homing; i, j, k as VERIFIED."""
    ENABLE = 5
    """Switches power on; i, j, k as VERIFIED."""
    DISABLE = 6
    """Brakes to rest, then switches power off."""
    QUICK_STOP = 7
    """Quick-stops an axis; axis -1 means all."""
    RESET = 8
    """Releases the latch and switches power off. i is 1 if the drive was verified again."""
    MOVE = 9
    """a target deg, b velocity deg/s or NaN, c acceleration deg/s2 or NaN."""
    JOG = 10
    """a velocity deg/s, b time-out s."""
    STOP = 11
    """Brakes to rest within the limits; power stays on."""
    STREAM_BEGIN = 12
    """a time-out s, i mask of the axes that begin in the same cycle, j stream number."""
    STREAM_END = 13
    """Announces the end of the knots: the axis comes to rest at the last knot, or brakes."""
    CHANGE = 14
    """Changes the compensation; i is the number of the setting."""
    DRIVE_FAULT_RESET = 15
    """Resets the drive's own fault by its controlword."""
    FOLLOW = 16
    """Follows the set-points of the gateway, from rest; a time-out s, j number of their series."""


class EventKind(IntEnum):
    """Event from the loop to the service."""

    DONE = 1
    """The command ``id`` was carried out or, if another event reports its end, has begun."""
    REFUSED = 2
    """The command ``id`` was refused and changed nothing; ``text`` is the reason. Id 0 is a relayed frame."""
    STATE = 3
    """``code`` is the new `AxisState`."""
    FAULT = 4
    """``code`` is the index in ``list(Fault)``, ``text`` the detail."""
    STOPPED = 5
    """The axis was stopped and latched; ``text`` explains it, ``code`` is the fault's index (`NO_FAULT`:
    a command), ``id`` is 1 if an emergency message of the drive explains it."""
    MOTION_ENDED = 6
    """The set-point has come to rest; ``code`` is the ended `MotionMode`, ``id`` its command."""
    UNDERRUN = 7
    BUS_DOWN = 8
    BUS_UP = 9
    CHANGED = 10
    """The change to another compensation is complete."""
    STREAM_REFUSED = 11
    """A knot of the stream was refused and the axis brakes; ``text`` is the reason."""
    ENDING = 12
    LOAD_LOOP = 13
    """The load loop no longer acts (``code`` 1, ``text`` is the reason) or acts again (``code`` 0)."""


LEVELS: Final = {
    EventKind.STOPPED: logging.ERROR,
    EventKind.BUS_DOWN: logging.ERROR,
    EventKind.FAULT: logging.WARNING,
    EventKind.REFUSED: logging.WARNING,
    EventKind.UNDERRUN: logging.WARNING,
    EventKind.LOAD_LOOP: logging.WARNING,
    EventKind.STREAM_REFUSED: logging.WARNING,
    EventKind.DONE: logging.DEBUG,
    EventKind.MOTION_ENDED: logging.DEBUG,
}
"""Log level by kind of event; all others are INFO."""


class Event(NamedTuple):
    """Event of the loop."""

    sequence: int
    cycle: int
    time_ns: int
    axis: int
    """Index of the axis; -1 is the machine."""
    kind: EventKind
    id: int = 0
    """Id of the answered command; 0 for none."""
    code: int = 0
    text: str = ""


class Command(NamedTuple):
    """Command of the service to one axis (-1: all); `CommandKind` describes the fields."""

    id: int
    kind: int
    axis: int
    a: float = 0.0
    b: float = 0.0
    c: float = 0.0
    i: int = 0
    j: int = 0
    k: int = 0


class RelayedFrame(NamedTuple):
    """Data frame with an 11-bit identifier, from the service's SDO to the loop's bus or back."""

    time_ns: int
    """Time of reception or queuing, on the loop's clock."""
    can_id: int
    data: bytes


class Knot(NamedTuple):
    """Point of a streamed path."""

    stream: int
    """Number of the stream; knots of earlier streams are discarded."""
    time_s: float
    """Time since the stream began."""
    position_deg: float
    velocity_deg_s: float


class OuterKnot(NamedTuple):
    """Set-point of the gateway: the load's position at a time, with linear motion from the previous one."""

    series: int
    """Number of the series; set-points of other series are discarded."""
    time_s: float
    """Due time, on the loop's clock."""
    position_deg: float
    """NaN ends the series."""
    received_s: float
    """Time of the outer SYNC (else of the slave's own period) that put the set-point into effect."""


class OuterView(NamedTuple):
    """Node of an axis as the outer master sees it, with that master's requests."""

    target_deg: float
    controlword: int
    statusword: int
    error_code: int
    nmt: int
    mode: int


OUTER_VIEW: Final = struct.Struct("@dHHHBB")
NO_OUTER: Final = OuterView(math.nan, 0, 0, 0, 0, 0)
"""View without a gateway process."""


class OuterCell(IntEnum):
    """Cells of one axis that gateway process and service share, each with one writer."""

    REQUESTED = 0
    """Gateway: number of the series of set-points for which power is wanted; 0 for no power."""
    GRANTED = 1
    """Service: number of the series that the loop follows."""
    REFUSED = 2
    """Service: number of the last series that was refused."""
    RESETS = 3
    """Gateway: number of requested fault resets."""
    RESETS_DONE = 4
    """Service: number of completed fault resets, with or without success."""
    PERIOD_NS = 5
    """Gateway: period of the SYNC on the outer bus; 0 without SYNC."""
    HELD = 6
    """Service: 1 while the outer master holds the lease."""
    JITTER_NS = 7
    """Gateway: mean deviation of the SYNC on the outer bus from its nominal time."""
    NODE_ID = 8
    """Gateway: node id in use; 255 if LSS removed it."""
    VIEW = 9
    """Gateway: packed `OuterView`, which the control process copies to its samples."""


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
    """The drive's position demand, 6062h, as in a record."""
    motor_position_deg: float
    load_position_deg: float
    """NaN if the axis has no encoder at its load."""
    motor_torque_nm: float
    velocity_deg_s: float
    """Velocity of the load target."""
    correction_arcsec: float
    predicted_arcsec: float
    loop_arcsec: float
    """Correction by the load loop."""
    weight: float
    reading0: float
    reading1: float
    issued_deg: float
    """Target sent in this cycle (607Ah) in motor degrees; NaN if none was sent."""
    outer_received_s: float
    """Time of reception of the other master's newest set-point in this target; NaN before the first one."""
    outer_target_deg: float
    """Load angle requested by the other master (607Ah; 60C1h in IP mode); NaN without a gateway."""
    outer_controlword: int
    outer_statusword: int
    outer_error_code: int
    """603Fh as the other master sees it."""
    outer_nmt: int
    outer_mode: int
    """6061h as the other master sees it."""


_AXIS_FORMATS: Final = ("u1", "u1", "u1", "u1", "u2", "u2", *("f8",) * 15, "u2", "u2", "u2", "u1", "u1")
AXIS_SAMPLE: Final = np.dtype(list(zip(Axis._fields, _AXIS_FORMATS, strict=True)))
"""One axis of a sample."""
SAMPLE_HEAD: Final[tuple[tuple[str, str], ...]] = (
    ("sequence", "u8"),
    ("cycle", "i8"),
    ("time_ns", "i8"),
    ("late_us", "f4"),
    ("busy_us", "f4"),
    ("bus_load", "f4"),
    ("skipped", "u4"),
)
"""Fields of a sample before those of its axes."""
_TAIL: Final[tuple[tuple[str, str], ...]] = (("check", "u4"), ("unused", "u4"), ("last", "u8"))
TAIL_CODE: Final = "I4xQ"
TAIL_BYTES: Final = 16


def sample_struct(axes: int) -> struct.Struct:
    """Returns the struct for packing a sample of ``axes`` axes."""
    kinds = [kind for _, kind in SAMPLE_HEAD] + axes * list(_AXIS_FORMATS)
    return struct.Struct(f"@{''.join(np.dtype(each).char for each in kinds)}{TAIL_CODE}")


def sample_dtype(axes: int) -> np.dtype[Any]:
    """Returns the dtype of samples: ``sequence, cycle, time_ns, late_us, busy_us, bus_load, skipped, axes``.

    ``time_ns`` is the monotonic clock at SYNC (virtual time on a virtual clock), ``bus_load`` a fraction,
    ``axes`` an array of `AXIS_SAMPLE`, shape (axes,). The fields after ``axes`` belong to the slot.
    """
    return np.dtype([*SAMPLE_HEAD, ("axes", AXIS_SAMPLE, (axes,)), *_TAIL])


EVENT: Final = struct.Struct(f"@QqqiiqiI{TEXT_BYTES}s{TAIL_CODE}")
"""sequence, cycle, time, axis, kind, id, code, length of the text, text."""
FRAME: Final = struct.Struct(f"@QqIB3x8s{TAIL_CODE}")
"""sequence, time, identifier, length, data."""
COMMAND: Final = struct.Struct(f"@Qii3d3q{TAIL_CODE}")
"""sequence (which is the id), kind, axis, a-c, i-k."""
KNOT: Final = struct.Struct(f"@Qq3d{TAIL_CODE}")
"""sequence, stream, time, position, velocity."""
HEADER: Final = struct.Struct("@IIQ?")
"""Mark of the layout, axes, period in ns, flag for checksums in slots."""
STATUS_OFFSET: Final = 1024
"""Offset of the status cells in the header's page."""


class Place(NamedTuple):
    """Section of the memory: offset, number and size of its slots."""

    offset: int
    slots: int
    slot_bytes: int


class Layout(NamedTuple):
    """Offsets of all sections for a number of axes."""

    axes: int
    samples: Place
    events: Place
    incoming: Place
    outgoing: Place
    commands: Place
    knots: tuple[Place, ...]
    settings: tuple[Place, ...]
    followed: tuple[Place, ...]
    outer: tuple[Place, ...]
    total: int

    @classmethod
    def of(cls, axes: int) -> Self:
        """Returns the layout for ``axes`` axes; each section is preceded by two cache lines of counters."""
        end = PAGE

        def place(slots: int, slot_bytes: int) -> Place:
            nonlocal end
            offset = end + 2 * LINE
            end = -(-(offset + slots * slot_bytes) // LINE) * LINE
            return Place(offset, slots, slot_bytes)

        return cls(
            axes=axes,
            samples=place(SAMPLES_KEPT, sample_struct(axes).size),
            events=place(EVENTS_KEPT, EVENT.size),
            incoming=place(INCOMING_KEPT, FRAME.size),
            outgoing=place(OUTGOING_SLOTS, FRAME.size),
            commands=place(COMMAND_SLOTS, COMMAND.size),
            knots=tuple(place(KNOT_SLOTS, KNOT.size) for _ in range(axes)),
            settings=tuple(place(1, SETTING_BYTES) for _ in range(axes)),
            followed=tuple(place(FOLLOWED_SLOTS, KNOT.size) for _ in range(axes)),
            outer=tuple(place(len(OuterCell), LINE) for _ in range(axes)),
            total=-(-end // PAGE) * PAGE,
        )

    @property
    def mark(self) -> int:
        """Checksum of the version and the offsets, which identifies memory of the same release."""
        return zlib.crc32(repr((VERSION, self)).encode())
