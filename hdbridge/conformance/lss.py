"""Checks of the layer setting services: selection, identity, node id, bit timing, fast scan.

Only the node with the identity in 1018h is selected, so no other node on the bus executes a command.
"""

import struct
from collections.abc import Callable
from functools import partial
from typing import Final

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.tester import NodeTester, NotApplicableError, Table, upload_request

CHECKS: Final = Table()
_REQUEST, _ANSWER = 0x7E5, 0x7E4
_WAITING: Final = b"\x04".ljust(8, b"\0")
"""Request that switches all nodes to the waiting state."""
_NO_NODE_ID: Final = 255
_PARTS: Final = ("vendor", "product", "revision", "serial")
_Function = Callable[[NodeTester, list[int]], None]


def _ask(t: NodeTester, command: int, *values: int, number: int | None = None) -> bytes | None:
    """Sends a request with ``values`` as its data bytes, after a 32-bit ``number`` if given; returns the
    answer or None.
    """
    data = bytes(values) if number is None else struct.pack("<I", number) + bytes(values)
    return t.reply(_ANSWER, lambda: t.send(_REQUEST, (bytes((command,)) + data).ljust(8, b"\0")))


def _select(t: NodeTester, identity: list[int]) -> bytes | None:
    for part in range(3):
        t.send(_REQUEST, struct.pack("<BI3x", 0x40 + part, identity[part]))
    return _ask(t, 0x43, number=identity[3])


def _answered(t: NodeTester, answer: bytes | None, command: int, *values: int) -> None:
    """Fails unless the answer consists of ``command`` and ``values``."""
    found = None if answer is None else answer[: 1 + len(values)]
    t.equal("no answer" if found is None else found, bytes((command, *values)))


def _check(name: str, text: str, *, stores: bool = False) -> Callable[[_Function], None]:
    """Decorates the function of a check, which begins in LSS configuration state and ends in LSS waiting
    state.
    """

    def add(function: _Function) -> None:
        @CHECKS.check(f"lss.{name}", text, "CiA 305", stores=stores)
        def _(t: NodeTester) -> None:
            for sub in range(1, 5):
                t.require(0x1018, sub)
            identity = [t.read(0x1018, sub) for sub in range(1, 5)]
            t.need(_select(t, identity), "no answer to LSS switch state selective: the node has no LSS")
            try:
                function(t, identity)
            finally:
                t.send(_REQUEST, _WAITING)

    return add


def _set_node_id(t: NodeTester, identity: list[int], node_id: int) -> None:
    """Sets the node id that becomes valid at the next reset of the communication."""
    _select(t, identity)
    _answered(t, _ask(t, 0x11, node_id), 0x11, 0)


def _restore_node_id(t: NodeTester, identity: list[int], now: int) -> None:
    """Restores the node's own node id. All requests are sent before the first wait, so an interruption by the
    user cannot prevent them.
    """
    requests = [struct.pack("<BI3x", 0x40 + part, number) for part, number in enumerate(identity)]
    since = len(t.log)
    for request in (_WAITING, *requests, bytes((0x11, t.node_id)).ljust(8, b"\0"), _WAITING):
        t.send(_REQUEST, request)
    if now != _NO_NODE_ID:
        t.nmt(NmtCommand.RESET_COMMUNICATION, now)
    t.boot_up(since)
    t.answers(t.timing.boot_s)


@_check("select", "The node is selected by the four numbers in 1018h")
def _(t: NodeTester, identity: list[int]) -> None:
    t.send(_REQUEST, _WAITING)
    _answered(t, _select(t, identity), 0x44)


@_check("waiting", "In waiting state no inquiry is answered")
def _(t: NodeTester, _: list[int]) -> None:
    t.send(_REQUEST, _WAITING)
    t.equal(_ask(t, 0x5E), None, "answer")


def _of_part(place: int, part: str) -> None:
    @_check(f"select.{part}", f"Another {part} number does not select the node")
    def _(t: NodeTester, identity: list[int]) -> None:
        t.send(_REQUEST, _WAITING)
        identity[place] ^= 1
        t.equal(_select(t, identity), None, "answer")
        t.equal(_ask(t, 0x5E), None, "answer of a node that is not selected")

    @_check(f"inquire.{part}", f"The inquired {part} number is that of 1018h")
    def _(t: NodeTester, identity: list[int]) -> None:
        _answered(t, _ask(t, 0x5A + place), 0x5A + place, *struct.pack("<I", identity[place]))


for _place, _part in enumerate(_PARTS):
    _of_part(_place, _part)


@_check("inquire.node-id", "The inquired node id is the one in use")
def _(t: NodeTester, _: list[int]) -> None:
    _answered(t, _ask(t, 0x5E), 0x5E, t.node_id)


@_check("identify", "A range of identities that contains the node's is answered, another one is not")
def _(t: NodeTester, identity: list[int]) -> None:
    vendor, product, revision, serial = identity
    for low, high, found in ((serial, serial, b"\x4f"), (serial ^ 1, serial ^ 1, None)):
        for command, number in enumerate((vendor, product, revision, revision, low), start=0x46):
            t.send(_REQUEST, struct.pack("<BI3x", command, number))
        answer = _ask(t, 0x4B, number=high)
        t.equal(answer and answer[:1], found, "answer")


@_check("short", "A request of fewer than eight bytes is ignored")
def _(t: NodeTester, _: list[int]) -> None:
    t.equal(t.reply(_ANSWER, lambda: t.send(_REQUEST, b"\x5e")), None, "answer")


@_check("node-id.range", "Node ids 0 and 128 are refused with error 1")
def _(t: NodeTester, _: list[int]) -> None:
    for value in (0, 128):
        _answered(t, _ask(t, 0x11, value), 0x11, 1)


@_check("node-id.pending", "A new node id waits for a reset of the communication")
def _(t: NodeTester, identity: list[int]) -> None:
    _set_node_id(t, identity, _free_node_id(t))
    try:
        t.true(t.ask(upload_request(0x1000)), "no SDO answer", "one at the node id in use")
    finally:
        _restore_node_id(t, identity, t.node_id)


@_check("node-id.used", "After a reset of the communication the node boots with its new node id")
def _(t: NodeTester, identity: list[int]) -> None:
    other = _free_node_id(t)
    _set_node_id(t, identity, other)
    try:
        boot = t.reply(0x700 + other, lambda: t.nmt(NmtCommand.RESET_COMMUNICATION), t.timing.boot_s)
        t.true(boot, "no boot-up message", f"one of node {other}")
    finally:
        _restore_node_id(t, identity, other)


@_check("fast-scan", "Without a node id the node is silent until a fast scan finds it")
def _(t: NodeTester, identity: list[int]) -> None:
    _set_node_id(t, identity, _NO_NODE_ID)
    try:
        boot = t.reply(0x700 + t.node_id, lambda: t.nmt(NmtCommand.RESET_COMMUNICATION))
        t.equal(boot, None, "boot-up message")
        t.send(_REQUEST, _WAITING)
        _answered(t, _ask(t, 0x4C), 0x50)
        _answered(t, _ask(t, 0x51, 0x80, 0, 0, number=0), 0x4F)
        for part, number in enumerate(identity):
            t.equal(_ask(t, 0x51, 31, part, part, number=number ^ 1 << 31), None, "answer to another number")
            _answered(t, _ask(t, 0x51, 0, part, (part + 1) % 4, number=number), 0x4F)
        _answered(t, _ask(t, 0x5E), 0x5E, _NO_NODE_ID)
    finally:
        _restore_node_id(t, identity, _NO_NODE_ID)


@_check("fast-scan.configured", "A node with a node id does not answer a fast scan")
def _(t: NodeTester, _: list[int]) -> None:
    t.send(_REQUEST, _WAITING)
    t.equal(_ask(t, 0x4C), None, "answer to identify non-configured")
    t.equal(_ask(t, 0x51, 0x80, 0, 0, number=0), None, "answer to a fast scan")


@_check("bit-timing.reserved", "A reserved bit timing is refused with error 1")
def _(t: NodeTester, _: list[int]) -> None:
    _answered(t, _ask(t, 0x13, 0, 200), 0x13, 1)


@_check("store", "Storing is carried out, or refused with error 1", stores=True)
def _(t: NodeTester, _: list[int]) -> None:
    answer = _ask(t, 0x17)
    t.true(answer is not None and answer[:2] in (b"\x17\0", b"\x17\1"), answer, "17h with error 0 or 1")


def _free_node_id(t: NodeTester) -> int:
    """Returns a node id to which no node on the bus responds."""
    for node_id in (each for each in range(127, 0, -1) if each != t.node_id):
        if t.reply(0x580 + node_id, partial(t.send, 0x600 + node_id, upload_request(0x1000))) is None:
            return node_id
    raise NotApplicableError("every node id is in use")
