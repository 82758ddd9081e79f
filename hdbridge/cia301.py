"""Numbers of CiA 301 that both ends of a bus use: NMT states and commands, and 32-bit positions."""

from enum import IntEnum
from typing import Final

INT32_RANGE: Final = 1 << 32


class NmtCommand(IntEnum):
    """First byte of an NMT message."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """Byte of a heartbeat."""

    INITIALISING = 0x00
    BOOT_UP = 0x00
    """Byte of a boot-up message, which is that of the state before."""
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def wrap_int32(value: int) -> int:
    """Returns the value of a 32-bit object for an unbounded count."""
    return (value + INT32_RANGE // 2) % INT32_RANGE - INT32_RANGE // 2
