"""The optional channels on line: load torque and temperature, scaled, checked, held and given up. Pure.

A channel is worth less than the encoders: without it the axis still stands where it should, but for the part
of the compensation that depends on it. So a reading that is missing or not believed is no reason to stop.
The last good one is held, for as long as the axis file says; then the channel is lost, and has no value until
readings come again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hdbridge.axis.channels import BY_KEY
from hdbridge.drive.objects import IntegerType
from hdbridge.drive.supervision import Fault

if TYPE_CHECKING:
    from hdbridge.axis.channels import MeasuredChannel


class ChannelFollower:
    """One channel: `accept` takes its readings, `step` ends each cycle, ``value`` is what to go by."""

    __slots__ = (
        "_age", "_at_zero", "_every", "_greatest", "_hold", "_least", "_overdue", "_per_count", "_unit",
        "key", "lost", "value", "why",
    )  # fmt: skip

    def __init__(self, key: str, channel: MeasuredChannel, cycle_ms: float) -> None:
        """``key`` is that of the axis file."""
        self.key = key
        self._per_count, self._at_zero, least, greatest = channel.scale
        self._unit = BY_KEY[key].unit
        # The ends of a signed type, and the top of any, are what a sensor says that is broken or saturated.
        kind = IntegerType.named(channel.source.type)
        ends = sorted((self._of(kind.minimum + kind.signed), self._of(kind.maximum - 1)))
        self._least, self._greatest = max(least, ends[0]), min(greatest, ends[1])
        self._every = channel.every_cycles
        # A frame that is not waited for may come a cycle later or earlier than the last one did.
        self._overdue = 1 if self._every == 1 else self._every + 1
        self._hold = int(channel.hold_ms / cycle_ms)
        self.reset()

    def reset(self) -> None:
        """Nothing is known: the cycle begins, or has rested."""
        self.value: float | None = None
        """The last good reading in the unit of the channel; None before the first, and while it is lost."""
        self.lost = False
        """None has come for so long that none is waited for."""
        self.why = "none came"
        """What there is to say about the value, where there is none or it is an old one."""
        self._age = 0

    def accept(self, counts: int) -> None:
        """A reading has come."""
        value = self._of(counts)
        if self._least <= value <= self._greatest:
            self.value = value
            self.lost = False
            self._age = 0
            self.why = "none came"
        else:
            self.why = (
                f"{value:g} {self._unit} is not within {self._least:g} to {self._greatest:g} {self._unit}"
            )

    def step(self) -> tuple[Fault, str] | None:
        """The cycle's readings are in: what is wrong with the channel, in words as well, or None.

        Said once per reading that is overdue, and once when the channel is lost.
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
