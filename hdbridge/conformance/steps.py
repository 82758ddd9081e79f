"""Steps of checks, for the tables.

A function decorated with `parametrised` returns a step. Its docstring states what the step requires of the
node.
"""

from collections.abc import Callable
from typing import Concatenate, ParamSpec

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.tester import NodeTester, Step

_Arguments = ParamSpec("_Arguments")


def parametrised(
    function: Callable[Concatenate[NodeTester, _Arguments], object],
) -> Callable[_Arguments, Step]:
    """Returns a function that binds all arguments but the tester; its result is a step."""

    def bound(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> Step:
        return lambda t: function(t, *args, **kwargs)

    return bound


aborts = parametrised(NodeTester.aborts)
control = parametrised(NodeTester.control)
puts = parametrised(NodeTester.put)
reaches = parametrised(NodeTester.reaches)
refuses = parametrised(NodeTester.refuses_value)
sends_nmt = parametrised(NodeTester.nmt)
stays = parametrised(NodeTester.stays)
waits = parametrised(NodeTester.wait)
writes = parametrised(NodeTester.write)
reset_node = parametrised(NodeTester.reset)(NmtCommand.RESET_NODE)


@parametrised
def holds(t: NodeTester, index: int, sub: int, expected: int, digits: int = 0) -> None:
    """An object has this value. Only the last ``digits`` hexadecimal digits are compared; 0 compares all."""
    found = t.read(index, sub)
    if digits:
        found_h, expected_h = (f"{each & (1 << 4 * digits) - 1:0{digits}X}h" for each in (found, expected))
        t.equal(found_h, expected_h, _name(index, sub))
    else:
        t.equal(found, expected, _name(index, sub))


@parametrised
def reads(t: NodeTester, index: int, sub: int, right: Callable[[int], object], expected: str) -> None:
    """The value of an object is right; ``expected`` describes the right values."""
    found = t.read(index, sub)
    t.true(right(found), f"{_name(index, sub)} = {found}", expected)


@parametrised
def has_bits(t: NodeTester, index: int, mask: int, expected: int, what: str) -> None:
    """An object has these values of the bits in a mask."""
    t.equal(t.read(index) & mask, expected, what)


@parametrised
def no_emergency(t: NodeTester, duration_s: float, act: Step = lambda _: None) -> None:
    """The node sends no EMCY message during ``act`` and for a duration after it."""
    t.equal(t.emergencies_after(duration_s, lambda: act(t)), [], "EMCY codes")


def _name(index: int, sub: int) -> str:
    return f"{index:04X}h:{sub:02X}" if sub else f"{index:04X}h"
