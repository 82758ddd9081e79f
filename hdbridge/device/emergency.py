"""Errors of the simulated drive: active errors, error register, history and EMCY messages."""

import struct
from collections.abc import Callable
from enum import IntEnum
from functools import partial
from typing import Final

from hdbridge.device.dictionary import Dictionary, only, refusing

HISTORY_DEPTH: Final = 8
_FRAME: Final = struct.Struct("<HB5s")
_DISABLED: Final = 1 << 31
_REGISTER_BITS: Final = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10, 0xF: 0x80}
"""Bits of 1001h by the leading digit of an error code."""


class ErrorCode(IntEnum):
    """Emergency error codes that the drive raises without fault injection (CiA 301, CiA 402)."""

    NONE = 0x0000
    COMMUNICATION = 0x8100
    HEARTBEAT = 0x8130
    PDO_TOO_SHORT = 0x8210
    PDO_TOO_LONG = 0x8220
    RPDO_TIMEOUT = 0x8250
    FOLLOWING_ERROR = 0x8611
    SYNC_LOST = 0x8700


class Emergency:
    """EMCY producer. An error is reported once, when it occurs, and stays active until it is cleared."""

    def __init__(self, dictionary: Dictionary, send: Callable[[int, bytes], None]) -> None:
        self._dictionary = dictionary
        self._send = send
        self.active: list[int] = []
        """Codes of the errors that are still active, oldest first."""
        dictionary[0x1001, 0].bind(self._register)
        dictionary[0x1014, 0].guard = refusing(
            lambda value: not 0x81 <= value & 0x7FF <= 0xFF or value & 0x7FFFF800
        )
        dictionary[0x1003, 0].guard = only(0)
        dictionary[0x1003, 0].bind(lambda: len(self._history))
        dictionary[0x1003, 0].follower = lambda _: self._history.clear()
        self._history: list[int] = []
        for sub in range(1, HISTORY_DEPTH + 1):
            dictionary[0x1003, sub].bind(partial(self._past, sub - 1))

    def reset(self) -> None:
        """Returns to the state after power-on; sends nothing."""
        self.active.clear()
        self._history.clear()

    def _past(self, age: int) -> int:
        return self._history[age] if age < len(self._history) else 0

    def occur(self, code: int, additional: bytes = b"") -> None:
        """Activates and sends ``code`` unless it is active; ``additional`` holds up to five bytes."""
        if code in self.active:
            return
        self.active.append(code)
        self._history.insert(0, code)
        del self._history[HISTORY_DEPTH:]
        self._transmit(code, additional)

    def clear(self, code: int) -> None:
        """Ends one error and sends the latest error still active, or 'error reset' after the last."""
        if code in self.active:
            self.active.remove(code)
            self._transmit(self.active[-1] if self.active else ErrorCode.NONE, b"")

    def clear_all(self) -> None:
        """Ends all errors, as a fault reset does."""
        if self.active:
            self.active.clear()
            self._transmit(ErrorCode.NONE, b"")

    def _transmit(self, code: int, additional: bytes) -> None:
        can_id = self._dictionary.value(0x1014)
        if not can_id & _DISABLED:
            self._send(can_id & 0x7FF, _FRAME.pack(code, self._register(), additional))

    def _register(self) -> int:
        """Returns object 1001h: bit 0 for any error, bits 1 to 7 by the class of the code."""
        register = 0
        for code in self.active:
            register |= 1 | (0x20 if code >> 8 == 0x86 else _REGISTER_BITS.get(code >> 12, 0))
        return register
