"""What a simulated drive has been through: events, frames, true angles, period by period."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import can

from hdbridge.units import ARCSEC_PER_DEG

EVENTS: Final = 10_000
FRAMES: Final = 1_000
PERIODS: Final = 250_000
"""What is kept, the newest; periods for a thousand seconds at 4 ms."""

SHOWN_EVENTS: Final = 40
SHOWN_FRAMES: Final = 12
"""What a failed test's report shows of them."""


@dataclass(frozen=True)
class Event:
    """Something that happened: at ``time_s`` of the drive's time, of a ``kind``, in words.

    Kinds: ``state`` (power states of CiA 402), ``nmt``, ``emcy``, ``fault`` (one that was asked for, when
    it begins and when it ends), ``bus`` (the program opens or closes its end), ``note`` (of the test).
    """

    time_s: float
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.time_s:9.3f} s  {self.kind:<5}  {self.text}"


class TrueState(NamedTuple):
    """What is true of the simulated axis at one moment, whatever its encoders and its frames say."""

    time_s: float
    """Of the drive's time, which begins with the test."""
    motor_deg: float
    """The motor's angle; the axis begins at 0."""
    load_deg: float
    """The load's angle; it begins near 0, by the gear's error."""
    ratio: float
    """Motor turns per load turn, as the gear is sold."""

    @property
    def error_arcsec(self) -> float:
        """How far the load is from where an ideal gear would have put it."""
        return (self.load_deg - self.motor_deg / self.ratio) * ARCSEC_PER_DEG


class Frame(NamedTuple):
    """A frame that the drive sent or saw."""

    time_s: float
    sent: bool
    """By the drive."""
    message: can.Message

    def __str__(self) -> str:
        message = self.message
        kind = "".join(
            f" {name}"
            for name, is_so in (
                ("29-bit", message.is_extended_id),
                ("remote", message.is_remote_frame),
                ("error", message.is_error_frame),
            )
            if is_so
        )
        way = "drive sent" if self.sent else "drive saw "
        data = bytes(message.data).hex(" ")
        return f"{self.time_s:9.3f} s  {way}  {message.arbitration_id:03X}{kind}  {data}"


class History:
    """The newest of all that; nothing grows without bound."""

    def __init__(self) -> None:
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self.frames: deque[Frame] = deque(maxlen=FRAMES)
        self.trace: deque[TrueState] = deque(maxlen=PERIODS)

    def report(self) -> str:
        """For the report of a failed test: the last events, the last frames, the last true angles."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        events, frames = list(self.events), list(self.frames)
        if len(events) > SHOWN_EVENTS:
            yield f"... {len(events) - SHOWN_EVENTS} events before"
        yield from map(str, events[-SHOWN_EVENTS:])
        yield f"the last {min(SHOWN_FRAMES, len(frames))} frames:"
        yield from map(str, frames[-SHOWN_FRAMES:])
        if self.trace:
            last = self.trace[-1]
            yield (
                f"true angles in the end: load {last.load_deg:.4f} deg, motor {last.motor_deg:.3f} deg, "
                f"transmission error {last.error_arcsec:.1f} arcsec"
            )
