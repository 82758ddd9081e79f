"""The loops and mechanics as machine code, made of the very classes that Python runs: the same numbers.

An object of the classes that `hdbridge.sim.state` declares is laid out as a numpy record, attribute by
attribute, and numba compiles the classes' methods for such records. The physics is written only once. Where
an attribute may be of several classes (a law of hysteresis, a cause of transmission error) its record has
room for each, and says which one it is.

Bit for bit, because nothing is reordered or fused (no ``fastmath``), and because exp, sin and their like are
those of the C library that Python uses as well. What cannot be laid out (`Uncompilable`) runs in Python.
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple, get_args, get_origin, get_type_hints

import numba
import numpy as np
from numba.core import types
from numba.core.registry import cpu_target
from numba.core.typing.arraydecl import RecordAttribute
from numba.extending import overload, overload_method

from hdbridge.sim import ageing, encoder, gear, gear_pieces, hysteresis_laws
from hdbridge.sim.fast import FloatArray, IntArray
from hdbridge.sim.heat import Heat
from hdbridge.sim.loops import Loops, Seen, Slow
from hdbridge.sim.plant import Plant
from hdbridge.sim.state import STATES

LEAST_ROOM: Final = 16
"""Entries for which a list of numbers has room at least; each power of two is compiled apart."""


class Uncompilable(Exception):  # noqa: N818 - it is no failure: such an axis runs in Python
    """There is something in the loops that cannot be compiled."""


class Kinds(NamedTuple):
    """The classes that an attribute declared by what it does may be of."""

    classes: tuple[type, ...]
    room: int
    """How many of them a tuple has room for."""
    neutral: float
    """What an empty place in such a tuple gives."""


KINDS: Final[dict[Any, Kinds]] = {
    hysteresis_laws.Law: Kinds(
        (
            hysteresis_laws.RollingFrictionLaw,
            hysteresis_laws.MaxwellSlipLaw,
            hysteresis_laws.BoucWenLaw,
            hysteresis_laws.DahlLaw,
        ),
        1,
        0.0,
    ),
    gear.Piece: Kinds(
        (
            gear.MotorOrders,
            gear.VaryingOrders,
            gear.LoadOrders,
            gear.ElasticHysteresis,
            gear.VaryingHysteresis,
            gear.ZeroDrift,
            gear.SlowZeroDrift,
            gear_pieces.Wear,
            ageing.WornTeeth,
            gear_pieces.Creep,
            gear_pieces.Jumps,
            gear_pieces.Damage,
            gear_pieces.Roller,
        ),
        13,
        0.0,
    ),
    gear.Factor: Kinds(
        (gear_pieces.SpeedFactor, gear_pieces.TorqueFactor, gear_pieces.WarmthFactor, ageing.AgeFactor),
        4,
        1.0,
    ),
    encoder.ReadingError: Kinds((encoder.Cable, encoder.SensorWarming), 2, 0.0),
}
_NUMBERS: Final = {float: "f8", int: "i8", bool: "?", complex: "c16"}


class CompiledLoops:
    """The state of some `Loops` as one record, and the compiled methods on it; to be used like them."""

    def __init__(self, loops: Loops) -> None:
        """Raises `Uncompilable`."""
        if getattr(numba.config, "USING_SVML", False):
            raise Uncompilable("numba would take sine and exponential from Intel's library")
        plant: Any = type(loops.plant)
        self._record = np.zeros(1, _layout_of(plant, _room(loops)))
        _fill(self._record[0], loops)
        self._methods = _methods()

    def power_on(self, slow: Slow) -> float:
        """See `Loops`."""
        return self._methods.power_on(self._record, slow)

    def begin_demand(self, demand_deg: float) -> None:
        """See `Loops`."""
        self._methods.begin_demand(self._record, demand_deg)

    def hold(self, torque_nm: float) -> None:
        """See `Loops`."""
        self._methods.hold(self._record, torque_nm)

    def follow(self, demand_deg: float, demand_deg_s: float, substeps: int, slow: Slow) -> Seen:
        """See `Loops`."""
        return self._methods.follow(self._record, demand_deg, demand_deg_s, substeps, slow)

    def follow_all(
        self,
        demand_deg: FloatArray,
        demand_deg_s: FloatArray,
        substeps: IntArray,
        heat: Heat,
        limit_nm: float,
        outer_nm: FloatArray,
        held_nm: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Closed loop over many cycles: for each what `Loops.follow` says, and the temperature after it.

        ``heat`` is led through them; ``outer_nm`` is the torque on the load from outside in each,
        ``held_nm`` the one by which the loops hold the axis before it, or NaN.
        """
        seen, body_c = np.empty((len(substeps), 11)), np.empty(len(substeps))
        record = np.zeros(1, _layout_of(Plant, LEAST_ROOM, Heat))
        _fill(record[0], heat)
        self._methods.follow_all(
            self._record,
            record,
            demand_deg,
            demand_deg_s,
            substeps,
            limit_nm,
            outer_nm,
            held_nm,
            seen,
            body_c,
        )
        for name, hint in _attributes(Heat).items():
            if hint in _NUMBERS:
                setattr(heat, name, hint(record[0][name]))
        return seen, body_c

    def coast(self, brake_nm: float, substeps: int, slow: Slow) -> Seen:
        """See `Loops`."""
        return self._methods.coast(self._record, brake_nm, substeps, slow)


class _Methods(NamedTuple):
    power_on: Callable[..., float]
    begin_demand: Callable[..., None]
    hold: Callable[..., None]
    follow: Callable[..., Seen]
    follow_all: Callable[..., None]
    coast: Callable[..., Seen]


@cache
def _methods() -> _Methods:
    """The compiled methods; kept on disk by numba, for the sources as they are now."""
    _register()
    version = _version()

    def power_on(loops: Any, slow: Any) -> Any:
        assert version  # numba's file is of this version
        return loops[0].power_on(slow)

    def begin_demand(loops: Any, demand_deg: float) -> None:
        assert version
        loops[0].begin_demand(demand_deg)

    def hold(loops: Any, torque_nm: float) -> None:
        assert version
        loops[0].hold(torque_nm)

    def follow(loops: Any, demand_deg: float, demand_deg_s: float, substeps: int, slow: Any) -> Any:
        assert version
        return loops[0].follow(demand_deg, demand_deg_s, substeps, slow)

    def follow_all(
        loops: Any,
        heat: Any,
        demand_deg: Any,
        demand_deg_s: Any,
        substeps: Any,
        limit_nm: float,
        outer_nm: Any,
        held_nm: Any,
        seen: Any,
        body_c: Any,
    ) -> None:
        assert version
        dt_s = loops[0].dt_s
        for cycle in range(len(substeps)):
            if not math.isnan(held_nm[cycle]):
                loops[0].hold(held_nm[cycle])
            slow = (heat[0].body_c, heat[0].rub, limit_nm, 0.0, outer_nm[cycle])
            told = loops[0].follow(demand_deg[cycle], demand_deg_s[cycle], substeps[cycle], slow)
            for place in range(11):
                seen[cycle, place] = told[place]
            heat[0].warm(told[9], told[10], substeps[cycle] * dt_s)
            body_c[cycle] = heat[0].body_c

    def coast(loops: Any, brake_nm: float, substeps: int, slow: Any) -> Any:
        assert version
        return loops[0].coast(brake_nm, substeps, slow)

    compiled = numba.njit(cache=True, fastmath=False)
    return _Methods(*(compiled(each) for each in (power_on, begin_demand, hold, follow, follow_all, coast)))


def _version() -> int:
    """A number made of the sources of all that is compiled: numba itself looks at one file only."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return 1 + int.from_bytes(digest.digest()[:6])


# ---------------------------------------------------------------- records


def _attributes(cls: type) -> dict[str, Any]:
    """The declared attributes of a state class, its ancestors' included."""
    if cls not in _ATTRIBUTES:
        hints = get_type_hints(cls)
        _ATTRIBUTES[cls] = {name: hint for name, hint in hints.items() if get_origin(hint) is not ClassVar}
    return _ATTRIBUTES[cls]


_ATTRIBUTES: Final[dict[type, dict[str, Any]]] = {}
"""`_attributes`, which take long to find out."""


def _room(value: Any) -> int:
    """The power of two that has room for the longest list of numbers in an object."""
    longest = LEAST_ROOM
    for name in _attributes(type(value)):
        each = getattr(value, name)
        if isinstance(each, tuple | list) and all(isinstance(entry, complex | float) for entry in each):
            longest = max(longest, len(each))
        elif isinstance(each, tuple):
            longest = max([longest, *map(_room, each)])
        elif not isinstance(each, float | int):
            longest = max(longest, _room(each))
    return 1 << (longest - 1).bit_length()


@cache
def _layout_of(plant: Any, room: int, whole: type = Loops) -> Any:
    """The numpy type of a class, the `Loops` with this plant. One object for all: numba finds it at once."""

    def layout(declared: Any) -> Any:
        if declared in _NUMBERS:
            return np.dtype(_NUMBERS[declared])
        if get_origin(declared) in {tuple, list}:
            entry = get_args(declared)[0]
            return np.dtype((layout(entry), (KINDS[entry].room if entry in KINDS else room,)))
        if declared in KINDS:
            members = [(cls.__name__, layout(cls)) for cls in KINDS[declared].classes]
            union = np.dtype([("kind", np.dtype("i8")), *members], align=True)
            _UNIONS[numba.from_dtype(union)] = declared
            return union
        cls = plant if declared is Plant else declared
        mark = (f"is_{cls.__name__}", np.dtype("u1"))  # no two classes look alike
        record = np.dtype([mark, *((n, layout(each)) for n, each in _attributes(cls).items())], align=True)
        _CLASSES[numba.from_dtype(record)] = cls
        return record

    return layout(whole)


def _fill(record: Any, value: Any) -> None:
    """Write an object's attributes to its record."""
    for name, hint in _attributes(type(value)).items():
        each = getattr(value, name)
        if hint in KINDS:
            _fill_union(record[name], hint, each)
        elif get_origin(hint) in {tuple, list} and get_args(hint)[0] in KINDS:
            if len(each) > len(record[name]):
                raise Uncompilable(f"{len(each)} of {name}")
            for place, entry in zip(record[name], each, strict=False):
                _fill_union(place, get_args(hint)[0], entry)
        elif hint == tuple[complex, ...]:
            record[name][len(record[name]) - len(each) :] = each  # Horner's rule: nothing comes first
        elif get_origin(hint) in {tuple, list}:
            record[name][: len(each)] = each
        elif hint in _NUMBERS:
            record[name] = each
        else:
            _fill(record[name], each)


def _fill_union(record: Any, protocol: Any, value: Any) -> None:
    classes = KINDS[protocol].classes
    if type(value) not in classes:
        raise Uncompilable(type(value).__name__)
    record["kind"] = 1 + classes.index(type(value))
    _fill(record[type(value).__name__], value)


# ---------------------------------------------------------------- methods


_CLASSES: Final[dict[Any, type]] = {}
"""By numba's type of a record the class that it is of."""
_UNIONS: Final[dict[Any, Any]] = {}
"""By numba's type of a record the protocol that it is one of the classes of."""


def _register() -> None:
    """Tell numba the methods of all classes, and what to call the code that it makes of them."""
    types.Record.mangling_args = property(_name_in_code)  # type: ignore[method-assign, assignment]
    declared = {name for cls in STATES for name in _attributes(cls)}
    for cls in STATES:
        for name, method in inspect.getmembers(cls, inspect.isfunction):
            parameters = tuple(inspect.signature(method).parameters)
            if name.startswith("__"):
                continue
            if name not in _KNOWN:
                _KNOWN[name] = len(parameters)
                extend = overload_method(types.Record, name, strict=False)  # type: ignore[call-arg]
                extend(_chooser(name, parameters))
            # numba tells what a record has apart by the name alone.
            if _KNOWN[name] != len(parameters) or name in declared:
                raise TypeError(f"{cls.__name__}.{name}: another class has it otherwise; rename one")
    # What numba has for the attributes of records comes last: it takes each name for one of theirs.
    context = cpu_target.typing_context
    context.refresh()
    context._attributes[types.Record].sort(key=lambda each: isinstance(each, RecordAttribute))


def _name_in_code(record: types.Record) -> tuple[str, tuple[str]]:
    """What a record is called in the names of compiled functions: by what is in it.

    numba itself counts the types of each process. Two layouts that were compiled by two processes then have
    the same name, and a process that loads both from disk runs the code of one on the data of the other.
    """
    return "Record", (hashlib.sha256(record.name.encode()).hexdigest()[:32],)


_KNOWN: Final[dict[str, int]] = {}
"""Methods that numba knows, with the number of their parameters."""


def _chooser(name: str, parameters: tuple[str, ...]) -> Any:
    """What numba asks for the method of a record."""

    def choose(record: Any) -> Any:
        if record in _UNIONS:
            return _dispatch(_UNIONS[record], name)
        return getattr(_CLASSES.get(record), name, None)

    return _function(
        f"choose_{name}",
        parameters,
        [f"return choose({parameters[0]})"],
        {"choose": choose},
    )


def _function(name: str, parameters: Iterable[str], lines: Iterable[str], scope: dict[str, Any]) -> Any:
    """A function of these parameters and lines: numba looks at both."""
    exec("\n    ".join([f"def {name}({', '.join(parameters)}):", *lines]), scope)
    return scope[name]


@cache
def _dispatch(protocol: Any, name: str) -> Any:
    """The method of a record that may be one of several classes."""
    kinds = KINDS[protocol]
    lines = [
        f"if self.kind == {kind}: return self.{cls.__name__}.{name}(argument)"
        for kind, cls in enumerate(kinds.classes, start=1)
    ]
    return _function(name, ("self", "argument"), [*lines, f"return {kinds.neutral}"], {})


_remainder = types.ExternalFunction("remainder", types.float64(types.float64, types.float64))


@overload(math.remainder, strict=False)
def _remainder_of_the_c_library(x: Any, y: Any) -> Any:
    if isinstance(x, types.Float) and isinstance(y, types.Float):
        return lambda x, y: _remainder(x, y)  # noqa: PLW0108 - numba looks at its code
    return None
