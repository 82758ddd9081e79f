"""Checks of the arguments that a test passes."""

import math
from numbers import Integral
from typing import Any

from hdbridge.errors import InputError
from hdbridge.motion.procedures.parameters import is_finite


def check_number(
    what: str, value: Any, least: float = -math.inf, most: float = math.inf, *, whole: bool = False
) -> None:
    """Raises `InputError` for a value that is not a finite number (``whole``: an integer) in a range."""
    __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
    is_right = is_finite(value) and (not whole or isinstance(value, Integral))
    if is_right and least <= value <= most:
        return
    expected = "an integer" if whole else "a number"
    if math.isfinite(most):
        expected += f" from {least:g} to {most:g}"
    elif math.isfinite(least):
        expected += f" of at least {least:g}"
    raise InputError(f"{what} is {value!r}; expected {expected}")


def check_type(what: str, value: Any, kinds: type | tuple[type, ...], expected: str) -> None:
    """Raises `InputError` for a value of another type."""
    __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
    if not isinstance(value, kinds):
        raise InputError(f"{what} is {value!r}; expected {expected}")
