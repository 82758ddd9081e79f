"""Steps of checks, for the tables.

A function with parameters returns a step. Its docstring states what the step does, or requires of the node.
"""

from collections.abc import Callable

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.tester import NodeTester, Step
from hdbridge.drive.states import State


def reset_node(t: NodeTester) -> None:
    """Resets the node."""
    t.reset(NmtCommand.RESET_NODE)


def sends_nmt(command: NmtCommand) -> Step:
    """Sends an NMT command."""
    return lambda t: t.nmt(command)


def aborts(request: bytes, codes: tuple[int, ...], what: str = "request") -> Step:
    """An SDO request is refused with one of the abort codes."""
    return lambda t: t.aborts(request, codes, what)


def refuses(index: int, sub: int, data: bytes, codes: tuple[int, ...]) -> Step:
    """A value is refused with one of the abort codes, and not stored."""
    return lambda t: t.refuses_value(index, sub, data, codes)


def holds(index: int, sub: int, expected: int, digits: int = 0) -> Step:
    """An object has this value. Only the last ``digits`` hexadecimal digits are compared; 0 compares all."""

    def step(t: NodeTester) -> None:
        found = t.read(index, sub)
        if digits:
            found_h, expected_h = (
                f"{each & (1 << 4 * digits) - 1:0{digits}X}h" for each in (found, expected)
            )
            t.equal(found_h, expected_h, _name(index, sub))
        else:
            t.equal(found, expected, _name(index, sub))

    return step


def reads(index: int, sub: int, right: Callable[[int], object], expected: str) -> Step:
    """The value of an object is right; ``expected`` describes the right values."""

    def step(t: NodeTester) -> None:
        found = t.read(index, sub)
        t.true(right(found), f"{_name(index, sub)} = {found}", expected)

    return step


def has_bits(index: int, mask: int, expected: int, what: str) -> Step:
    """An object has these values of the bits in a mask."""
    return lambda t: t.equal(t.read(index) & mask, expected, what)


def writes(index: int, sub: int, value: int, size: int) -> Step:
    """The node accepts a value, which is replaced by the previous one at the end of the check."""
    return lambda t: t.write(index, sub, value, size)


def puts(index: int, sub: int, value: int, size: int) -> Step:
    """The node accepts a value, which it keeps."""
    return lambda t: t.put(index, sub, value, size)


def no_emergency(duration_s: float, act: Step = lambda _: None) -> Step:
    """The node sends no EMCY message during ``act`` and for a duration after it."""
    return lambda t: t.equal(t.emergencies_after(duration_s, lambda: act(t)), [], "EMCY codes")


def control(word: int) -> Step:
    """Writes the controlword."""
    return lambda t: t.control(word)


def reaches(*states: State) -> Step:
    """The drive reaches one of these power states."""
    return lambda t: t.reaches(*states)


def stays(state: State, duration_s: float = 0.05) -> Step:
    """The drive is in a power state throughout a duration."""
    return lambda t: t.stays(state, duration_s)


def waits(duration_s: float) -> Step:
    """Waits."""
    return lambda t: t.wait(duration_s)


def _name(index: int, sub: int) -> str:
    return f"{index:04X}h:{sub:02X}" if sub else f"{index:04X}h"
