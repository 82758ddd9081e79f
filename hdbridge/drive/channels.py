"""Optional channels of a running axis (load torque, temperature): scaling, range check, hold and loss. Pure.

A channel is less important than the encoders. Without it, the axis still holds its position, except for the
part of the compensation that depends on the channel. The axis therefore does not stop for a missing or
implausible reading. The last good reading is held for the time given in the axis file. After that, the
channel is lost and has no value until readings return.
"""

from hdbridge.axis.channels import BY_KEY, MeasuredChannel
from hdbridge.drive.objects import IntegerType
from hdbridge.drive.supervision import Fault


class ChannelFollower:
    """Validates and holds the readings of one channel.

    `accept` takes a reading, `step` ends each cycle, and ``value`` is the reading to use.
    """

    def __init__(self, key: str, channel: MeasuredChannel, cycle_ms: float) -> None:
        """``key`` is the channel's key in the axis file."""
        self.key = key
        self._per_count, self._at_zero, least, greatest = channel.scale
        self._unit = BY_KEY[key].unit
        # A broken or saturated sensor reports the ends of a signed type, or the top of an unsigned one.
        kind = IntegerType.named(channel.source.type)
        ends = sorted((self._of(kind.minimum + kind.signed), self._of(kind.maximum - 1)))
        self._least, self._greatest = max(least, ends[0]), min(greatest, ends[1])
        self._every = channel.every_cycles
        # A frame that the cycle does not wait for may arrive one cycle early or late.
        self._overdue = 1 if self._every == 1 else self._every + 1
        self._hold = int(channel.hold_ms / cycle_ms)
        self.reset()

    def reset(self) -> None:
        """Discards all readings, at the start of the cycle and after a pause."""
        self.value: float | None = None
        """Last good reading in the unit of the channel; None before the first reading and while the channel
        is lost.
        """
        self.lost = False
        """True if no good reading has come for longer than the hold time; the cycle then no longer waits for
        readings."""
        self.why = "none arrived"
        """Reason for the lack of a new value, for messages."""
        self._age = 0

    def accept(self, counts: int) -> None:
        """Takes a reading; a reading outside the plausible range is rejected."""
        value = self._of(counts)
        if self._least <= value <= self._greatest:
            self.value = value
            self.lost = False
            self._age = 0
            self.why = "none arrived"
        else:
            self.why = (
                f"{value:g} {self._unit} is not within {self._least:g} to {self._greatest:g} {self._unit}"
            )

    def step(self) -> tuple[Fault, str] | None:
        """Ends a cycle; returns the channel's fault and its description, or None.

        Reports each overdue reading once, and the loss of the channel once.
        """
        age = self._age
        self._age = age + 1
        if age < self._overdue or self.lost:
            return None
        text = f"{self.key}: {self.why}"
        if age > self._hold:
            self.value = None
            self.lost = True
            return Fault.CHANNEL_LOST, text
        held = self.value is not None and (age - 1) % self._every == 0
        return (Fault.CHANNEL_HELD, text) if held else None

    def _of(self, counts: int) -> float:
        return self._at_zero + self._per_count * counts
