"""Numbers with alternative values, which record the comparisons that would turn out differently with them.

A number of `Scales` matters to a record only if some comparison depends on it. So each is replaced by one
that passes through the arithmetic with both values, its own deciding; the names of those for which a
comparison differs are collected. A value that leaves this arithmetic (`float(...)`) counts as differing, so
none is missed.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


class WhatIf:
    """Value, with its alternatives if one of the named numbers had another value."""

    __slots__ = ("differing", "instead", "value")

    def __init__(self, value: Any, instead: Mapping[str, Any], differing: set[str]) -> None:
        self.value, self.instead, self.differing = value, instead, differing

    def __float__(self) -> float:
        self.differing |= {name for name, value in self.instead.items() if value != self.value}
        return float(self.value)

    def __bool__(self) -> bool:
        return bool(float(self))

    def __hash__(self) -> int:
        return hash(self.value)

    def __neg__(self) -> Any:
        return _both(operator.neg, (self,))

    def __array_ufunc__(self, function: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method != "__call__" or options.get("out") is not None:
            plain = (float(each) if isinstance(each, WhatIf) else each for each in inputs)
            return getattr(function, method)(*plain, **options)
        return _both(lambda *values: function(*values, **options), inputs)


def _both(function: Callable[..., Any], inputs: tuple[Any, ...]) -> Any:
    given = [each for each in inputs if isinstance(each, WhatIf)]
    differing = given[0].differing
    result = function(*(each.value if isinstance(each, WhatIf) else each for each in inputs))
    instead = {}
    for name in set().union(*(each.instead for each in given)):
        values = [each.instead.get(name, each.value) if isinstance(each, WhatIf) else each for each in inputs]
        try:
            with np.errstate(all="ignore"):
                instead[name] = function(*values)
        except ZeroDivisionError:
            instead[name] = math.inf
    if isinstance(result, (bool, np.bool_, np.ndarray)):
        differing |= {name for name, value in instead.items() if np.any(value != result)}
        return result
    return WhatIf(result, instead, differing)


def _method(function: Callable[..., Any], reflected: bool = False) -> Callable[[WhatIf, Any], Any]:
    return lambda one, other: _both(function, (other, one) if reflected else (one, other))


for _name in ("add", "sub", "mul", "truediv", "pow"):
    setattr(WhatIf, f"__{_name}__", _method(getattr(operator, _name)))
    setattr(WhatIf, f"__r{_name}__", _method(getattr(operator, _name), reflected=True))
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(WhatIf, f"__{_name}__", _method(getattr(operator, _name)))
