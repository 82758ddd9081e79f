"""LSS slave (CiA 305): selection by identity, node id, bit timing, fast scan.

It does no I/O and does not change the node id in use: a new node id is pending until the node resets its
communication, so no command of the LSS master disturbs an axis in operation.
"""

import struct
from collections.abc import Callable
from typing import Final

REQUEST: Final = 0x7E5
ANSWER: Final = 0x7E4
UNCONFIGURED: Final = 255
"""Node id of an unconfigured node, which answers only to LSS."""
BIT_RATES_BPS: Final = (1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000, 10_000)
"""Bit rates of the standard bit timing table (table 0 of CiA 305), by index."""
_NUMBER: Final = struct.Struct("<BI3x")
_FAST_SCAN: Final = struct.Struct("<BIBBB")
_RESTART_SCAN: Final = 0x80
_REFUSED: Final = 1
"""Error code of CiA 305: value out of range, bit timing or storing not supported."""
_SELECTED, _IDENTIFIED, _IDENTIFIED_WITHOUT_ID = 0x44, 0x4F, 0x50


class LssSlave:
    """LSS slave of one node."""

    def __init__(
        self, identity: Callable[[int], int], node_id: int, *, stores: bool, bit_rate_bps: int | None = None
    ) -> None:
        """``identity`` returns a sub-index of 1018h; ``stores`` states that a node id can be stored.

        ``bit_rate_bps`` is the only bit rate of the interface; None if unknown.
        """
        self.node_id = node_id
        self.pending = self.stored = node_id
        """Node id after the next reset of the communication, and after the next reset of the node."""
        self.configuring = False
        """True in LSS configuration state, False in LSS waiting state."""
        self._identity, self._stores, self._bit_rate_bps = identity, stores, bit_rate_bps
        self._next = self._scanned = 0
        """Next command expected in a sequence of identity requests that have all matched so far, else 0;
        index of the identity part that the fast scan is determining."""

    def respond(self, request: bytes) -> bytes | None:
        """Returns the answer to a request; None for a request that is not answered."""
        if len(request) != 8:
            return None
        command, number, *_ = _NUMBER.unpack(request)
        if command == 0x04:
            self.configuring = request[1] == 1
        elif 0x40 <= command <= 0x43:
            if not self.configuring and self._agrees(
                command, (0x40, 0x43), number == self._part(command - 0x40)
            ):
                self.configuring = True
                return _answer(_SELECTED)
        elif 0x46 <= command <= 0x4B:
            if self._agrees(command, (0x46, 0x4B), self._in_range(command, number)):
                return _answer(_IDENTIFIED)
        elif command == 0x4C and self.node_id == UNCONFIGURED:
            return _answer(_IDENTIFIED_WITHOUT_ID)
        elif command == 0x51 and self.node_id == self.pending == UNCONFIGURED and not self.configuring:
            return self._fast_scan(*_FAST_SCAN.unpack(request)[1:])
        elif self.configuring:
            return self._configure(command, request)
        return None

    def _part(self, place: int) -> int:
        return self._identity(place + 1)

    def _in_range(self, command: int, number: int) -> bool:
        """Returns True if the identity part of this request matches the node.

        Vendor and product code must be equal; revision and serial number must be within the given bound.
        """
        if command <= 0x47:
            return number == self._part(command - 0x46)
        own = self._part(2 + (command - 0x48) // 2)
        return number <= own if command % 2 == 0 else own <= number

    def _agrees(self, command: int, span: tuple[int, int], part_agrees: bool) -> bool:
        """Evaluates one request of an identity sequence; returns True once all have matched in order."""
        agrees = part_agrees and command in (span[0], self._next)
        self._next = command + 1 if agrees else 0
        return agrees and command == span[1]

    def _configure(self, command: int, request: bytes) -> bytes | None:
        value = request[1]
        if command == 0x11:
            known = 1 <= value <= 127 or value == UNCONFIGURED
            if known:
                self.pending = value
            return _answer(command, 0 if known else _REFUSED)
        if command == 0x13:
            index = request[2]
            rate = BIT_RATES_BPS[index] if value == 0 and index < len(BIT_RATES_BPS) else None
            known = rate is not None and rate == self._bit_rate_bps
            return _answer(command, 0 if known else _REFUSED)
        if command == 0x17:
            if self._stores:
                self.stored = self.pending
            return _answer(command, 0 if self.stored == self.pending else _REFUSED)
        if 0x5A <= command <= 0x5D:
            return _NUMBER.pack(command, self._part(command - 0x5A))
        if command == 0x5E:
            return _answer(command, self.node_id)
        return None  # 15h: the bit timing in use does not change

    def _fast_scan(self, number: int, bit: int, part: int, following: int) -> bytes | None:
        """Answers if ``number`` agrees with the scanned identity part in the bits from ``bit`` upwards."""
        if bit == _RESTART_SCAN:
            self._scanned = 0
        elif bit < 32 and part == self._scanned and part < 4 and following < 4:
            if number != self._part(part) >> bit << bit:
                return None
            self._scanned = following
            self.configuring = bit == 0 and following < part
        else:
            return None
        return _answer(_IDENTIFIED)


def _answer(*values: int) -> bytes:
    return bytes(values).ljust(8, b"\0")
