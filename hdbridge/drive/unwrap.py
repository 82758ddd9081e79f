"""Unwraps a wrapping counter into a continuous position. Pure."""

from typing import Final

INT32_RANGE: Final = 1 << 32


def wrap_int32(value: int) -> int:
    """Returns the int32 that a 32-bit object holds for an unbounded count."""
    return (value + INT32_RANGE // 2) % INT32_RANGE - INT32_RANGE // 2


class Unwrap:
    """Follows a wrapping counter and returns an unbounded multi-turn count.

    Only differences modulo ``modulus`` are used, so a wrap has no effect as long as the counter moves by less
    than half the modulus between two readings. The first reading is taken as it is. ``modulus`` is 2**bits of
    the object, or an encoder's total range if it restarts earlier.
    """

    def __init__(self, modulus: int = INT32_RANGE) -> None:
        if modulus < 2:
            raise ValueError(f"the modulus of a counter is at least 2, not {modulus}")
        self._modulus = modulus
        self._half = modulus // 2
        self._value: int | None = None

    @property
    def value(self) -> int | None:
        """Last unwrapped value; None before the first reading."""
        return self._value

    def update(self, raw: int) -> int:
        """Takes a reading and returns the unwrapped position in the same counts."""
        last = self._value
        if last is None:
            self._value = raw
            return raw
        # Centred modular difference, in [-half, modulus - half).
        value = self._value = last + (raw - last + self._half) % self._modulus - self._half
        return value

    def peek(self, raw: int) -> int:
        """Returns the result of `update` without taking the reading."""
        if self._value is None:
            return raw
        return self._value + (raw - self._value + self._half) % self._modulus - self._half

    def reset(self, value: int | None = None) -> None:
        """Restarts from ``value``, or from the next reading."""
        self._value = value
