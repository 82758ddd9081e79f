"""History of a simulated drive: events, frames, and true angles period by period."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import can

from hdbridge.units import ARCSEC_PER_DEG

EVENTS: Final = 10_000
FRAMES: Final = 1_000
PERIODS: Final = 250_000
"""Maximum number of kept entries, the newest; periods for a thousand seconds at 4 ms."""

SHOWN_EVENTS: Final = 40
SHOWN_FRAMES: Final = 12
"""Number of entries shown in the report of a failed test."""


@dataclass(frozen=True)
class Event:
    """Event at ``time_s`` of the drive's time, with a ``kind`` and a text.

    Kinds: ``state`` (power states of CiA 402), ``nmt``, ``emcy``, ``fault`` (start and end of a requested
    one), ``bus`` (the program opens or closes its end), ``note`` (from the test).
    """

    time_s: float
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.time_s:9.3f} s  {self.kind:<5}  {self.text}"


class TrueState(NamedTuple):
    """True state of the simulated axis at one moment, independent of encoders and frames."""

    time_s: float
    """Drive time, which starts with the test."""
    motor_deg: float
    """Motor angle; the axis starts at 0."""
    load_deg: float
    """Load angle; it starts near 0, displaced by the gear's error."""
    ratio: float
    """Nominal motor turns per load turn."""

    @property
    def error_arcsec(self) -> float:
        """Deviation of the load from the angle that an ideal gear would give."""
        return (self.load_deg - self.motor_deg / self.ratio) * ARCSEC_PER_DEG


class Frame(NamedTuple):
    """A frame that the drive sent or saw."""

    time_s: float
    sent: bool
    """True if the drive sent it."""
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
    """The newest events, frames and true states; bounded in size."""

    def __init__(self) -> None:
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self.frames: deque[Frame] = deque(maxlen=FRAMES)
        self.trace: deque[TrueState] = deque(maxlen=PERIODS)

    def report(self) -> str:
        """Returns the last events, frames and true angles, for the report of a failed test."""
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
