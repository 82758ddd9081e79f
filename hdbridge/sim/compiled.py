"""Axis compiled to machine code from the Python classes, with identical results.

An object of the classes marked by `hdbridge.sim.state` is laid out as a numpy record, attribute by
attribute, and numba compiles the classes' methods for such records. The physics is therefore written only
once. If an attribute may belong to one of several classes (a hysteresis law, a cause of transmission error),
its record has space for each of these classes, and a field for the actual class.

Results are identical bit for bit, because nothing is reordered or fused (no ``fastmath``), and exp, sin and
similar functions are those of the C library that Python uses. An axis that cannot be laid out
(`Uncompilable`) runs in Python.
"""

from __future__ import annotations

import ast
import copy
import hashlib
import inspect
import math
import sys
import threading
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args, get_origin, get_type_hints

import numba
import numpy as np
from numba.core import types
from numba.core.registry import cpu_target
from numba.core.typing.arraydecl import RecordAttribute
from numba.extending import overload, overload_method

from hdbridge.sim import encoder, gear, gear_pieces, hysteresis_laws
from hdbridge.sim.axis import Axis, Measured
from hdbridge.sim.fast import FloatArray, IntArray
from hdbridge.sim.plant import Plant
from hdbridge.sim.state import STATES

LEAST_ROOM: Final = 16
"""Minimum capacity of a list of numbers; each power of two is compiled separately."""


class Uncompilable(Exception):  # noqa: N818 - not a failure: such an axis runs in Python
    """Raised if a part of the axis cannot be compiled."""


class Kinds(NamedTuple):
    """Possible classes of an attribute that is declared by its protocol."""

    classes: tuple[type, ...]
    room: int
    """Maximum length of a tuple of attributes with this protocol."""
    neutral: float
    """Value that an unused element of such a tuple returns."""


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
            gear.LoadOrders,
            gear.ElasticHysteresis,
            gear.ZeroDrift,
            gear.SlowZeroDrift,
            gear_pieces.Wear,
            gear_pieces.WornTeeth,
            gear_pieces.Creep,
            gear_pieces.Jumps,
            gear_pieces.Damage,
            gear_pieces.Roller,
        ),
        11,
        0.0,
    ),
    gear.Factor: Kinds(
        (gear_pieces.SpeedFactor, gear_pieces.WarmthFactor, gear_pieces.AgeFactor),
        4,
        1.0,
    ),
    encoder.ReadingError: Kinds((encoder.Cable, encoder.SensorWarming), 2, 0.0),
}
_registering: Final = threading.Lock()
_NUMBERS: Final = {float: "f8", int: "i8", bool: "?", complex: "c16"}


class CompiledAxis:
    """State of an `Axis` as one record, with compiled methods and the interface of `Axis`."""

    def __init__(self, axis: Axis) -> None:
        """Lays out the axis; raises `Uncompilable` if that is not possible."""
        if getattr(numba.config, "USING_SVML", False):
            raise Uncompilable("numba would take sine and exponential from Intel's library")
        plant: Any = type(axis.plant)
        room = _room(axis)
        self._record = np.zeros(1, _layout_of(plant, room))
        _fill(self._record[0], axis)
        self._entry_point = partial(_entry_point, plant, room)
        self._drive = self._entry_point("drive")

    def __deepcopy__(self, _: Any) -> CompiledAxis:
        other = copy.copy(self)
        other._record = self._record.view(np.uint8).copy().view(self._record.dtype)  # in one piece: faster
        return other

    def drive(self, *inputs: float) -> Measured:
        measured: Measured = self._drive(self._record, *inputs)
        return measured

    def drive_all(
        self,
        counts: FloatArray,
        substeps: IntArray,
        limit_nm: float,
        noise_deg: FloatArray,
        outer_nm: FloatArray,
        held_nm: FloatArray,
        readings: FloatArray,
    ) -> Measured:
        """Runs `Axis.drive` over many cycles, each from the previous demand, after `hold` with ``held_nm``.

        ``readings`` receives the first six values of each cycle (`machine.Cycles`).
        """
        last: Measured = _methods()["drive_all"](
            self._record, counts, substeps, limit_nm, noise_deg, outer_nm, held_nm, readings
        )
        return last

    def roll(self, *inputs: float) -> Measured:
        measured: Measured = self._entry_point("roll")(self._record, *inputs)
        return measured

    def hold(self, torque_nm: float) -> None:
        self._entry_point("hold")(self._record, torque_nm)


@cache
def _entry_point(plant: Any, room: int, name: str) -> Callable[..., Any]:
    """Returns a compiled method of an `Axis` with this plant.

    The method converts its arguments to the declared types. Numba's dispatcher would check the types in each
    call, and compile again for whole numbers.
    """
    *hints, _ = get_type_hints(getattr(Axis, name)).values()
    numbers = [types.float64 if hint is float else types.int64 for hint in hints]
    axis = types.Array(numba.from_dtype(_layout_of(plant, room)), 1, "C")
    entry_point: Callable[..., Any] = _methods()[name].compile((axis, *numbers))
    return entry_point


@cache
def _methods() -> dict[str, Any]:
    """Returns numba's dispatchers of the methods, cached on disk for the current source code."""
    with _registering:
        _register()
    version = _version()

    def drive(
        axis: Any,
        start_counts: float,
        end_counts: float,
        substeps: int,
        limit_nm: float,
        noise_deg: float,
        outer_nm: float,
    ) -> Any:
        assert version  # ties numba's cache file to this version
        return axis[0].drive(start_counts, end_counts, substeps, limit_nm, noise_deg, outer_nm)

    def drive_all(
        axis: Any,
        counts: Any,
        substeps: Any,
        limit_nm: float,
        noise_deg: Any,
        outer_nm: Any,
        held_nm: Any,
        readings: Any,
    ) -> Any:
        assert version
        now = axis[0].at_first()
        for cycle in range(len(substeps)):
            if not math.isnan(held_nm[cycle]):
                axis[0].hold(held_nm[cycle])
            start, end, count = counts[cycle], counts[cycle + 1], substeps[cycle]
            now = axis[0].drive(start, end, count, limit_nm, noise_deg[cycle], outer_nm[cycle])
            readings[cycle, 0], readings[cycle, 1], readings[cycle, 2] = now[0], now[1], now[2]
            readings[cycle, 3], readings[cycle, 4], readings[cycle, 5] = now[3], now[4], now[5]
        return now

    def roll(
        axis: Any, brake_nm: float, substeps: int, limit_nm: float, noise_deg: float, outer_nm: float
    ) -> Any:
        assert version
        return axis[0].roll(brake_nm, substeps, limit_nm, noise_deg, outer_nm)

    def hold(axis: Any, torque_nm: float) -> None:
        assert version
        axis[0].hold(torque_nm)

    compiled = numba.njit(cache=True, fastmath=False, nogil=True)
    return {each.__name__: compiled(each) for each in (drive, drive_all, roll, hold)}


def _version() -> int:
    """Returns a hash of the sources of all compiled code; numba itself checks only one file."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return 1 + int.from_bytes(digest.digest()[:6])


# ---------------------------------------------------------------- records


@cache
def _attributes(cls: Any) -> dict[str, Any]:
    """Returns the attributes of a state class and its ancestors, with their types.

    The type of an attribute is that of its annotation, else that of a constant or a constructor call that is
    assigned to it, else ``float``.
    """
    found: dict[str, Any] = {}
    for each in reversed(cls.__mro__):
        if each in STATES:
            found |= _assigned(each.__module__)[each.__name__]
    return found | {name: hint for name, hint in get_type_hints(cls).items() if name in found}


@cache
def _assigned(module: str) -> dict[str, dict[str, Any]]:
    """Returns the attributes that the methods of each class of a module assign, with their types."""
    tree, scope = ast.parse(inspect.getsource(sys.modules[module])), vars(sys.modules[module])
    found: dict[str, dict[str, Any]] = {}
    for cls in (each for each in tree.body if isinstance(each, ast.ClassDef)):
        own = found[cls.name] = dict.fromkeys(_stored(cls), float)
        for each in ast.walk(cls):
            if isinstance(each, ast.AnnAssign):
                own |= dict.fromkeys(_stored(each.target), eval(ast.unparse(each.annotation), scope))
            elif isinstance(each, ast.Assign) and (kind := _type_of(each.value, scope)) is not None:
                own |= dict.fromkeys(_stored(*each.targets), kind)
    return found


def _stored(*nodes: ast.AST) -> list[str]:
    """Returns the attributes of ``self`` that are assigned in these nodes."""
    every = [each for node in nodes for each in ast.walk(node) if isinstance(each, ast.Attribute)]
    stored = [each for each in every if isinstance(each.ctx, ast.Store)]
    return [each.attr for each in stored if ast.unparse(each.value) == "self"]


def _type_of(value: ast.expr, scope: dict[str, Any]) -> Any:
    """Returns the type of a constant, or the state class or type of numbers that is called; else None."""
    if isinstance(value, ast.Constant):
        return type(value.value)
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name):
        called = eval(value.func.id, scope)
        return called if called in STATES or called in (float, int, bool) else None
    return None


class Members(NamedTuple):
    """Attributes of a state class, by their form in the record."""

    numbers: tuple[str, ...]
    lists: tuple[str, ...]
    """Tuples and lists of numbers."""
    objects: tuple[str, ...]
    unions: tuple[tuple[str, Any], ...]
    """Attributes that may belong to one of several classes, with their protocol."""
    union_lists: tuple[tuple[str, Any], ...]


@cache
def _members(cls: Any) -> Members:
    found: dict[str, Any] = Members((), (), (), (), ())._asdict()
    for name, hint in _attributes(cls).items():
        several = get_origin(hint) in {tuple, list}
        entry = get_args(hint)[0] if several else hint
        if entry in KINDS:
            found["union_lists" if several else "unions"] += ((name, entry),)
        elif several:
            found["lists"] += (name,)
        else:
            found["numbers" if entry in _NUMBERS else "objects"] += (name,)
    return Members(**found)


def _room(value: Any) -> int:
    """Returns the smallest power of two that holds the longest list of numbers in an object."""
    members, longest = _members(value.__class__), LEAST_ROOM
    for name in members.lists:
        longest = max(longest, len(getattr(value, name)))
    for name in (*members.objects, *(name for name, _ in members.unions)):
        longest = max(longest, _room(getattr(value, name)))
    for name, _ in members.union_lists:
        longest = max([longest, *map(_room, getattr(value, name))])
    return 1 << (longest - 1).bit_length()


@cache
def _layout_of(plant: Any, room: int) -> Any:
    """Returns the numpy type of an `Axis` with this plant, as one object that numba recognises quickly."""

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
        mark = (f"is_{cls.__name__}", np.dtype("u1"))  # makes the layout of each class unique
        record = np.dtype([mark, *((n, layout(each)) for n, each in _attributes(cls).items())], align=True)
        _CLASSES[numba.from_dtype(record)] = cls
        return record

    return layout(Axis)


def _fill(record: Any, value: Any) -> None:
    """Writes an object's attributes to its record."""
    members = _members(value.__class__)
    for name in members.numbers:
        record[name] = getattr(value, name)
    for name in members.lists:
        each = getattr(value, name)
        record[name][: len(each)] = each
    for name in members.objects:
        _fill(record[name], getattr(value, name))
    for name, protocol in members.unions:
        _fill_union(record[name], protocol, getattr(value, name))
    for name, protocol in members.union_lists:
        each = getattr(value, name)
        if len(each) > len(record[name]):
            raise Uncompilable(f"{len(each)} of {name}")
        for place, entry in zip(record[name], each, strict=False):
            _fill_union(place, protocol, entry)


def _fill_union(record: Any, protocol: Any, value: Any) -> None:
    classes = KINDS[protocol].classes
    if type(value) not in classes:
        raise Uncompilable(type(value).__name__)
    record["kind"] = 1 + classes.index(type(value))
    _fill(record[type(value).__name__], value)


# ---------------------------------------------------------------- methods


_CLASSES: Final[dict[Any, type]] = {}
"""State class of each numba record type."""
_UNIONS: Final[dict[Any, Any]] = {}
"""Protocol of each numba record type that can hold an object of one of several classes."""


@cache
def _register() -> None:
    """Registers the methods of all classes with numba, and unique names for the compiled code."""
    types.Record.mangling_args = property(_name_in_code)  # type: ignore[method-assign, assignment]
    # Each pass of numba's compiler prints types. Printing their names is much faster than their contents.
    types.Record.__repr__ = types.Type.__repr__  # type: ignore[method-assign]
    declared = {name for cls in STATES for name in _attributes(cls)}
    for cls in STATES:
        for name, method in inspect.getmembers(cls, inspect.isfunction):
            parameters = tuple(inspect.signature(method).parameters)
            if name.startswith("__"):
                continue
            if name not in _KNOWN:
                _KNOWN[name] = len(parameters)
                overload_method(types.Record, name, **_METHOD)(_chooser(name, parameters))
            # numba distinguishes the members of a record by name alone.
            if _KNOWN[name] != len(parameters) or name in declared:
                raise TypeError(f"{cls.__name__}.{name}: another class defines it differently; rename one")
    # Numba's own template for record attributes comes last, because it claims every name.
    context = cpu_target.typing_context
    context.refresh()
    context._attributes[types.Record].sort(key=lambda each: isinstance(each, RecordAttribute))


def _name_in_code(record: types.Record) -> tuple[str, tuple[str]]:
    """Returns the name of a record in compiled functions, derived from its contents.

    Numba itself numbers the types separately in each process. Two layouts compiled by two processes could
    then have the same name, and a process that loads both from disk would run the code of one on the data of
    the other.
    """
    return "Record", (hashlib.sha256(record.name.encode()).hexdigest()[:32],)


_METHOD: Final[dict[str, Any]] = {
    "strict": False,
    "jit_options": {"no_cpython_wrapper": True, "no_cfunc_wrapper": True},
}
"""Numba's options for methods called only by compiled code. They compile in an eighth of the time without
entry points for Python and C."""
_KNOWN: Final[dict[str, int]] = {}
"""Registered methods, with the number of their parameters."""


def _chooser(name: str, parameters: tuple[str, ...]) -> Any:
    """Returns the function by which numba finds the method of a record."""

    def choose(record: Any) -> Any:
        if record in _UNIONS:
            return _dispatch(_UNIONS[record], name)
        return getattr(_CLASSES.get(record), name, None)

    return _function(f"choose_{name}", parameters, [f"return choose({parameters[0]})"], {"choose": choose})


def _function(name: str, parameters: Iterable[str], lines: Iterable[str], scope: dict[str, Any]) -> Any:
    """Builds a function from parameters and lines; numba inspects both."""
    exec("\n    ".join([f"def {name}({', '.join(parameters)}):", *lines]), scope)
    return scope[name]


@cache
def _dispatch(protocol: Any, name: str) -> Any:
    """Returns the method of a record that may be one of several classes."""
    kinds = KINDS[protocol]
    lines = [
        f"if self.kind == {kind}: return self.{cls.__name__}.{name}(argument)"
        for kind, cls in enumerate(kinds.classes, start=1)
    ]
    return _function(name, ("self", "argument"), [*lines, f"return {kinds.neutral}"], {})


def _of_the_c_library(function: Any) -> None:
    """Makes numba call the C function that Python calls, because numba does not implement this function."""
    same = types.ExternalFunction(function.__name__, types.float64(types.float64, types.float64))

    @overload(function, strict=False)  # type: ignore[untyped-decorator]
    def _chosen(x: Any, y: Any) -> Any:
        floats = isinstance(x, types.Float) and isinstance(y, types.Float)
        return (lambda x, y: same(x, y)) if floats else None  # noqa: PLW0108 - numba inspects its code


_of_the_c_library(math.remainder)
_of_the_c_library(math.fmod)
