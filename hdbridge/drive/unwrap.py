"""Unwraps a wrapping counter into a continuous position. Pure."""

from hdbridge.cia301 import INT32_RANGE


class Unwrap:
    """Follows a wrapping counter and returns an unbounded multi-turn count.

    Only differences modulo ``modulus`` are used, so a wrap has no effect as long as the counter moves by less
    than half the modulus between two readings. The first reading is not changed. ``modulus`` is 2**bits of
    the object, or the encoder's total range if it is smaller.
    """

    def __init__(self, modulus: int = INT32_RANGE) -> None:
        if modulus < 2:
            raise ValueError(f"the modulus of a counter must be at least 2, not {modulus}")
        self._modulus = modulus
        self._half = modulus // 2
        self._value: int | None = None

    def update(self, raw: int) -> int:
        """Takes a reading and returns the unwrapped position in the same counts."""
        last = self._value
        if last is None:
            self._value = raw
            return raw
        # Centred modular difference, in [-half, modulus - half).
        value = self._value = last + (raw - last + self._half) % self._modulus - self._half
        return value

    def reset(self, value: int | None = None) -> None:
        """Restarts from ``value``, or from the next reading."""
        self._value = value
