"""Classes for the state of the simulation, each attribute declared with its type.

Declared attributes can be laid out in memory, so that the methods can be compiled (`hdbridge.sim.compiled`).
They are numbers, tuples and lists of numbers, and further objects of such classes.
"""

from dataclasses import dataclass
from typing import Final, TypeVar

T = TypeVar("T")

STATES: Final[list[type]] = []
"""All state classes."""


def state(cls: type[T]) -> type[T]:
    """Gives a class a slot for each declared attribute; the class writes its own ``__init__``."""
    made = dataclass(init=False, repr=False, eq=False, slots=True)(cls)
    STATES.append(made)
    return made
