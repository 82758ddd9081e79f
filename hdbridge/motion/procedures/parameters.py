"""Parameters of moves and procedures, checked on construction according to their types."""

import math
from collections.abc import Callable, Collection
from dataclasses import fields
from numbers import Integral, Real
from typing import Annotated, Any, Final

from hdbridge.errors import InputError

Positive = Annotated[float, "above 0"]
Count = Annotated[int, "above 0"]


def is_finite(value: Any) -> bool:
    """Returns True for a finite number; True and False are not numbers."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _is_positive(value: Any) -> bool:
    return is_finite(value) and value > 0


def _is_count(value: Any) -> bool:
    return isinstance(value, Integral) and _is_positive(value)


def _all(check: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda values: isinstance(values, Collection) and len(values) > 0 and all(map(check, values))


_RULES: Final[dict[Any, tuple[Callable[[Any], bool], str]]] = {
    float: (is_finite, "a finite number"),
    Positive: (_is_positive, "a number above 0"),
    Positive | None: (lambda value: value is None or _is_positive(value), "a number above 0, or None"),
    Count: (_is_count, "an integer above 0"),
    tuple[float, ...]: (_all(is_finite), "at least one finite number"),
    tuple[Positive, ...]: (_all(_is_positive), "at least one number above 0"),
}
"""Check and expectation for each type of parameter; other types are not checked."""


class Checked:
    """Base class of dataclasses whose parameters are checked."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Raises `InputError` for a parameter that its type does not allow."""
        for each in fields(self):  # type: ignore[arg-type]
            is_right, expected = _RULES.get(each.type, (None, ""))
            value = getattr(self, each.name)
            if is_right and not is_right(value):
                raise InputError(f"{type(self).__name__}: {each.name}: found {value!r}; expected {expected}")
